"""The page of a run, and that of a set of runs: one self-contained HTML file, from templates and the runs' files."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import NamedTuple

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
    """A run on the page of a set, and its content where there is room for it: at `place`."""

    folder: Path
    kind: Kind
    part: RunPart
    place: str | None
    content: str


def write_run_page(folder: Path, kind: Kind) -> Path:
    """Write `report.html` into the folder of a finished run, from what is there."""
    return write_report_page(folder / PAGE, [(folder, kind)], [])


def write_report_page(path: Path, runs: Sequence[tuple[Path, Kind]], above: Sequence[Section]) -> Path:
    """Write the page of several runs, or of one: the sections `above`, the runs in tables, and each to be opened."""
    if len(runs) == 1:
        folder, kind = runs[0]
        part = PARTS[kind](folder)
        *sections, configuration = part.sections
        body = render("run.html.j2", numbers=part.numbers, sections=[*sections, *above, configuration])
        return _write(path, part.title, part.subtitle, body)
    listed = _listed(runs)
    tables = [
        Section(HEADINGS[kind], _table(HEADINGS[kind], [run for run in listed if run.kind == kind]))
        for kind in dict.fromkeys(run.kind for run in listed)
    ]
    opened = [run for run in listed if run.place is not None]
    content = render("opened.html.j2", runs=opened, left_out=len(runs) - len(opened))
    sections = [*above, *tables, Section("Run by run", content)]
    return _write(path, "Report", f"{len(runs)} runs", render("run.html.j2", numbers={}, sections=sections))


def _listed(runs: Sequence[tuple[Path, Kind]]) -> list[Listed]:
    """The runs with their parts; the content of those that fit."""
    found: list[Listed] = []
    size = opened = 0
    for folder, kind in runs:
        part = PARTS[kind](folder)
        content = render("note.html.j2", text=part.subtitle) + render(
            "run.html.j2", numbers=part.numbers, sections=part.sections
        )
        fits = size + len(content) <= LARGEST
        found.append(Listed(folder, kind, part, f"run-{opened}" if fits else None, content if fits else ""))
        size, opened = size + fits * len(content), opened + fits
    return found


def _table(caption: str, runs: Sequence[Listed]) -> str:
    keys = list(dict.fromkeys(key for run in runs for key in run.part.numbers))
    return render("runs.html.j2", caption=caption, keys=keys, runs=runs)


def _write(path: Path, title: str, subtitle: str, body: str) -> Path:
    """Write the page whole or not at all."""
    text = render(
        "page.html.j2",
        title=title,
        subtitle=subtitle,
        body=body,
        style=_file("page.css"),
        script=_file("page.js"),
        plotly=_plotly() if "data-figure=" in body else "",
        version=importlib.metadata.version("lp_framework"),
    )
    write_text(path, text)
    return path


def _file(name: str) -> str:
    return (resources.files("lp_framework.report") / "templates" / name).read_text(encoding="utf-8")


@cache
def _plotly() -> str:
    """plotly.js, packed: a third of its size, so that every run of a sweep can have a page."""
    from plotly.offline import get_plotlyjs  # takes a moment, and only pages need it

    return packed(get_plotlyjs())
