"""Tables of sweeps in print: their layout, in the terminal, as CSV and JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS
from lp_framework.evaluation.tables import COLUMNS, ERRORS
from lp_framework.report.runs import COSTS
from lp_framework.report.sweep_tables import Spread, SweepTable, in_order

METRICS = [*COLUMNS, *ERRORS, *COSTS]
HEADINGS = dict(zip([*ERRORS, *COSTS], ["Rot. (deg)", "Trans.", "s/pair", "passes"], strict=True))
PRINTED = [f"{prefix}{degrees}" for degrees in ROTATION_THRESHOLDS for prefix in ("R@", "R(R)@")]
PRINTED += [f"S{name}" for name in PRINTED] + [*ERRORS, *COSTS]  # in the paper's order
ACROSS = {  # a number whose values become columns, and the metrics that are rows then, as in the paper's tables
    "views": ("R@15", "R@30", "R(R)@15", "R(R)@30"),
    "start.count": ("R@30", "R(R)@30", "SR(R)@30", "seconds_per_pair"),
}


@dataclass(frozen=True)
class Line:
    """A line of a printed table: text cells, with the spread in `spreads` (empty where there is none)."""

    cells: Sequence[str]
    spreads: Sequence[str]
    paper: bool


@dataclass(frozen=True)
class Layout:
    """A printed table: `labels` of its headings say what was set, the others are numbers."""

    headings: Sequence[str]
    labels: int
    lines: Sequence[Line]


def axis_across(table: SweepTable) -> str | None:
    """The setting of `ACROSS` whose values are the columns of the printed table: the first that varies."""
    return next((key for key in ACROSS if len({str(row.settings.get(key)) for row in table.rows}) > 1), None)


def layout(table: SweepTable) -> Layout:
    """The table as the paper would print it; the paper's own rows follow those that they are to be compared with."""
    axis = axis_across(table)
    return _down(table) if axis is None else _across(table, axis)


def heading(key: str) -> str:
    """A setting as a heading, as it is written on the command line.

    >>> heading("solver.name"), heading("solver.gamma")
    ('solver', 'solver.gamma')
    """
    return key.removesuffix(".name")


def shown(value: Any) -> str:
    """A setting's value in a table."""
    if value is None:
        return "-"
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)


def number(name: str, value: float) -> str:
    """A metric's value, rounded as is usual for it."""
    if not math.isfinite(value):
        return "inf"
    if name == "network_passes_per_pair":
        return f"{value:.0f}"
    if name == "rotation_error":
        return f"{value:.2f}" if value < 100 else f"{value:.0f}"
    if name == "seconds_per_pair":
        return f"{value:.3g}"
    return f"{value:.3f}"


def terminal(content: Layout) -> Table:
    """The layout for a terminal: spreads below the means, the paper's rows dim."""
    printed = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for place, name in enumerate(content.headings):
        if place < content.labels:
            printed.add_column(name, overflow="fold")
        else:
            printed.add_column(_broken(name), justify="right", no_wrap=True, min_width=_width(content, place))
    for line in content.lines:
        style = "dim" if line.paper else ""
        below = [f"\n±{_short(spread)}" if spread else "" for spread in line.spreads]
        cells = [_short(cell) if place >= content.labels else cell for place, cell in enumerate(line.cells)]
        printed.add_row(*(Text.assemble((cell, style), (more, "dim")) for cell, more in zip(cells, below, strict=True)))
    return printed


def csv_rows(tables: Sequence[SweepTable]) -> tuple[list[str], list[list[object]]]:
    """Columns and rows of all tables in one: a row a combination of settings, and the paper's rows."""
    keys = list(dict.fromkeys(key for table in tables for key in table.columns))
    columns = ["experiment", "source", *keys, "runs", "pairs"]
    columns += [f"{name}{part}" for name in METRICS for part in ("", "_std")]
    rows: list[list[object]] = []
    for table in tables:
        for row in table.rows:
            rows.append([table.experiment, "runs", *(row.settings.get(key) for key in keys), len(row.seeds), row.pairs,
                         *(part for name in METRICS for part in _rounded(row.metrics.get(name)))])  # fmt: skip
        for line in table.paper.rows if table.paper else []:
            label = f"paper: {line.label}"
            rows.append([table.experiment, label, *(line.settings.get(key) for key in keys), None, None,
                         *(part for name in METRICS for part in (line.metrics.get(name), None))])  # fmt: skip
    return columns, rows


