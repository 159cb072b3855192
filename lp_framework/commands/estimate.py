"""`estimate`: camera poses of photographs of one object, for people, NeRF tools and COLMAP."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import torch
from omegaconf import DictConfig
from rich import box
from rich.console import Console
from rich.table import Table
from torch import Tensor

from lp_framework.analysis.estimates import Estimate, estimate
from lp_framework.commands.building import Components, begin, warn_of_photographs, warn_of_unused
from lp_framework.data.camera_files import ASSUMED_FOCAL, ORIGINAL
from lp_framework.data.photograph_files import listed, photograph_files
from lp_framework.data.photographs import read_photographs
from lp_framework.errors import UserError
from lp_framework.report.estimate_files import MASKS, Written, write_estimate
from lp_framework.solvers.progress import shown_progress

log = logging.getLogger(__name__)

RADIUS_LOST = "the crop to the object loses the distance: radius is not estimated"


def run(config: DictConfig) -> None:
    """Estimate and write `poses.csv`, `results.json`, the cameras with `images/` and `original/`, and `cameras.png`."""
    folder, device, components = begin(config)
    first = _reference_pose(config.latitude_degrees, config.radius)
    files = photograph_files(config.images)
    photographs = read_photographs(files, config.masks, config.remove_background, config.crop)
    warn_of_unused(components)
    prior = components["prior"] if "prior" in components.needs("solver") else None
    with shown_progress():
        found = estimate(
            photographs, config.crop, components["solver"], components["start"], prior, first, device, config.seed
        )
    if not found.valid:
        log.warning("the solver did not find a valid pose for every image")
    checkpoint = str(components.checkpoint) if components.checkpoint else None
    written = write_estimate(folder, found, {"checkpoint": checkpoint, **components.record()})
    _print(folder, found, written)
    if not found.answers or any(answer.verdict != "trust" for answer in found.answers):
        warn_of_prior(components)


def warn_of_prior(components: Components) -> None:
    """Warn if the solver uses a prior that does not support photographs."""
    if "prior" in components.needs("solver"):
        warn_of_photographs(components.settings["prior"])


def _reference_pose(latitude_degrees: object, radius: object) -> Tensor:
    if not isinstance(latitude_degrees, int | float) or not -90 < latitude_degrees < 90:
        raise UserError(f"latitude_degrees must lie between -90 and 90, got {latitude_degrees}")
    if not isinstance(radius, int | float) or not 0 < radius < math.inf:
        raise UserError(f"radius must be a positive number, got {radius}")
    return torch.tensor([math.radians(latitude_degrees), 0.0, radius], dtype=torch.float64)


def _print(folder: Path, found: Estimate, written: Written) -> None:
    """Print the rows of `poses.csv`, and where the output is."""
    rows = written.rows
    console = Console(width=110 if not Console().is_terminal else None, highlight=False)
    table = Table(title="camera poses", title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("", no_wrap=True)
    for column in ("latitude", "longitude", "radius", "relative: latitude", "longitude", "radius", "energy"):
        table.add_column(column, justify="right")
    forms = ("{:.1f}°", "{:.1f}°", "{:.2f}") * 2
    for index, (file, _, *numbers, energy, is_pose) in enumerate(rows):
        texts = [form.format(number) for form, number in zip(forms, numbers, strict=True)]
        if index == 0:
            texts[3:] = ["reference"]
        table.add_row(file.name, *([*texts, energy] if is_pose else ["none"]))
    console.print(table)
    for (file, *_), answer in zip(rows[1:], found.answers, strict=bool(found.answers)):
        line = f"{rows[0][0].name} to {file.name}: {answer.words}"
        console.print(f"{line}; {answer.reason}: {answer.verdict}" if answer.verdict else line, soft_wrap=True)
        if answer.second_words:
            console.print(f"  second: {answer.second_words}", soft_wrap=True)
    if found.radius_lost:
        console.print(RADIUS_LOST)
    if written.assumed:
        factor = f"{ASSUMED_FOCAL:g} times the longer side is assumed for {ORIGINAL}/"
        console.print(f"no focal length in the EXIF data of {listed(written.assumed)}: {factor}", soft_wrap=True)
    console.print(f"poses:   {folder}/poses.csv", soft_wrap=True)
    console.print(f"cameras: {folder}/transforms.json, sparse/0 (COLMAP), with images; cameras.glb", soft_wrap=True)
    console.print(f"         {folder}/{ORIGINAL}: the same for the photographs as they were taken", soft_wrap=True)
    if written.masks_made:
        console.print(f"masks:   {folder}/{MASKS}", soft_wrap=True)
    console.print(f"picture: {folder}/cameras.png", soft_wrap=True)
    console.print(f"page:    {written.page}", soft_wrap=True)
