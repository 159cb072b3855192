"""`views`: novel views around an object, as a prior draws them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from PIL import Image
from rich.console import Console
from torch import Tensor

from lp_framework.analysis.generated import generated_views
from lp_framework.analysis.pairs import object_index
from lp_framework.analysis.shown import words
from lp_framework.api import image_batch
from lp_framework.commands.building import Components, orderly_console, plain, run_folder, seed_run, versions
from lp_framework.commands.device import choose_device
from lp_framework.data.module import PairDataModule
from lp_framework.data.photographs import on_white, prepare, prepared_photographs, read_image, save_png
from lp_framework.errors import UserError
from lp_framework.evaluation.tables import write_json
from lp_framework.priors.base import Prior
from lp_framework.solvers.progress import shown_progress
from lp_framework.viz.style import save_figure
from lp_framework.viz.views import views_figure

FOLDER = "views"


class Source(NamedTuple):
    """What is turned: its file, its name, and the prepared image (RGBA)."""

    file: Path
    name: str
    image: Image.Image


@orderly_console()
def run(config: DictConfig) -> None:
    """Write every view into `views/`, and `source.png`, `views.png`, `views.pdf` and `views.json`."""
    folder = run_folder()
    seed_run(config.seed)
    latitudes, longitudes = angles(config.latitudes_degrees, config.longitudes)
    check_sampling(config.steps, config.guidance, config.eta)
    device = choose_device(config.accelerator)
    components = Components(plain(config))
    source = photograph(config) if config.image is not None else data_view(config, components["data"])
    prior: Prior = components["prior"].to(device)
    poses = grid(latitudes, longitudes)  # [rows, columns, 3]
    code = prior.encode(image_batch([source.image]).to(device))
    sampling = (config.steps, config.guidance, config.seed, config.eta)
    with shown_progress():  # a column at once
        images = generated_views(prior, code, poses.transpose(0, 1).flatten(0, 1), *sampling, batch=len(latitudes))
    views = np.rint(255 * images).astype(np.uint8).reshape(len(longitudes), len(latitudes), *images.shape[1:])
    views = views.swapaxes(0, 1)  # [rows, columns, h, w, 3]

    (folder / FOLDER).mkdir(exist_ok=True)
    save_png(folder / "source.png", source.image)
    records = []
    for row, latitude in enumerate(latitudes):
        for column, longitude in enumerate(longitudes):
            file = f"{FOLDER}/{file_name(latitude, longitude)}"
            save_png(folder / file, Image.fromarray(views[row, column]))
            records.append(
                {
                    "file": file,
                    "relative_latitude_degrees": latitude,
                    "relative_longitude_degrees": round(longitude, 6),
                    "relative_pose": [round(value, 6) for value in poses[row, column].tolist()],
                }
            )
    record = {"source": str(source.file), "views": records, "seed": config.seed}
    write_json(folder / "views.json", {**record, "config": plain(config), "versions": versions()})
    settings = f"steps {config.steps}, guidance {config.guidance:g}, eta {config.eta:g}, seed {config.seed}"
    note = f"prior {config.prior.name}, {settings}"
    figure = views_figure(on_white(source.image), views, latitudes, longitudes, source.name, note)
    save_figure(figure, folder / "views")
    console = Console(soft_wrap=True, highlight=False)
    console.print(f"views:   {folder / FOLDER} ({len(records)} files)")
    console.print(f"poses:   {folder / 'views.json'}")
    console.print(f"picture: {folder / 'views.png'}")


def angles(latitudes: Sequence[float], count: int) -> tuple[list[float], list[float]]:
    """The rows' relative latitudes and the columns' relative longitudes, degrees."""
    if not isinstance(count, int) or count < 1:
        raise UserError(f"longitudes must be a number of them, at least 1, got {count}")
    chosen = list(latitudes) if isinstance(latitudes, Sequence) else []
    in_range = all(isinstance(each, int | float) and -180 < each < 180 for each in chosen)
    if not chosen or not in_range or len({*chosen}) < len(chosen):
        raise UserError(f"latitudes_degrees must list different angles between -180 and 180, got {latitudes}")
    return [float(each) for each in chosen], [360 * number / count for number in range(count)]


def check_sampling(steps: int, guidance: float, eta: float) -> None:
    """`UserError` for settings of DDIM that no prior has; what a prior allows beyond that it says itself."""
    if not isinstance(steps, int) or steps < 1:
        raise UserError(f"steps must be a whole number, at least 1, got {steps}")
    if not isinstance(guidance, int | float) or not 0 <= guidance < float("inf"):
        raise UserError(f"guidance must be a number, not negative, got {guidance}")
    if not isinstance(eta, int | float) or not 0 <= eta <= 1:
        raise UserError(f"eta must lie in [0, 1], got {eta}")


def grid(latitudes: Sequence[float], longitudes: Sequence[float]) -> Tensor:
    """Relative poses `[rows, columns, 3]` (radians, radius 0) of angles in degrees."""
    degrees = torch.cartesian_prod(*(torch.tensor(each, dtype=torch.float64) for each in (latitudes, longitudes)))
    poses = torch.cat([torch.deg2rad(degrees), torch.zeros(len(degrees), 1)], dim=1)
    return poses.float().view(len(latitudes), len(longitudes), 3)


def photograph(config: DictConfig) -> Source:
    """The file that `image` names, prepared as a photograph is."""
    file = Path(config.image)
    (image,) = prepared_photographs([file], config.masks, config.remove_background, config.crop)
    return Source(file, file.name, image)


def data_view(config: DictConfig, data: PairDataModule) -> Source:
    """The first test view of the data set's `object`, as it is."""
    data.evaluate_on("ordered", config.seed)
    data.prepare_data()
    file = data.table("test").objects[object_index(data, str(config.object))].files[0]
    return Source(file, words(config.object), prepare(read_image(file), str(file), crop=False))


def file_name(latitude: float, longitude: float) -> str:
    """The name of a view's file, of its relative angles in degrees.

    >>> file_name(-20.0, 30.0)
    'latitude-20_longitude030.png'
    """
    return f"latitude{latitude:+g}_longitude{longitude:03g}.png"
