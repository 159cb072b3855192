"""Finished runs as tables: varying settings, mean and spread over seeds; on the terminal, in files, on a page."""

from __future__ import annotations

import json
import math
import re
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from rich import box
from rich.table import Table

from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS
from lp_framework.evaluation.tables import COLUMNS, ERRORS, write_csv, write_json, write_text
from lp_framework.report.page import HEADINGS, number, render
from lp_framework.report.paper import PaperTable, paper_table
from lp_framework.report.runs import COSTS, LeftOut, Run, checkpoint_names

Objects = Literal["unique_answer", "all"]
METRICS = [*COLUMNS, *ERRORS, *COSTS]
PRINTED = [f"{prefix}{degrees}" for degrees in ROTATION_THRESHOLDS for prefix in ("R@", "R(R)@")]
PRINTED += [f"S{name}" for name in PRINTED] + [*ERRORS, *COSTS]  # in the paper's order
LABELS: dict[Objects, str] = {"unique_answer": "objects with a unique answer", "all": "all objects"}


@dataclass(frozen=True)
class Spread:
    """Mean over seeds and sample standard deviation (n - 1); NaN for a single seed or if not finite."""

    mean: float
    std: float = math.nan


@dataclass(frozen=True)
class Row:
    """Runs that differ only in their seeds, or a row of the paper (no runs); `settings` are those in the columns."""

    settings: Mapping[str, Any]
    metrics: Mapping[str, Spread]
    seeds: Sequence[int] = ()
    runs: Sequence[str] = ()  # folders of the runs
    pairs: int | None = None
    source: str = "runs"

    @property
    def paper(self) -> bool:
        """Whether the row is the paper's."""
        return not self.runs


@dataclass(frozen=True)
class SweepTable:
    """The runs of one experiment (or those without one): one row per combination of settings.

    `columns` are the settings that vary here or in the paper's table, `paper`; all runs share those in `common`.
    """

    experiment: str | None
    columns: Sequence[str]
    rows: Sequence[Row]
    common: Mapping[str, Any]
    paper: PaperTable | None

    def groups_along(self, axis: str) -> list[list[Row]]:
        """Group the rows so that within each group only the setting `axis` differs."""
        others = [key for key in self.columns if key != axis]
        groups: dict[str, list[Row]] = {}
        for row in self.rows:
            groups.setdefault(json.dumps([row.settings.get(key) for key in others]), []).append(row)
        return list(groups.values())

    def paper_rows(self, settings: Mapping[str, Any] | None = None) -> list[Row]:
        """The paper's rows: all, or those comparable to a run with these settings."""
        if self.paper is None:
            return []
        rows = []
        for row in self.paper.rows if settings is None else self.paper.matching(settings):
            metrics = {name: Spread(value) for name, value in row.metrics.items()}
            rows.append(Row(row.settings, metrics, source=f"paper: {row.label}"))
        return rows

    def with_paper(self) -> list[Row]:
        """The rows, each followed by the comparable rows of the paper; the paper's other rows come last."""
        rows = [each for row in self.rows for each in (row, *self.paper_rows(row.settings))]
        return rows + [each for each in self.paper_rows() if each not in rows]


def sweep_tables(runs: Sequence[Run], objects: Objects) -> tuple[list[SweepTable], list[LeftOut]]:
    """One table per experiment, sorted by name, runs without one last; and the runs without metrics over `objects`."""
    reason = "no object is labelled as having a unique answer; objects=all counts every object"
    left_out = [LeftOut(run.folder, reason) for run in runs if run.metrics[objects] is None]
    runs = [run for run in runs if run.metrics[objects] is not None]
    names = sorted({run.experiment for run in runs}, key=lambda name: (name is None, name or ""))
    return [_table([run for run in runs if run.experiment == name], name, objects) for name in names], left_out


def spread(values: Sequence[float]) -> Spread:
    """Mean and sample standard deviation.

    >>> spread([1.0, 2.0, 3.0])
    Spread(mean=2.0, std=1.0)
    """
    mean = math.fsum(values) / len(values)
    return Spread(mean, statistics.stdev(values) if len(values) > 1 and math.isfinite(mean) else math.nan)


