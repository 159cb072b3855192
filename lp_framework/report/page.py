"""The page of a run, and that of a set of runs: one self-contained HTML file, from templates and the runs' files."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import NamedTuple

from plotly.offline import get_plotlyjs

from lp_framework.evaluation.tables import write_text
from lp_framework.report.parts import RunPart, Section, packed, render
from lp_framework.report.run_parts import PARTS
from lp_framework.report.runs import Kind

PAGE = "report.html"
LARGEST = 5_000_000  # letters of runs' parts on the page of a set; the rest of the runs are in the table alone


class Listed(NamedTuple):
    """A run on the page of a set; `content` is all of it (HTML), None where there is no room for it."""

    number: int
    folder: Path
    part: RunPart
    content: str | None


def write_run_page(folder: Path, kind: Kind) -> Path:
    """Write `report.html` into the folder of a finished run, from what is there."""
    return write_report_page(folder / PAGE, [(folder, kind)], [])


def write_report_page(path: Path, runs: Sequence[tuple[Path, Kind]], above: Sequence[Section]) -> Path:
    """Write the page of several runs, or of one: the sections `above`, the runs in tables, and each to be opened."""
    if len(runs) == 1:
        folder, kind = runs[0]
        part = PARTS[kind][1](folder)
        *sections, configuration = part.sections
        return _write(path, replace(part, sections=[*sections, *above, configuration]))
    listed: dict[str, list[Listed]] = {}
    size = 0
    for number, (folder, kind) in enumerate(runs):
        heading, part_of = PARTS[kind]
        part = part_of(folder)
        content = render("run.html.j2", part=part)
        fits = size + len(content) <= LARGEST
        size += len(content) if fits else 0
        listed.setdefault(heading, []).append(Listed(number, folder, part, content if fits else None))
    tables = [Section(heading, render("runs.html.j2", caption=heading, runs=some)) for heading, some in listed.items()]
    in_order = sorted((run for some in listed.values() for run in some), key=lambda run: run.number)
    opened = render("opened.html.j2", runs=in_order)
    sections = [*above, *tables, Section("Run by run", opened)]
    return _write(path, RunPart("Report", f"{len(runs)} runs", {}, sections))


def _write(path: Path, part: RunPart) -> Path:
    """Write the page whole or not at all."""
    templates = resources.files("lp_framework.report") / "templates"
    drawn = any("data-figure=" in section.content for section in part.sections)
    text = render(
        "page.html.j2",
        part=part,
        style=(templates / "page.css").read_text(encoding="utf-8"),
        script=(templates / "page.js").read_text(encoding="utf-8"),
        plotly=_plotly() if drawn else "",
        version=importlib.metadata.version("lp_framework"),
    )
    write_text(path, text)
    return path


@cache
def _plotly() -> str:
    """plotly.js, packed: a third of its size, so that every run of a sweep can have a page."""
    return packed(get_plotlyjs())
