"""Sweeps of evaluations in a report: their tables in the terminal and as files, their figures, their part of a page."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rich import box
from rich.table import Table

from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS
from lp_framework.evaluation.tables import COLUMNS, ERRORS, write_csv, write_json, write_text
from lp_framework.report.parts import HEADINGS, Section, number, render
from lp_framework.report.runs import COSTS, LeftOut
from lp_framework.report.sweep_figures import cost_figure, sweep_figure
from lp_framework.report.sweep_tables import Objects, Spread, SweepTable, heading, in_order, shown
from lp_framework.viz.style import save_figure

METRICS = [*COLUMNS, *ERRORS, *COSTS]
PRINTED = [f"{prefix}{degrees}" for degrees in ROTATION_THRESHOLDS for prefix in ("R@", "R(R)@")]
PRINTED += [f"S{name}" for name in PRINTED] + [*ERRORS, *COSTS]  # in the paper's order
ACROSS = {  # a number whose values become columns, and the metrics that are rows then, as in the paper's tables
    "views": ("R@15", "R@30", "R(R)@15", "R(R)@30"),
    "start.count": ("R@30", "R(R)@30", "SR(R)@30", "seconds_per_pair"),
}
PLACE = ("data.name", "protocol", "checkpoint", "prior.name", "solver.name", "start.name", "views")  # of all runs


class Line(NamedTuple):
    """A line of a printed table: text cells, and whether it is the paper's."""

    cells: Sequence[str]
    paper: bool


@dataclass(frozen=True)
class Layout:
    """A printed table: `labels` of its headings say what was set, the others are numbers."""

    headings: Sequence[str]
    labels: int
    lines: Sequence[Line]


def layout(table: SweepTable) -> Layout:
    """The table as the paper would print it; the paper's own rows follow those that they are to be compared with."""
    axis = next((key for key in ACROSS if len({str(row.settings.get(key)) for row in table.rows}) > 1), None)
    return _down(table) if axis is None else _across(table, axis)


def terminal(content: Layout) -> Table:
    """The layout for a terminal, which is narrow: spreads below the means, shares without the leading zero."""
    printed = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for place, name in enumerate(content.headings):
        if place < content.labels:
            printed.add_column(name, overflow="fold")
        else:
            prefix, at, degrees = name.partition("@")
            told = f"@{degrees}\n{prefix}" if at else name.replace(" ", "\n")
            printed.add_column(told, justify="right", no_wrap=True)
    for cells, paper in content.lines:
        numbers = [re.sub(r"\b0\.", ".", cell).replace(" ± ", "\n±") for cell in cells[content.labels :]]
        printed.add_row(*cells[: content.labels], *numbers, style="dim" if paper else "")
    return printed


def csv_rows(tables: Sequence[SweepTable]) -> tuple[list[str], list[list[object]]]:
    """Columns and rows of all tables in one: a row a combination of settings, and the paper's rows."""
    keys = list(dict.fromkeys(key for table in tables for key in table.columns))
    columns = ["experiment", "source", *keys, "runs", "pairs"]
    columns += [f"{name}{part}" for name in METRICS for part in ("", "_std")]
    rows: list[list[object]] = []
    for table in tables:
        for row in [*table.rows, *table.all_papers()]:
            settings = [row.settings.get(key) for key in keys]
            metrics = [_rounded(each) for name in METRICS for each in row.metrics.get(name, (None, None))]
            rows.append([table.experiment, row.source, *settings, len(row.runs) or None, row.pairs, *metrics])
    return columns, rows


def _down(table: SweepTable) -> Layout:
    """A line a row, the metrics across."""
    labels = [*map(heading, table.columns), "runs"]
    lines = []
    for row in table.with_paper():
        cells = [shown(row.settings.get(key)) for key in table.columns] + [str(len(row.runs))]
        if row.paper:
            cells = [row.source] + [""] * len(table.columns)
        lines.append(Line([*cells, *(_cell(name, row.metrics.get(name)) for name in PRINTED)], row.paper))
    return Layout([*labels, *(HEADINGS.get(name, name) for name in PRINTED)], len(labels), lines)