def varying(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """The fewest keys that distinguish the given settings, names first.

    A key that only some settings have (e.g. of one solver) counts only if it varies among those. A setting determined
    by the choice of its group (`solver.steps`, if every `solver.name` has its own) is left out. Either is added back if
    two different settings would otherwise look the same.

    >>> varying([{"solver.name": "a", "solver.steps": 1}, {"solver.name": "b", "solver.steps": 2, "solver.tries": 1}])
    ['solver.name']
    """

    def distinguished(keys: Sequence[str]) -> int:
        return len({json.dumps({key: each[key] for key in keys if key in each}) for each in settings})

    def implied_by_choice(key: str) -> bool:
        choice = f"{key.rpartition('.')[0]}.name"
        names = {each.get(choice) for each in settings if key in each}
        groups = [[each for each in settings if each.get(choice) == name] for name in names]
        return key != choice and len(names) > 1 and all(len(_values(group, key)) == 1 for group in groups)

    keys = list(dict.fromkeys(key for each in settings for key in each))
    chosen = [key for key in keys if len(_values(settings, key)) > 1 and not implied_by_choice(key)]
    for key in keys:
        if distinguished([*chosen, key]) > distinguished(chosen):
            chosen.append(key)
    return sorted(chosen, key=lambda key: (not key.endswith(".name"), keys.index(key)))


def in_order(value: Any) -> tuple[int, float, str]:
    """Sort key for settings: None, then booleans and numbers by value, then everything else as text.

    >>> sorted([10, "b", None, 9, "a"], key=in_order)
    [None, 9, 10, 'a', 'b']
    """
    if isinstance(value, bool | int | float):
        return (1, float(value), "")
    return (0, 0.0, "") if value is None else (2, 0.0, str(value))


def heading(key: str) -> str:
    """A setting's heading, as written on the command line.

    >>> heading("solver.name"), heading("solver.gamma")
    ('solver', 'solver.gamma')
    """
    return key.removesuffix(".name")


def shown(value: Any) -> str:
    """Format a setting's value for a table."""
    if value is None:
        return "-"
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)


def _table(runs: Sequence[Run], experiment: str | None, objects: Objects) -> SweepTable:
    names = checkpoint_names(runs)
    groups: dict[str, list[Run]] = {}
    for run in sorted(runs, key=lambda run: (run.seed, str(run.folder))):
        groups.setdefault(json.dumps(run.settings, sort_keys=True), []).append(run)
    shown = [
        {key: names.get(value, value) if key == "checkpoint" else value for key, value in group[0].settings.items()}
        for group in groups.values()
    ]
    paper = paper_table(experiment)
    columns = varying(shown)
    columns += [key for key in (paper.settings if paper else []) if key not in columns and _values(shown, key)]
    rows = []
    for settings, group in zip(shown, groups.values(), strict=True):
        metrics = [found for run in group if (found := run.metrics[objects]) is not None]
        rows.append(
            Row(
                {key: settings[key] for key in columns if key in settings},
                {name: spread([each[name] for each in metrics]) for name in metrics[0]},
                [run.seed for run in group],
                [str(run.folder) for run in group],
                group[0].pairs,
            )
        )
    rows.sort(key=lambda row: [in_order(row.settings.get(key)) for key in columns])
    common = {key: value for key, value in shown[0].items() if all(each.get(key) == value for each in shown)}
    return SweepTable(experiment, columns, rows, common, paper)


def _values(settings: Sequence[Mapping[str, Any]], key: str) -> set[str]:
    """The values of a key, as text, in settings that have it."""
    return {json.dumps(each[key]) for each in settings if key in each}


class Layout(NamedTuple):
    """A printed table: the first `labels` columns are settings, the others are numbers. A line holds its cells and
    whether it is the paper's.
    """

    headings: Sequence[str]
    labels: int
    lines: Sequence[tuple[Sequence[str], bool]]


def layout(table: SweepTable) -> Layout:
    """One line per row, one column per metric; the paper's rows follow those they are comparable to."""
    labels = [*map(heading, table.columns), "runs"]
    lines = []
    for row in table.with_paper():
        own = [*(shown(row.settings.get(key)) for key in table.columns), str(len(row.runs))]
        cells = [row.source, *[""] * len(table.columns)] if row.paper else own
        lines.append(([*cells, *(_cell(name, row.metrics.get(name)) for name in PRINTED)], row.paper))
    return Layout([*labels, *(HEADINGS.get(name, name) for name in PRINTED)], len(labels), lines)


