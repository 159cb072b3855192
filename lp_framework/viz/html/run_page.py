"""The page of a run, and that of a set of runs."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from lp_framework.report.runs import Kind
from lp_framework.viz.html.elements import Cell, Html, joined, section, sentence, table, tag, tiles
from lp_framework.viz.html.estimate_part import estimate_part
from lp_framework.viz.html.evaluation_part import evaluation_part
from lp_framework.viz.html.landscape_part import landscape_part
from lp_framework.viz.html.page import Data, write_page
from lp_framework.viz.html.parts import RunPart
from lp_framework.viz.html.training_part import training_part

PAGE = "report.html"
LARGEST = 2_500_000  # letters of runs' parts on the page of a set; the rest of the runs are in the table alone
PARTS: Mapping[Kind, Callable[[Path, Data], RunPart]] = {
    "eval": evaluation_part, "train": training_part, "estimate": estimate_part, "landscape": landscape_part,
}  # fmt: skip
HEADINGS: Mapping[Kind, str] = {
    "eval": "Evaluations", "train": "Trainings", "estimate": "Estimates", "landscape": "Landscapes",
}  # fmt: skip


def write_run_page(folder: Path, kind: Kind) -> Path:
    """Write `report.html` into the folder of a finished run, from what is there."""
    data = Data()
    part = PARTS[kind](folder, data)
    return write_page(folder / PAGE, part.title, part.subtitle, [numbers(part), *part.sections], data, _footer())


def write_report_page(path: Path, runs: Sequence[tuple[Path, Kind]], above: Sequence[Html]) -> Path:
    """Write the page of several runs, or of one: the sections `above`, the runs in tables, and each to be opened."""
    data = Data()
    if len(runs) == 1:
        folder, kind = runs[0]
        part = PARTS[kind](folder, data)
        *sections, configuration = part.sections
        body = [numbers(part), *sections, *above, configuration]
        return write_page(path, part.title, part.subtitle, body, data, _footer())
    lines: dict[Kind, list[tuple[Cell, RunPart]]] = {}
    opened: list[Html] = []
    size = 0
    for folder, kind in runs:
        before = len(data.values)
        part = PARTS[kind](folder, data)
        content = joined(sentence(part.subtitle), numbers(part), *part.sections)
        more = len(content) + data.size(before)
        name: str = str(folder)
        if size + more <= LARGEST:
            size += more
            place = f"run-{len(opened)}"
            opened.append(tag("details", {"class": "run", "id": place}, tag("summary", {}, name), content))
            name = tag("a", {"href": f"#{place}"}, name)
        else:
            del data.values[before:]
        lines.setdefault(kind, []).append((Cell(name, str(folder)), part))
    sections = [section(HEADINGS[kind], _listed(HEADINGS[kind], each)) for kind, each in lines.items()]
    if len(opened) < len(runs):
        sections.append(
            sentence(
                f"{len(runs) - len(opened)} runs would make this page too large; a report of each alone has it all."
            )
        )
    shown = [section("Run by run", *opened)]
    return write_page(path, "Report", f"{len(runs)} runs", [*above, *sections, *shown], data, _footer())


def numbers(part: RunPart) -> Html:
    """A run's most important numbers, large."""
    return tiles({name: cell.content for name, cell in part.numbers.items()}) if part.numbers else Html()


def _listed(title: str, lines: Sequence[tuple[Cell, RunPart]]) -> Html:
    """A row a run, with a column for each of the numbers that any of them has."""
    keys = list(dict.fromkeys(key for _, part in lines for key in part.numbers))
    nothing = Cell("", "")
    rows = [[name, Cell(part.title), *(part.numbers.get(key, nothing) for key in keys)] for name, part in lines]
    return table(["folder", "run", *keys], rows, labels=2, sorts=True, caption=title)


def _footer() -> str:
    return f"Written by lp_framework {importlib.metadata.version('lp_framework')}; this file needs no network."
