"""`estimate`: camera poses of photographs of one object, for people, NeRF programs and COLMAP."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from PIL import Image
from rich import box
from rich.console import Console
from rich.table import Table
from torch import Tensor

from lp_framework.analysis.confidence import Answer, answers, answers_by_prior
from lp_framework.api import move, view_set
from lp_framework.commands.building import Components, begin, warn_of_photographs, warn_of_unused
from lp_framework.data.camera_files import ASSUMED, ASSUMED_FOCAL, ORIGINAL, export_cameras, original_focal_length
from lp_framework.data.masks import mask_maker
from lp_framework.data.photograph_files import listed, photograph_files
from lp_framework.data.photographs import read_photographs, save_png
from lp_framework.data.views import FIELD_OF_VIEW_DEGREES
from lp_framework.errors import UserError
from lp_framework.evaluation.tables import write_csv, write_json
from lp_framework.geometry import apply_relative_pose
from lp_framework.report.page import write_run_page
from lp_framework.solvers.progress import shown_progress
from lp_framework.viz.cameras import cameras_figure
from lp_framework.viz.style import save_figure

log = logging.getLogger(__name__)

COLUMNS = (
    "file", "image", "latitude_degrees", "longitude_degrees", "radius", "relative_latitude_degrees",
    "relative_longitude_degrees", "relative_radius", "energy", "valid", "answer", "probability", "verdict",
    "second_latitude_degrees", "second_longitude_degrees", "second_probability",
)  # fmt: skip
MASKS = "masks"  # folder of the masks that a run has made
RADIUS_LOST = "the crop to the object loses the distance: radius is not estimated"


def run(config: DictConfig) -> None:
    """Estimate and write `poses.csv`, `results.json`, the cameras with `images/` and `original/`, and `cameras.png`."""
    folder, device, components = begin(config)
    first = _reference_pose(config.latitude_degrees, config.radius)
    files = photograph_files(config.images)
    photographs = read_photographs(files, config.masks, config.remove_background, config.crop)
    framed = [(each, each.prepared(config.crop)) for each in photographs]
    prepared = [view.image for _, view in framed]
    warn_of_unused(components)
    solver, starts = components["solver"], components["start"]
    move(solver, device)
    move(starts, device)
    view_sets = view_set(prepared, device)
    with shown_progress():
        solution = solver.solve_views(view_sets, starts.make(view_sets.with_first(), config.seed)[None], config.seed)
    relative = torch.cat([torch.zeros(1, 3, dtype=torch.float64), solution.poses[0].detach().cpu().double()])
    told = answers(solution.pairs)
    radius_lost = config.crop and bool(told)
    if not told and "prior" in components.needs("solver"):
        told = answers_by_prior(components["prior"], view_sets.with_first(), solution.poses[0])
    if radius_lost:
        relative[:, 2] = 0.0
    absolute = apply_relative_pose(first, relative)
    energies = solution.energies[0].detach().cpu().double()
    if not solution.valid[0]:
        log.warning("the solver did not come to a sound pose for every image")
    degrees = solver.field_of_view_degrees or FIELD_OF_VIEW_DEGREES
    focals = [original_focal_length(*each, degrees) for each in framed]
    result = {
        "seconds": solution.cost.seconds,
        "network_passes": solution.cost.network_passes,
        "energies": energies.tolist(),
        "valid": bool(solution.valid[0]),
        "masks_by": mask_maker().name if any(each.made for each in photographs) else None,
        "focal_lengths": [
            {"file": str(file), "pixels": focal, "known_by": how}
            for file, (focal, how) in zip(files, focals, strict=True)
        ],
        "answers": [_record(file, answer) for file, answer in zip(files[1:], told, strict=bool(told))],
        "checkpoint": str(components.checkpoint) if components.checkpoint else None,
        **components.record(),
    }
    write_json(folder / "results.json", result)
    for index, photograph in enumerate(photographs):
        if photograph.made and photograph.mask is not None:
            (folder / MASKS).mkdir(exist_ok=True)
            save_png(folder / MASKS / f"{index:03d}.png", photograph.mask)
    poses = torch.cat([absolute, relative], dim=1)
    rows = _write(folder, files, prepared, poses, energies[0].tolist(), told, degrees)
    found = [index for index, row in enumerate(rows) if row[-1]]
    export_cameras(folder, {index: framed[index] for index in found}, absolute[found], degrees)
    assumed = [file.name for file, (_, how) in zip(files, focals, strict=True) if how == ASSUMED]
    _print(folder, rows, told, radius_lost, assumed, result["masks_by"] is not None)
    if not told or any(answer.verdict != "trust" for answer in told):
        warn_of_prior(components)


def warn_of_prior(components: Components) -> None:
    """Warn of a prior that knows no photographs where the solver's answer rests on it."""
    if "prior" in components.needs("solver"):
        warn_of_photographs(components.settings["prior"])