def as_json(table: SweepTable) -> dict[str, Any]:
    """The table with everything that is known of it."""
    paper = table.paper
    return {
        "experiment": table.experiment,
        "columns": table.columns,
        "common": table.common,
        "rows": [
            {
                "settings": row.settings,
                "seeds": row.seeds,
                "runs": [str(folder) for folder in row.folders],
                "pairs": row.pairs,
                "metrics": {name: value._asdict() for name, value in row.metrics.items()},
            }
            for row in table.rows
        ],
        "paper": paper
        and {
            **{"title": paper.title, "source": paper.source, "caption": paper.caption, "notes": paper.notes},
            "rows": [{"label": row.label, "settings": row.settings, "metrics": row.metrics} for row in paper.rows],
        },
    }


def _down(table: SweepTable) -> Layout:
    """A line a row, the metrics across."""
    labels = [*map(heading, table.columns), "runs"]
    lines = []
    for row, paper in table.beside_paper():
        if row is not None:
            cells = [shown(row.settings.get(key)) for key in table.columns] + [str(len(row.seeds))]
            lines.append(_line(cells, PRINTED, [row.metrics.get(name) for name in PRINTED]))
        for each in paper:
            cells = [f"paper: {each.label}"] + [""] * len(table.columns)
            lines.append(_line(cells, PRINTED, [_alone(each.metrics.get(name)) for name in PRINTED], paper=True))
    return Layout([*labels, *(HEADINGS.get(name, name) for name in PRINTED)], len(labels), lines)


def _across(table: SweepTable, axis: str) -> Layout:
    """A line a metric of those that differ in the setting `axis` alone, the values of which are across."""
    others = [key for key in table.columns if key != axis]
    values = sorted({row.settings.get(axis) for row in table.rows}, key=in_order)
    labels = [*map(heading, others), "runs", "metric"]
    lines = []
    for group in table.apart_from(axis):
        settings = group[0].settings
        rows = {row.settings.get(axis): row.metrics for row in group}
        runs = "-".join(map(str, sorted({len(row.seeds) for row in group})))
        papers = [[row.metrics for row in table.papers({**settings, axis: value})] for value in values]
        for name in ACROSS[axis]:
            names, told = [name] * len(values), HEADINGS.get(name, name)
            cells = [*(shown(settings.get(key)) for key in others), runs, told]
            lines.append(_line(cells, names, [rows.get(value, {}).get(name) for value in values]))
            theirs = [_alone(next((each[name] for each in paper if name in each), None)) for paper in papers]
            if any(value is not None for value in theirs):
                lines.append(_line(["paper", *[""] * (len(labels) - 2), told], names, theirs, paper=True))
    return Layout([*labels, *(f"{heading(axis)}={shown(value)}" for value in values)], len(labels), lines)


def _line(labels: Sequence[str], names: Sequence[str], values: Sequence[Spread | None], paper: bool = False) -> Line:
    cells, spreads = list(labels), [""] * len(labels)
    for name, value in zip(names, values, strict=True):
        cells.append("-" if value is None else number(name, value.mean))
        spreads.append("" if value is None or value.std is None else number(name, value.std))
    return Line(cells, spreads, paper)


def _alone(value: float | None) -> Spread | None:
    """A number of the paper, which has no spread."""
    return None if value is None else Spread(value, None)


def _rounded(value: Spread | None) -> tuple[float | str | None, float | None]:
    if value is None:
        return None, None
    if not math.isfinite(value.mean):
        return "inf", None
    return round(value.mean, 5), None if value.std is None else round(value.std, 5)


def _short(cell: str) -> str:
    """Shares without the leading zero: the table is wide."""
    return cell.removeprefix("0") if cell.startswith("0.") else cell


def _width(content: Layout, place: int) -> int:
    return max(len(_short(text)) + 1 for line in content.lines for text in (line.cells[place], line.spreads[place]))


def _broken(name: str) -> str:
    """A heading in two lines where it is a metric's: `R(R)@5` as `@5` above `R(R)`."""
    prefix, at, degrees = name.partition("@")
    return f"@{degrees}\n{prefix}" if at else name.replace(" ", "\n")