def terminal(content: Layout, width: int) -> list[Table]:
    """Format for a terminal: spreads below the means, shares without the leading zero.

    Columns that do not fit in `width` continue in further tables, which repeat the labels.
    """
    labels = range(content.labels)
    columns = []
    for place, cells in enumerate(zip(content.headings, *(cells for cells, _ in content.lines), strict=True)):
        if place not in labels:
            heading = re.sub(r"(.+)@(\d+)", r"@\2\n\1", cells[0]).replace(" ", "\n")
            cells = heading, *(re.sub(r"\b0\.", ".", cell).replace(" ± ", "\n±") for cell in cells[1:])
        columns.append(cells)
    wide = [2 + max(len(line) for cell in cells for line in cell.split("\n")) for cells in columns]
    fitting = max(1, (width - sum(wide[: len(labels)])) // max(wide[len(labels) :]))
    tables = []
    for first in range(len(labels), len(columns), fitting):
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
        for cells in columns[: len(labels)]:
            table.add_column(cells[0], overflow="fold")
        for cells in columns[first : first + fitting]:
            table.add_column(cells[0], justify="right", no_wrap=True)
        drawn = zip(*columns[: len(labels)], *columns[first : first + fitting], strict=True)
        for (_, paper), cells in zip(content.lines, list(drawn)[1:], strict=True):
            table.add_row(*cells, style="dim" if paper else "")
        tables.append(table)
    return tables


def csv_rows(tables: Sequence[SweepTable]) -> tuple[list[str], list[list[object]]]:
    """Columns and rows of all tables in one: one row per combination of settings, and the paper's rows."""
    keys = list(dict.fromkeys(key for table in tables for key in table.columns))
    columns = ["experiment", "source", *keys, "runs", "pairs"]
    columns += [f"{name}{part}" for name in METRICS for part in ("", "_std")]
    rows: list[list[object]] = []
    for table in tables:
        for row in [*table.rows, *table.paper_rows()]:
            settings = [row.settings.get(key) for key in keys]
            spreads = [row.metrics.get(name, Spread(math.nan)) for name in METRICS]
            metrics = [_rounded(each) for spread in spreads for each in (spread.mean, spread.std)]
            rows.append([table.experiment, row.source, *settings, len(row.runs) or None, row.pairs, *metrics])
    return columns, rows


def _cell(name: str, value: Spread | None) -> str:
    if value is None:
        return "-"
    return number(name, value.mean) + ("" if math.isnan(value.std) else f" ± {number(name, value.std)}")


def _rounded(value: float) -> float | str | None:
    """A number for the CSV file; empty if unknown."""
    if math.isnan(value):
        return None
    return round(value, 5) if math.isfinite(value) else "inf"


class Sweep(NamedTuple):
    """A table of runs with its title, its printed layout, and the files of its figures."""

    title: str
    table: SweepTable
    layout: Layout
    files: Sequence[Path]

    @property
    def pictures(self) -> list[Path]:
        """The files that a page can show."""
        return [file for file in self.files if file.suffix == ".png"]


def metrics_note(objects: Objects) -> str:
    """What the metrics are over, in words."""
    return f"metrics over {LABELS[objects]}; mean and standard deviation over seeds"


def sweep_sections(sweeps: Sequence[Sweep], left_out: Sequence[LeftOut]) -> dict[str, str]:
    """The page's sections for sweeps and for the runs left out of their tables: HTML by title."""
    sections = {sweep.title: render("sweep.html.j2", sweep=sweep) for sweep in sweeps}
    return sections | ({"Skipped runs": render("left_out.html.j2", left_out=left_out)} if left_out else {})


def write_sweeps(
    folder: Path, sweeps: Sequence[Sweep], left_out: Sequence[LeftOut], objects: Objects, about: Mapping[str, Any]
) -> None:
    """Write `report.md`, `report.csv` (one row per combination) and `report.json` (with `about`) into `folder`."""
    write_csv(folder / "report.csv", *csv_rows([sweep.table for sweep in sweeps]))
    text = render("report.md.j2", sweeps=sweeps, left_out=left_out, metrics_note=metrics_note(objects))
    write_text(folder / "report.md", text)
    tables = [{**asdict(sweep.table), "figures": [file.name for file in sweep.files]} for sweep in sweeps]
    missing = [{"folder": str(path), "reason": reason} for path, reason in left_out]
    write_json(folder / "report.json", {"objects": objects, "tables": tables, "left_out": missing, **about})
