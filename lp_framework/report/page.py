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
from lp_framework.report.parts import RunPart, Section, packed_text, render
from lp_framework.report.run_parts import PARTS
from lp_framework.report.runs import Kind

PAGE = "report.html"
LARGEST = 5_000_000  # letters of runs' parts on the page of a set; the rest of the runs are in the table alone


class Listed(NamedTuple):
    """A run on the page of a set; `content` is all of it (HTML), None where there is no room for it."""

    number: int
    folder: Path
    heading: str
    part: RunPart
    content: str | None


def write_run_page(folder: Path, kind: Kind) -> Path:
    """Write `report.html` into the folder of a finished run, from what is there."""
    return write_report_page(folder / PAGE, [(folder, kind)], [])


def write_report_page(path: Path, runs: Sequence[tuple[Path, Kind]], above: Sequence[Section]) -> Path:
    """Write the page of several runs, or of one: the sections `above`, the runs in tables, and each to be opened.

    It is written whole or not at all.
    """
    part = _one(*runs[0], above) if len(runs) == 1 else _several(runs, above)
    templates = resources.files("lp_framework.report") / "templates"
    text = render(
        "page.html.j2",
        part=part,
        style=(templates / "page.css").read_text(encoding="utf-8"),
        script=(templates / "page.js").read_text(encoding="utf-8"),
        plotly=_plotly() if any("data-figure=" in section.content for section in part.sections) else "",
        version=importlib.metadata.version("lp_framework"),
    )
    write_text(path, text)
    return path


def _one(folder: Path, kind: Kind, above: Sequence[Section]) -> RunPart:
    part = PARTS[kind][1](folder)
    *sections, configuration = part.sections
    return replace(part, sections=[*sections, *above, configuration])


def _several(runs: Sequence[tuple[Path, Kind]], above: Sequence[Section]) -> RunPart:
    listed: list[Listed] = []
    room = LARGEST
    for number, (folder, kind) in enumerate(runs):
        heading, part_of = PARTS[kind]
        part = part_of(folder)
        content = render("run.html.j2", part=part)
        fits = len(content) <= room
        room -= len(content) if fits else 0
        listed.append(Listed(number, folder, heading, part, content if fits else None))
    sections = [*above]
    for heading in dict.fromkeys(run.heading for run in listed):
        some = [run for run in listed if run.heading == heading]
        sections.append(Section(heading, render("runs.html.j2", caption=heading, runs=some)))
    sections.append(Section("Run by run", render("opened.html.j2", runs=listed)))
    return RunPart("Report", f"{len(runs)} runs", {}, sections)


@cache
def _plotly() -> str:
    """plotly.js, packed: a third of its size, so that every run of a sweep can have a page."""
    return packed_text(get_plotlyjs())