def _record(file: Path, answer: Answer) -> dict[str, Any]:
    """An answer for `results.json`; angles in degrees."""
    second = answer.second
    return {
        "file": str(file),
        "answer": answer.words,
        "probability": answer.probability,
        "verdict": answer.verdict,
        "reason": answer.reason,
        "second": None if second is None else dict(zip(COLUMNS[-3:], _second(second), strict=True)),
    }


def _second(second: Answer) -> list[float]:
    """Latitude and longitude in degrees, and the probability."""
    degrees = math.degrees(second.latitude), math.degrees(second.longitude) % 360
    return [*(round(each, 4) for each in degrees), round(second.probability, 4)]


def _reference_pose(latitude_degrees: object, radius: object) -> Tensor:
    if not isinstance(latitude_degrees, int | float) or not -90 < latitude_degrees < 90:
        raise UserError(f"latitude_degrees must lie between -90 and 90, got {latitude_degrees}")
    if not isinstance(radius, int | float) or not 0 < radius < math.inf:
        raise UserError(f"radius must be a positive number, got {radius}")
    return torch.tensor([math.radians(latitude_degrees), 0.0, radius], dtype=torch.float64)


def _write(
    folder: Path, files: Sequence[Path], prepared: Sequence[Image.Image], poses: Tensor, energies: Sequence[float],
    told: Sequence[Answer], degrees: float,
) -> list[list[Any]]:  # fmt: skip
    """The images, `poses.csv` and `cameras.png`, of absolute and relative poses `[I, 6]` and this field of view;
    returns the rows of `poses.csv`."""
    images = [f"images/{index:03d}.png" for index in range(len(files))]
    (folder / "images").mkdir(exist_ok=True)
    for image, picture in zip(images, prepared, strict=True):
        save_png(folder / image, picture)
    valid = (poses.isfinite().all(dim=1) & (poses[:, 2] > 0)).tolist()
    for file, is_pose in zip(files, valid, strict=True):
        if not is_pose:
            log.warning("%s: the solver found no pose; it is left out of the camera files", file)
    numbers = poses.numpy().copy()
    numbers[:, [0, 1, 3, 4]] = np.degrees(numbers[:, [0, 1, 3, 4]])
    rows = [
        [file, image, *(round(number, 4) for number in row), "" if math.isnan(energy) else f"{energy:.6g}", is_pose]
        for file, image, row, energy, is_pose in zip(files, images, numbers.tolist(), energies, valid, strict=True)
    ]
    notes = [[""] * 6, *(_notes(answer) for answer in told)] if told else [[""] * 6] * len(rows)
    write_csv(folder / "poses.csv", COLUMNS, [[*row, *note] for row, note in zip(rows, notes, strict=True)])
    found = [index for index, is_pose in enumerate(valid) if is_pose]
    pictures, titles = [prepared[index] for index in found], [files[index].name for index in found]
    verdicts = [str(notes[index][2]) for index in found]
    figure = cameras_figure(poses[found, :3].numpy(), pictures, found, titles, degrees, verdicts)
    save_figure(figure, folder / "cameras")
    return rows


def _notes(answer: Answer) -> list[Any]:
    """The last columns of `poses.csv`."""
    if not answer.verdict:
        return [""] * 6
    second = ["", "", ""] if answer.second is None else _second(answer.second)
    probability = "" if math.isnan(answer.probability) else round(answer.probability, 4)
    return [answer.words, probability, answer.verdict, *second]


def _print(
    folder: Path, rows: Sequence[Sequence[Any]], told: Sequence[Answer], radius_lost: bool, assumed: Sequence[str],
    masks_made: bool,
) -> None:  # fmt: skip
    """The rows of `poses.csv` for people, and where everything is."""
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
    for (file, *_), answer in zip(rows[1:], told, strict=bool(told)):
        way = f"{rows[0][0].name} to {file.name}: {answer.words}"
        console.print(f"{way}; {answer.reason}: {answer.verdict}" if answer.verdict else way, soft_wrap=True)
        if answer.second_words:
            console.print(f"  second: {answer.second_words}", soft_wrap=True)
    if radius_lost:
        console.print(RADIUS_LOST)
    if assumed:
        factor = f"{ASSUMED_FOCAL:g} times the longer side is assumed for {ORIGINAL}/"
        console.print(f"no focal length in the EXIF data of {listed(assumed)}: {factor}", soft_wrap=True)
    console.print(f"poses:   {folder}/poses.csv", soft_wrap=True)
    console.print(f"cameras: {folder}/transforms.json, sparse/0 (COLMAP), with images; cameras.glb", soft_wrap=True)
    console.print(f"         {folder}/{ORIGINAL}: the same for the photographs as they were taken", soft_wrap=True)
    if masks_made:
        console.print(f"masks:   {folder}/{MASKS}", soft_wrap=True)
    console.print(f"picture: {folder}/cameras.png", soft_wrap=True)
    console.print(f"page:    {write_run_page(folder, 'estimate')}", soft_wrap=True)
