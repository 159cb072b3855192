"""`views`: novel views around an object, as a prior draws them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from PIL import Image
from rich.console import Console

from lp_framework.analysis.fields import generated_views, grid_poses
from lp_framework.analysis.pairs import object_index, words
from lp_framework.api import image_batch
from lp_framework.commands.building import begin, plain, warn_of_photographs
from lp_framework.data.photographs import on_white, prepare, prepared_photographs, read_image, save_png
from lp_framework.errors import UserError
from lp_framework.evaluation.tables import write_json
from lp_framework.priors.base import Prior
from lp_framework.registry import checked
from lp_framework.solvers.progress import shown_progress
from lp_framework.viz.sheets import views_figure
from lp_framework.viz.style import save_figure

FOLDER = "views"


def run(config: DictConfig) -> None:
    """Write every view into `views/`, and `source.png`, `views.png`, `views.pdf` and `views.json`."""
    folder, device, components = begin(config)
    latitudes, longitudes = angles(config.latitudes_degrees, config.longitudes)
    sampling = checked(Prior.generate, {key: config[key] for key in ("steps", "guidance", "eta")}, "")
    if config.image is not None:
        file, name = Path(config.image), Path(config.image).name
        (image,) = prepared_photographs([file], config.masks, config.remove_background, config.crop)
    else:  # the first test view of an object, as it is
        data, name = components.test_views(), words(config.object)
        file = data.table("test").objects[object_index(data, str(config.object))].files[0]
        image = prepare(read_image(file), str(file), crop=False)
    prior: Prior = components["prior"].to(device)
    degrees = (torch.tensor(each, dtype=torch.float64) for each in (latitudes, longitudes))
    (poses,) = grid_poses(torch.zeros(1), *map(torch.deg2rad, degrees))  # [rows, columns, 3]
    code, columns = prior.encode(image_batch([image]).to(device)), poses.transpose(0, 1).flatten(0, 1)
    with shown_progress():  # a column at once
        drawn = generated_views(prior, code, columns, seed=config.seed, batch=len(latitudes), **sampling)
    views = np.rint(255 * drawn).astype(np.uint8).reshape(len(longitudes), len(latitudes), *drawn.shape[1:])
    views = views.swapaxes(0, 1)  # [rows, columns, h, w, 3]
    (folder / FOLDER).mkdir(exist_ok=True)
    save_png(folder / "source.png", image)
    records: list[dict[str, Any]] = [
        {
            "file": f"{FOLDER}/latitude{latitude:+g}_longitude{longitude:03g}.png",
            "relative_latitude_degrees": latitude,
            "relative_longitude_degrees": round(longitude, 6),
            "relative_pose": [round(value, 6) for value in pose],
        }
        for latitude, row in zip(latitudes, poses.tolist(), strict=True)
        for longitude, pose in zip(longitudes, row, strict=True)
    ]
    for each, view in zip(records, views.reshape(-1, *views.shape[2:]), strict=True):
        save_png(folder / each["file"], Image.fromarray(view))
    write_json(folder / "views.json", {"source": str(file), "views": records, **components.record()})
    settings = f"steps {config.steps}, guidance {config.guidance:g}, eta {config.eta:g}, seed {config.seed}"
    note = f"prior {config.prior.name}, {settings}"
    save_figure(views_figure(on_white(image), views, latitudes, longitudes, name, note), folder / "views")
    if config.image is not None:
        warn_of_photographs(plain(config.prior))
    console = Console(soft_wrap=True, highlight=False)
    console.print(f"views:   {folder / FOLDER} ({len(records)} files)")
    console.print(f"poses:   {folder / 'views.json'}")
    console.print(f"picture: {folder / 'views.png'}")


def angles(latitudes: Sequence[float], count: int) -> tuple[list[float], list[float]]:
    """The rows' relative latitudes and the columns' relative longitudes, degrees."""
    if not isinstance(count, int) or count < 1:
        raise UserError(f"longitudes must be a whole number, at least 1, got {count}")
    chosen = list(latitudes) if isinstance(latitudes, Sequence) else []
    in_range = all(isinstance(each, int | float) and -180 < each < 180 for each in chosen)
    if not chosen or not in_range or len({*chosen}) < len(chosen):
        raise UserError(f"latitudes_degrees must list different angles between -180 and 180, got {latitudes}")
    return [float(each) for each in chosen], [360 * number / count for number in range(count)]
