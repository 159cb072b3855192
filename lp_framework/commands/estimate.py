"""`estimate`: camera poses of photographs of one object, for people, NeRF programs and COLMAP."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from PIL import Image
from rich import box
from rich.console import Console
from rich.table import Table
from torch import Tensor

from lp_framework.api import move, view_set
from lp_framework.commands.building import (
    Components,
    orderly_console,
    plain,
    run_folder,
    seed_run,
    versions,
    warn_of_photographs,
    warn_of_unused,
)
from lp_framework.commands.device import choose_device
from lp_framework.data.camera_files import colmap_model, nerf_transforms
from lp_framework.data.photographs import (
    SIZE,
    photograph_files,
    prepared_photographs,
    save_png,
)
from lp_framework.data.views import FIELD_OF_VIEW_DEGREES
from lp_framework.errors import UserError
from lp_framework.evaluation.tables import write_csv, write_json, write_text
from lp_framework.geometry import apply_relative_pose
from lp_framework.report.page import write_run_page
from lp_framework.solvers.progress import shown_progress
from lp_framework.viz.cameras import cameras_figure
from lp_framework.viz.style import save_figure

log = logging.getLogger(__name__)

COLUMNS = (
    "file", "image", "latitude_degrees", "longitude_degrees", "radius", "relative_latitude_degrees",
    "relative_longitude_degrees", "relative_radius", "energy", "valid",
)  # fmt: skip


@dataclass(frozen=True)
class View:
    """A photograph with its pose: `absolute` and `relative` to the first, `[3]` (radians, object sizes), float64."""

    file: Path
    image: str  # path of the prepared one in the run's folder
    absolute: Tensor
    relative: Tensor
    energy: float  # of the pair with the first, NaN where the solver gives none

    @property
    def valid(self) -> bool:
        """Whether the pose is one of a camera."""
        return bool(self.absolute.isfinite().all() and self.absolute[2] > 0)

    def row(self) -> list[object]:
        """The values of `COLUMNS`."""
        numbers = [*_in_degrees(self.absolute), *_in_degrees(self.relative)]
        energy = "" if math.isnan(self.energy) else f"{self.energy:.6g}"
        return [self.file, self.image, *(round(each, 4) for each in numbers), energy, self.valid]


@orderly_console()
def run(config: DictConfig) -> None:
    """Estimate and write `transforms.json`, `poses.csv`, `colmap/`, `images/`, `cameras.png` and `results.json`."""
    folder = run_folder()
    seed_run(config.seed)
    first = _reference_pose(config.latitude_degrees, config.radius)
    device = choose_device(config.accelerator)
    files = photograph_files(config.images)
    prepared = prepared_photographs(files, config.masks, config.remove_background, config.crop)

    components = Components(plain(config))
    warn_of_unused(components)
    solver, starts = components["solver"], components["start"]
    move(solver, device)
    view_sets = view_set(prepared, device)
    with shown_progress():
        solution = solver.solve_views(view_sets, starts.make(view_sets.with_first(), config.seed)[None], config.seed)

    names = [f"images/{index:03d}.png" for index in range(len(files))]
    relative = torch.cat([torch.zeros(1, 3, dtype=torch.float64), solution.poses[0].detach().cpu().double()])
    absolute = apply_relative_pose(first, relative)
    energies = solution.energies[0].detach().cpu().double()
    estimated = [View(*each) for each in zip(files, names, absolute, relative, energies[0].tolist(), strict=True)]
    if not solution.valid[0]:
        log.warning("the solver did not come to a sound pose for every image")
    for view in estimated:
        if not view.valid:
            log.warning("%s: the solver found no pose; it is left out of the camera files", view.file)
    result = {
        "seconds": solution.cost.seconds,
        "network_passes": solution.cost.network_passes,
        "energies": energies.tolist(),
        "valid": bool(solution.valid[0]),
        "seed": config.seed,
        "checkpoint": str(components.checkpoint) if components.checkpoint else None,
        "config": plain(config),
        "versions": versions(),
    }
    _write(folder, estimated, prepared, result)
    _print(folder, estimated)
    warn_of_prior(components)


def warn_of_prior(components: Components) -> None:
    """Warn of a prior that knows no photographs where the solver's answer rests on it."""
    if "prior" in components.needs("solver"):
        warn_of_photographs(components.settings["prior"])


