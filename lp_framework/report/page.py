"""The page of a run, and that of a set of runs: one self-contained HTML file, from templates and the runs' files."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import NamedTuple

from plotly.offline import get_plotlyjs

from lp_framework.evaluation.tables import write_text
from lp_framework.report.estimates import estimate_part
from lp_framework.report.evaluations import evaluation_part
from lp_framework.report.landscapes import landscape_part
from lp_framework.report.parts import RunPart, Section, packed, render
from lp_framework.report.runs import Kind
from lp_framework.report.trainings import training_part

PAGE = "report.html"
LARGEST = 5_000_000  # letters of runs' parts on the page of a set; the rest of the runs are in the table alone
PARTS: Mapping[Kind, Callable[[Path], RunPart]] = {
    "eval": evaluation_part, "train": training_part, "estimate": estimate_part, "landscape": landscape_part,
}  # fmt: skip
HEADINGS: Mapping[Kind, str] = {
    "eval": "Evaluations", "train": "Trainings", "estimate": "Estimates", "landscape": "Landscapes",
}  # fmt: skip


class Listed(NamedTuple):
    """A run on the page of a set; `content` is all of it (HTML), None where there is no room for it."""

    folder: Path
    kind: Kind
    part: RunPart
    content: str | None


def write_run_page(folder: Path, kind: Kind) -> Path:
    """Write `report.html` into the folder of a finished run, from what is there."""
    return write_report_page(folder / PAGE, [(folder, kind)], [])


def write_report_page(path: Path, runs: Sequence[tuple[Path, Kind]], above: Sequence[Section]) -> Path:
    """Write the page of several runs, or of one: the sections `above`, the runs in tables, and each to be opened."""
    if len(runs) == 1:
        folder, kind = runs[0]
        part = PARTS[kind](folder)
        *sections, configuration = part.sections
        return _write(path, replace(part, sections=[*sections, *above, configuration]))
    listed: list[Listed] = []
    size = 0
    for folder, kind in runs:
        part = PARTS[kind](folder)
        content = render("run.html.j2", part=part)
        fits = size + len(content) <= LARGEST
        size += len(content) if fits else 0
        listed.append(Listed(folder, kind, part, content if fits else None))
    sections = [*above]
    for kind in dict.fromkeys(kind for _, kind in runs):
        rows = [(number, run) for number, run in enumerate(listed) if run.kind == kind]
        keys = list(dict.fromkeys(key for _, run in rows for key in run.part.numbers))
        sections.append(Section(HEADINGS[kind], render("runs.html.j2", caption=HEADINGS[kind], keys=keys, rows=rows)))
    sections.append(Section("Run by run", render("opened.html.j2", runs=listed)))
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
