"""Landscapes of a data set on a page: the energy around each object, and pairs seen from all sides."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lp_framework.analysis.examples import EXAMPLES, read_examples
from lp_framework.errors import UserError
from lp_framework.viz.html.elements import Cell, Html, joined, sentence, sheet, sparkline, table
from lp_framework.viz.html.page import Data
from lp_framework.viz.html.parts import BROKEN, RunPart, configuration, guarded, read_json
from lp_framework.viz.html.viewer import class_of, viewer


def landscape_part(folder: Path, data: Data) -> RunPart:
    """Of the folder of a `landscape`: of one pair, or of a whole data set."""
    return _pair_part(folder, data) if (folder / "landscape.json").is_file() else _overview_part(folder)


def _pair_part(folder: Path, data: Data) -> RunPart:
    try:
        record: Mapping[str, Any] = read_json(folder / "landscape.json")
    except UserError:
        record = {}
    config = record.get("config")
    examples = folder / "pictures" / EXAMPLES
    return RunPart(
        _pair_title(folder, record),
        "the energy of the prior over the relative pose of a pair, and the ways of a solver over it",
        _pair_numbers(record),
        [
            guarded("Landscape", lambda: viewer(read_examples(examples), data)),
            guarded("Pictures", lambda: _pictures(folder)),
            configuration(folder, config if isinstance(config, Mapping) else None, record.get("versions")),
        ],
    )


def _pair_title(folder: Path, record: Mapping[str, Any]) -> str:
    try:
        files = " and ".join(Path(record[name]).name for name in ("reference", "query"))
        object = record["config"]["object"]
        return f"Landscape of {files}" if object is None else f"Landscape of {object.replace('_', ' ')}, {files}"
    except BROKEN:
        return folder.name


def _pair_numbers(record: Mapping[str, Any]) -> dict[str, Cell]:
    try:
        numbers = {
            "minima": Cell(str(len(record["minima"]))),
            "flatness along longitude": Cell(f"{record['flatness']:.2f}"),
        }
        answer = next((each for each in record["descents"] if each["chosen"]), None)
        if answer is not None and answer["rotation_error"] is not None:
            numbers["rotation error of the answer"] = Cell(f"{answer['rotation_error']:.1f}°")
        return numbers
    except BROKEN:
        return {}


def _pictures(folder: Path) -> Html:
    files = [folder / f"{name}.png" for name in ("landscape", "fields") if (folder / f"{name}.png").is_file()]
    if not files:
        raise UserError("there is no landscape.png")
    return joined(*(sheet(file, f"picture of the {file.stem}") for file in files))


def _overview_part(folder: Path) -> RunPart:
    try:
        record: Mapping[str, Any] = read_json(folder / "azimuth.json")
    except UserError:
        record = {}
    config = record.get("config")
    return RunPart(
        _title(folder, record),
        "the energy of the prior around each object, all but the azimuth true",
        _numbers(record),
        [
            guarded("Objects", lambda: _objects(read_json(folder / "azimuth.json"))),
            configuration(folder, config if isinstance(config, Mapping) else None, record.get("versions")),
        ],
    )


def _title(folder: Path, record: Mapping[str, Any]) -> str:
    try:
        return f"Landscapes of {record['config']['data']['name']}, prior {record['config']['prior']['name']}"
    except BROKEN:
        return folder.name


def _numbers(record: Mapping[str, Any]) -> dict[str, Cell]:
    names = {"within": "least energy within 15°, all objects", "within_unique_answer": "the same, unique answer"}
    try:
        return {
            label: Cell(f"{record[key]:.1%}", record[key])
            for key, label in names.items()
            if record.get(key) is not None
        }
    except BROKEN:
        return {}


def _objects(record: Mapping[str, Any]) -> Html:
    span = max(max(row["energy"]) - min(row["energy"]) for row in record["objects"])
    rows = []
    for row in sorted(record["objects"], key=lambda row: row["within"]):
        name = row["object"].replace("_", " ")
        minima = ", ".join(f"{each['degrees']:+.0f}°" for each in row["minima"]).replace("-", "\N{MINUS SIGN}")
        truth = row["degrees"].index(min(row["degrees"], key=abs)) / (len(row["degrees"]) - 1)
        rows.append(
            [Cell(name), Cell(class_of(row["ambiguity"]), row["ambiguity"]),
             Cell(sparkline(row["energy"], span, truth, f"energy around {name}"), row["relief"]),
             Cell(minima, len(row["minima"])), Cell(f"{row['within']:.0%}", row["within"]),
             Cell(f"{row['relief']:.1%}", row["relief"]), *_score(row.get("ambiguity_score")), Cell(str(row["pairs"]))]
        )  # fmt: skip
    headings = [
        "object",
        "class",
        "energy by azimuth",
        "valleys (from the truth)",
        "within 15°",
        "relief",
        "flatness",
        "verdict",
        "pairs",
    ]
    return joined(
        sentence(
            "The curve is the mean energy from half a turn before the truth to half a turn after it, all of one scale; "
            "the bar marks the truth. Within 15°: the share of pairs whose least energy is so near. Relief: the range "
            "over the mean. Flatness: that of the whole landscape along longitude; the verdict is what it lets expect."
        ),
        table(headings, rows, labels=4, sorts=True, caption="objects"),
    )


def _score(score: Mapping[str, Any] | None) -> list[Cell]:
    """Flatness and verdict, empty for runs of a time without them."""
    if score is None:
        return [Cell("", ""), Cell("", "")]
    return [Cell(f"{score['flatness']:.2f}", score["flatness"]), Cell(score["verdict"])]
