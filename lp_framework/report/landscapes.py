"""Landscapes on a page: those of one pair with the ways over them, or the energy around each object of a data set."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lp_framework.analysis.examples import EXAMPLES, read_examples
from lp_framework.analysis.shown import words
from lp_framework.errors import UserError
from lp_framework.report.pairs import pairs
from lp_framework.report.parts import RunPart, configuration, read_json, section, tried


def landscape_part(folder: Path) -> RunPart:
    """Of the folder of a `landscape`: of one pair, or of a whole data set."""
    return _pair_part(folder) if (folder / "landscape.json").is_file() else _overview_part(folder)


def _pair_part(folder: Path) -> RunPart:
    record: Mapping[str, Any] = tried(lambda: read_json(folder / "landscape.json"), {})
    return RunPart(
        tried(lambda: _pair_title(record), folder.name),
        "the energy of the prior over the relative pose of a pair, and the ways of a solver over it",
        tried(lambda: _pair_numbers(record), {}),
        [
            section("Landscape", "pairs", lambda: pairs(read_examples(folder / "pictures" / EXAMPLES))),
            section("Pictures", "pictures", lambda: _pictures(folder)),
            configuration(folder, record),
        ],
    )


def _pair_title(record: Mapping[str, Any]) -> str:
    files = " and ".join(Path(record[name]).name for name in ("reference", "query"))
    name = record["config"]["object"]
    return f"Landscape of {files}" if name is None else f"Landscape of {words(name)}, {files}"


def _pair_numbers(record: Mapping[str, Any]) -> dict[str, str]:
    numbers = {"minima": str(len(record["minima"])), "flatness along longitude": f"{record['flatness']:.2f}"}
    answer = next((each for each in record["descents"] if each["chosen"]), None)
    if answer is not None and answer["rotation_error"] is not None:
        numbers["rotation error of the answer"] = f"{answer['rotation_error']:.1f}°"
    return numbers


def _pictures(folder: Path) -> dict[str, Any]:
    files = [folder / f"{name}.png" for name in ("landscape", "fields") if (folder / f"{name}.png").is_file()]
    if not files:
        raise UserError("there is no landscape.png")
    return {"files": files}


def _overview_part(folder: Path) -> RunPart:
    record: Mapping[str, Any] = tried(lambda: read_json(folder / "azimuth.json"), {})
    return RunPart(
        tried(lambda: _overview_title(record), folder.name),
        "the energy of the prior around each object, all but the azimuth true",
        tried(lambda: _overview_numbers(record), {}),
        [
            section("Objects", "azimuths", lambda: _objects(read_json(folder / "azimuth.json"))),
            configuration(folder, record),
        ],
    )


def _overview_title(record: Mapping[str, Any]) -> str:
    return f"Landscapes of {record['config']['data']['name']}, prior {record['config']['prior']['name']}"


def _overview_numbers(record: Mapping[str, Any]) -> dict[str, str]:
    names = {"within": "least energy within 15°, all objects", "within_unique_answer": "the same, unique answer"}
    return {label: f"{record[key]:.1%}" for key, label in names.items() if record.get(key) is not None}


def _objects(record: Mapping[str, Any]) -> dict[str, Any]:
    span = max(max(row["energy"]) - min(row["energy"]) for row in record["objects"]) or 1.0
    rows = []
    for row in sorted(record["objects"], key=lambda row: row["within"]):
        low, last = min(row["energy"]), len(row["energy"]) - 1
        heights = [26 - 24 * (energy - low) / span for energy in row["energy"]]
        curve = " ".join(f"{100 * place / last:.1f},{height:.1f}" for place, height in enumerate(heights))
        truth = 100 * row["degrees"].index(min(row["degrees"], key=abs)) / last
        minima = [f"{each['degrees']:+.0f}°".replace("-", "\N{MINUS SIGN}") for each in row["minima"]]
        score = row.get("ambiguity_score")  # runs of a time without it have none
        rows.append({**row, "curve": curve, "truth": truth, "minima": minima, "score": score})
    return {"objects": rows}
