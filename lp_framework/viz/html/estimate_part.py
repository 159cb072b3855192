"""Estimated cameras of photographs on a page: the cameras around the object, and their poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import radians
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lp_framework.errors import UserError
from lp_framework.report.runs import RESULT
from lp_framework.viz.html.elements import Cell, Html, data_uri, joined, picture, plot, sentence, table
from lp_framework.viz.html.page import Data
from lp_framework.viz.html.parts import BROKEN, RunPart, configuration, guarded, read_json, read_rows

MOST_CAMERAS = 40
ANGLES = {"latitude": "latitude_degrees", "longitude": "longitude_degrees", "radius": "radius"}


def estimate_part(folder: Path, data: Data) -> RunPart:
    """Of the folder of an `estimate`."""
    try:
        result: Mapping[str, Any] = read_json(folder / RESULT)
    except UserError:
        result = {}
    config = result.get("config")
    return RunPart(
        _title(result),
        "camera poses of photographs; the first is the reference",
        _numbers(folder, result),
        [
            guarded("Cameras", lambda: _cameras(folder, data)),
            guarded("Poses", lambda: _poses(folder)),
            configuration(folder, config if isinstance(config, Mapping) else None, result.get("versions")),
        ],
    )


def _title(result: Mapping[str, Any]) -> str:
    try:
        return f"Cameras by {result['config']['solver']['name'].replace('_', ' ')}"
    except BROKEN:
        return "Cameras"


def _numbers(folder: Path, result: Mapping[str, Any]) -> dict[str, Cell]:
    try:
        rows = read_rows(folder / "poses.csv")
        found = sum(row["valid"] == "True" for row in rows)
        counts = {"photographs": Cell(str(len(rows))), "with a pose": Cell(str(found))}
        return counts | {"seconds": Cell(f"{result['seconds']:.3g}")}
    except BROKEN:
        return {}


def _cameras(folder: Path, data: Data) -> Html:
    rows = [row for row in read_rows(folder / "poses.csv") if row["valid"] == "True"]
    if not rows:
        raise UserError("no photograph has a pose")
    shown = rows[:MOST_CAMERAS]
    views = [
        {"image": data_uri(_image(folder, row), 96), "label": str(place), "pose": _pose(row)}
        for place, row in enumerate(shown)
    ]
    beyond = f" The first {len(shown)} of {len(rows)} are drawn." if len(rows) > len(shown) else ""
    return joined(
        plot(data.add({"views": views}), "scene", "the cameras around the object, with their images"),
        sentence(f"Number 0 is the reference, whose image also stands for the object; drag to turn.{beyond}"),
    )


def _poses(folder: Path) -> Html:
    rows = []
    for place, row in enumerate(read_rows(folder / "poses.csv")):
        name = Path(row["file"]).name
        try:
            image: str = picture(_image(folder, row), 88, f"{name}, prepared")
        except (OSError, ValueError):
            image = "missing"
        cells = [Cell(str(place), float(place)), Cell(image, name), Cell(name)]
        if row["valid"] != "True":
            rows.append([*cells, *[Cell("none", "")] * 7])
            continue
        cells += [_number(row[key]) for key in ANGLES.values()]
        cells += [_number(row[f"relative_{key}"]) for key in ANGLES.values()]
        rows.append([*cells, Cell("reference", "") if place == 0 else _number(row["energy"], ".4g")])
    headings = ["no.", "image", "photograph", *ANGLES, *(f"rel. {name}" for name in ANGLES), "energy"]
    return joined(
        table(headings, rows, labels=3, sorts=True, caption="poses"),
        sentence("Angles in degrees, radii in object sizes; rel.: relative to the reference."),
    )


def _number(text: str, form: str = ".2f") -> Cell:
    return Cell(f"{float(text):{form}}", float(text)) if text else Cell("", "")


def _pose(row: Mapping[str, str]) -> Sequence[float]:
    latitude, longitude, radius = (float(row[key]) for key in ANGLES.values())
    return radians(latitude), radians(longitude), radius


def _image(folder: Path, row: Mapping[str, str]) -> NDArray:
    """The prepared image `[S, S, 4]` of a row; only what lies in the run's own folder is read."""
    with Image.open(folder / "images" / Path(row["image"]).name) as image:
        return np.asarray(image.convert("RGBA"))
