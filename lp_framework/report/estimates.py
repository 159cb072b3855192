"""Estimated cameras of photographs on a page: the cameras around the object, and their poses."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lp_framework.analysis.shown import words
from lp_framework.errors import UserError
from lp_framework.evaluation.tables import RESULT
from lp_framework.report.parts import RunPart, configuration, packed, read_json, read_rows, section, tried
from lp_framework.report.plots import cameras_plot

MOST_CAMERAS = 40
SIDE = 96  # pixels of an image in space, at most
ANGLES = {"latitude": "latitude_degrees", "longitude": "longitude_degrees", "radius": "radius"}


def estimate_part(folder: Path) -> RunPart:
    """Of the folder of an `estimate`."""
    result: Mapping[str, Any] = tried(lambda: read_json(folder / RESULT), {})
    return RunPart(
        tried(lambda: f"Cameras by {words(result['config']['solver']['name'])}", "Cameras"),
        "camera poses of photographs; the first is the reference",
        tried(lambda: _numbers(folder, result), {}),
        [
            section("Cameras", "cameras", lambda: _cameras(folder)),
            section("Poses", "poses", lambda: _poses(folder)),
            configuration(folder, result),
        ],
    )


def _numbers(folder: Path, result: Mapping[str, Any]) -> dict[str, str]:
    rows = read_rows(folder / "poses.csv")
    found = sum(row["valid"] == "True" for row in rows)
    return {"photographs": str(len(rows)), "with a pose": str(found), "seconds": f"{result['seconds']:.3g}"}


def _cameras(folder: Path) -> dict[str, Any]:
    rows = [row for row in read_rows(folder / "poses.csv") if row["valid"] == "True"]
    if not rows:
        raise UserError("no photograph has a pose")
    shown = rows[:MOST_CAMERAS]
    poses = np.array([[float(row[key]) for key in ANGLES.values()] for row in shown])
    poses[:, :2] = np.radians(poses[:, :2])
    figure = cameras_plot(poses, [_image(folder, row) for row in shown])
    return {"plot": packed(figure.to_json()), "shown": len(shown), "count": len(rows)}


def _poses(folder: Path) -> dict[str, Any]:
    keys = [*ANGLES.values(), *(f"relative_{key}" for key in ANGLES.values())]
    rows = []
    for row in read_rows(folder / "poses.csv"):
        poses = [float(row[key]) for key in keys] if row["valid"] == "True" else None
        image = tried(partial(_image, folder, row), None)
        rows.append({"image": image, "name": Path(row["file"]).name, "poses": poses, "energy": row["energy"]})
    return {"rows": rows, "angles": list(ANGLES)}


def _image(folder: Path, row: Mapping[str, str]) -> NDArray:
    """The prepared image `[S, S, 4]` of a row; only what lies in the run's own folder is read."""
    with Image.open(folder / "images" / Path(row["image"]).name) as image:
        return np.asarray(image.convert("RGBA"))