def _reference_pose(latitude_degrees: object, radius: object) -> Tensor:
    if not isinstance(latitude_degrees, int | float) or not -90 < latitude_degrees < 90:
        raise UserError(f"latitude_degrees must lie between -90 and 90, got {latitude_degrees}")
    if not isinstance(radius, int | float) or not 0 < radius < math.inf:
        raise UserError(f"radius must be a positive number, got {radius}")
    return torch.tensor([math.radians(latitude_degrees), 0.0, radius], dtype=torch.float64)


def _texts(pose: Tensor) -> list[str]:
    latitude, longitude, radius = _in_degrees(pose)
    rounded = round(latitude, 1), round(longitude, 1), round(radius, 2)
    latitude, longitude, radius = (each + 0.0 for each in rounded)  # no minus zero
    return [f"{latitude:.1f}°", f"{longitude:.1f}°", f"{radius:.2f}"]


def _in_degrees(pose: Tensor) -> tuple[float, float, float]:
    latitude, longitude, radius = pose.tolist()
    return math.degrees(latitude), math.degrees(longitude), radius


def _write(folder: Path, views: Sequence[View], prepared: Sequence[Image.Image], result: dict[str, Any]) -> None:
    (folder / "images").mkdir(exist_ok=True)
    for view, image in zip(views, prepared, strict=True):
        save_png(folder / view.image, image)
    numbers = [number for number, view in enumerate(views) if view.valid]
    poses = torch.stack([views[number].absolute for number in numbers])
    files = [views[number].image for number in numbers]
    write_json(folder / "transforms.json", nerf_transforms(files, poses, FIELD_OF_VIEW_DEGREES))
    (folder / "colmap").mkdir(exist_ok=True)
    names = [Path(file).name for file in files]
    for name, text in colmap_model(names, poses, SIZE, FIELD_OF_VIEW_DEGREES).items():
        write_text(folder / "colmap" / name, text)
    write_csv(folder / "poses.csv", COLUMNS, [view.row() for view in views])
    write_json(folder / "results.json", result)
    images = [prepared[number] for number in numbers]
    titles = [views[number].file.name for number in numbers]
    save_figure(cameras_figure(poses.numpy(), images, numbers, titles, FIELD_OF_VIEW_DEGREES), folder / "cameras")


def _print(folder: Path, views: Sequence[View]) -> None:
    console = Console(width=110 if not Console().is_terminal else None, highlight=False)
    table = Table(title="camera poses", title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("", no_wrap=True)
    for column in ("latitude", "longitude", "radius", "relative: latitude", "longitude", "radius", "energy"):
        table.add_column(column, justify="right")
    for index, view in enumerate(views):
        absolute, relative = _texts(view.absolute), _texts(view.relative)
        if index == 0:
            table.add_row(view.file.name, *absolute, "reference")
        elif view.valid:
            energy = "" if math.isnan(view.energy) else f"{view.energy:.4g}"
            table.add_row(view.file.name, *absolute, *relative, energy)
        else:
            table.add_row(view.file.name, "none")
    console.print(table)
    for what, path in (
        ("poses", "transforms.json, poses.csv"), ("COLMAP", "colmap"), ("images", "images"), ("picture", "cameras.png"),
    ):  # fmt: skip
        console.print(f"{what + ':':9}{folder}/{path}", soft_wrap=True)
    console.print(f"page:    {write_run_page(folder, 'estimate')}", soft_wrap=True)