def _across(table: SweepTable, axis: str) -> Layout:
    """A line a metric of those that differ in the setting `axis` alone, the values of which are across."""
    others = [key for key in table.columns if key != axis]
    values = sorted({row.settings.get(axis) for row in table.rows}, key=in_order)
    lines = []
    for group in table.apart_from(axis):
        settings = group[0].settings
        ours = [[row.metrics for row in group if row.settings.get(axis) == value] for value in values]
        theirs = [[row.metrics for row in table.papers({**settings, axis: value})] for value in values]
        counts = "-".join(map(str, sorted({len(row.runs) for row in group})))
        told = [*(shown(settings.get(key)) for key in others), counts]
        for name in ACROSS[axis]:
            for columns, labels, paper in ((ours, told, False), (theirs, ["paper", *[""] * len(others)], True)):
                found = [next((each[name] for each in column if name in each), None) for column in columns]
                if any(found):
                    cells = [*labels, HEADINGS.get(name, name), *(_cell(name, value) for value in found)]
                    lines.append(Line(cells, paper))
    headings = [*map(heading, others), "runs", "metric", *(f"{heading(axis)}={shown(value)}" for value in values)]
    return Layout(headings, len(others) + 2, lines)


def _cell(name: str, value: Spread | None) -> str:
    if value is None:
        return "-"
    return number(name, value.mean) + ("" if math.isnan(value.std) else f" ± {number(name, value.std)}")


def _rounded(value: float | None) -> float | str | None:
    """A number of a CSV; one that is not known is left empty."""
    if value is None or math.isnan(value):
        return None
    return round(value, 5) if math.isfinite(value) else "inf"


# ---------------------------------------------------------------- files and pages


@dataclass(frozen=True)
class Sweep:
    """A table of runs with its title, as it is printed, and with the files of its figures."""

    title: str
    table: SweepTable
    layout: Layout
    files: Sequence[Path]

    @property
    def pictures(self) -> list[Path]:
        """Those of its files that a page can show."""
        return [file for file in self.files if file.suffix == ".png"]


def draw_sweep(table: SweepTable, folder: Path) -> Sweep:
    """A table with the figures that it calls for, which are saved in `folder`."""
    name = table.experiment or "runs"
    shared = [f"{heading(key)} {shown(table.common[key])}" for key in PLACE if table.common.get(key) is not None]
    figures = {name: sweep_figure(table), f"{name}_seconds": cost_figure(table)}
    files = [file for stem, each in figures.items() if each is not None for file in save_figure(each, folder / stem)]
    return Sweep(", ".join([name, *shared]), table, layout(table), files)


def counted(objects: Objects) -> str:
    """In words, what the numbers are over."""
    over = "objects with a unique answer" if objects == "unique_answer" else "all objects"
    return f"metrics over {over}; mean and standard deviation over seeds"


def sweep_sections(sweeps: Sequence[Sweep], left_out: Sequence[LeftOut]) -> list[Section]:
    """The sweeps on a page, and the runs that their tables leave out."""
    sections = [Section(sweep.title, render("sweep.html.j2", sweep=sweep)) for sweep in sweeps]
    return [*sections, Section("Left out", render("left_out.html.j2", left_out=left_out))] if left_out else sections


def write_sweeps(
    folder: Path, sweeps: Sequence[Sweep], left_out: Sequence[LeftOut], objects: Objects, about: Mapping[str, Any]
) -> None:
    """`report.md`, `report.csv` (a row a combination) and `report.json` in `folder`; the last with what `about` has."""
    write_csv(folder / "report.csv", *csv_rows([sweep.table for sweep in sweeps]))
    text = render("report.md.j2", sweeps=sweeps, left_out=left_out, counted=counted(objects))
    write_text(folder / "report.md", text)
    write_json(
        folder / "report.json",
        {
            "objects": objects,
            "tables": [_as_json(sweep) for sweep in sweeps],
            "left_out": [{"folder": str(path), "reason": reason} for path, reason in left_out],
            **about,
        },
    )


def _as_json(sweep: Sweep) -> dict[str, Any]:
    metrics = [{name: value._asdict() for name, value in row.metrics.items()} for row in sweep.table.rows]
    rows = [{**asdict(row), "metrics": each} for row, each in zip(sweep.table.rows, metrics, strict=True)]
    return {**asdict(sweep.table), "rows": rows, "figures": [file.name for file in sweep.files]}
