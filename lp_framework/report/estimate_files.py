"""The output files of an estimate: `poses.csv`, `results.json`, the cameras with their images, a picture and a page."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from lp_framework.analysis.confidence import Answer
from lp_framework.analysis.estimates import Estimate
from lp_framework.data.camera_files import ASSUMED, export_cameras, original_focal_length
from lp_framework.data.masks import mask_maker
from lp_framework.data.photographs import save_png
from lp_framework.evaluation.tables import write_csv, write_json
from lp_framework.report.page import write_run_page
from lp_framework.viz.cameras import cameras_figure
from lp_framework.viz.style import save_figure

log = logging.getLogger(__name__)

COLUMNS = (
    "file", "image", "latitude_degrees", "longitude_degrees", "radius", "relative_latitude_degrees",
    "relative_longitude_degrees", "relative_radius", "energy", "valid", "answer", "probability", "verdict",
    "second_latitude_degrees", "second_longitude_degrees", "second_probability",
)  # fmt: skip
MASKS = "masks"  # folder of the masks made by a run


class Written(NamedTuple):
    """The rows of `poses.csv` up to the column `valid`, whether masks were made, the photographs with an assumed focal
    length, and the page."""

    rows: list[list[Any]]
    masks_made: bool
    assumed: list[str]
    page: Path


def write_estimate(folder: Path, found: Estimate, record: Mapping[str, Any]) -> Written:
    """Write all files of an estimate into `folder`; `record` is added to the numbers in `results.json`."""
    degrees, framed = found.field_of_view_degrees, list(zip(found.photographs, found.prepared, strict=True))
    focals = [original_focal_length(*each, degrees) for each in framed]
    made = any(each.made for each in found.photographs)
    result = {
        "seconds": found.cost.seconds,
        "network_passes": found.cost.network_passes,
        "energies": found.energies.tolist(),
        "valid": found.valid,
        "masks_by": mask_maker().name if made else None,
        "focal_lengths": [
            {"file": str(file), "pixels": focal, "known_by": how}
            for file, (focal, how) in zip(found.files, focals, strict=True)
        ],
        "answers": [_record(*each) for each in zip(found.files[1:], found.answers, strict=bool(found.answers))],
        **record,
    }
    write_json(folder / "results.json", result)
    for index, photograph in enumerate(found.photographs):
        if photograph.made and photograph.mask is not None:
            (folder / MASKS).mkdir(exist_ok=True)
            save_png(folder / MASKS / f"{index:03d}.png", photograph.mask)
    rows = _write_poses(folder, found)
    kept = [index for index, row in enumerate(rows) if row[-1]]
    export_cameras(folder, {index: framed[index] for index in kept}, found.absolute[kept], degrees)
    assumed = [file.name for file, (_, how) in zip(found.files, focals, strict=True) if how == ASSUMED]
    return Written(rows, made, assumed, write_run_page(folder, "estimate"))


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


def _write_poses(folder: Path, found: Estimate) -> list[list[Any]]:
    """Write the images, `poses.csv` and `cameras.png`; returns the rows of `poses.csv` up to `valid`."""
    files, pictures = found.files, [each.image for each in found.prepared]
    images = [f"images/{index:03d}.png" for index in range(len(files))]
    (folder / "images").mkdir(exist_ok=True)
    for image, picture in zip(images, pictures, strict=True):
        save_png(folder / image, picture)
    poses = torch.cat([found.absolute, found.relative], dim=1)
    valid = (poses.isfinite().all(dim=1) & (poses[:, 2] > 0)).tolist()
    for file, is_pose in zip(files, valid, strict=True):
        if not is_pose:
            log.warning("%s: the solver found no pose; it is left out of the camera files", file)
    numbers = poses.numpy().copy()
    numbers[:, [0, 1, 3, 4]] = np.degrees(numbers[:, [0, 1, 3, 4]])
    energies = found.energies[0].tolist()
    rows = [
        [file, image, *(round(number, 4) for number in row), "" if math.isnan(energy) else f"{energy:.6g}", is_pose]
        for file, image, row, energy, is_pose in zip(files, images, numbers.tolist(), energies, valid, strict=True)
    ]
    answers = found.answers
    notes = [[""] * 6, *(_notes(answer) for answer in answers)] if answers else [[""] * 6] * len(rows)
    write_csv(folder / "poses.csv", COLUMNS, [[*row, *note] for row, note in zip(rows, notes, strict=True)])
    kept = [index for index, is_pose in enumerate(valid) if is_pose]
    shown, titles = [pictures[index] for index in kept], [files[index].name for index in kept]
    verdicts = [str(notes[index][2]) for index in kept]
    cameras = found.absolute[kept].numpy()
    save_figure(cameras_figure(cameras, shown, kept, titles, found.field_of_view_degrees, verdicts), folder / "cameras")
    return rows


def _notes(answer: Answer) -> list[Any]:
    """The last columns of `poses.csv`."""
    if not answer.verdict:
        return [""] * 6
    second = ["", "", ""] if answer.second is None else _second(answer.second)
    probability = "" if math.isnan(answer.probability) else round(answer.probability, 4)
    return [answer.words, probability, answer.verdict, *second]
