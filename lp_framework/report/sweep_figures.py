"""The figures of a sweep's table: metrics over a swept number, or combinations of settings side by side."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS
from lp_framework.report.sweep_tables import Row, Spread, Sweep, SweepTable, heading, layout, shown
from lp_framework.viz.style import BLUE, GREEN, INK, MUTED, ORANGE, PURPLE, VERMILION, open_frame, save_figure, styled

# Numeric settings with a figure of their own, and its x-axis label; the first that varies wins.
AXES = {
    "views": "number of images",
    "start.count": "number of starts",
    "solver.gamma": "noise scale \u03b3 of the longitude",
}
RECALL, SUCCESS, ROTATION_RECALL = (
    [f"{prefix}@{degrees}" for degrees in ROTATION_THRESHOLDS] for prefix in ("R", "SR", "R(R)")
)
PANELS = {"Recall R (chosen start)": RECALL, "Success rate SR (all starts)": SUCCESS}
WITHIN = [f"within {degrees}°" for degrees in ROTATION_THRESHOLDS]
TIME = "seconds per pair (log scale)"
SECONDS, SOLVER = "seconds_per_pair", "solver.name"
COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, INK, MUTED)
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
DASHES = (0, (3, 2))  # for the paper's curves
PAPER = "paper (other data and prior)"
PLACE = ("data.name", "protocol", "checkpoint", "prior.name", "solver.name", "start.name", "views")  # of all runs


class Curve(NamedTuple):
    """Means `[K]` with standard deviations `[K]` (NaN for a single run) over `x` `[K]`; one `label`, one colour."""

    label: str
    x: NDArray
    mean: NDArray
    std: NDArray
    paper: bool = False


class Panel(NamedTuple):
    """Curves over one x-axis, logarithmic for `TIME`."""

    title: str
    xlabel: str
    curves: Sequence[Curve]


def draw_sweep(table: SweepTable, folder: Path) -> Sweep:
    """Draw the figures that suit a table, and save them in `folder`."""
    name = table.experiment or "runs"
    shared = [f"{heading(key)} {shown(table.common[key])}" for key in PLACE if table.common.get(key) is not None]
    figures = {name: sweep_figure(table), f"{name}_seconds": cost_figure(table)}
    files = [file for stem, each in figures.items() if each is not None for file in save_figure(each, folder / stem)]
    return Sweep(", ".join([name, *shared]), table, layout(table), files)


def sweep_figure(table: SweepTable) -> Figure | None:
    """The figure that suits the varying settings: metrics over a number, or rows side by side; None for one row."""
    axis = next((key for key in AXES if is_swept(table, key)), None)
    if axis is not None and len(table.groups_along(axis)) <= len(COLOURS):
        return curves_figure(_panels(table, axis))
    if len(table.rows) < 2 and table.paper is None:
        return None
    rows: dict[str, Row] = {}
    for row in table.with_paper():
        rows.setdefault(row.source if row.paper else label(row.settings), row)
    return rows_figure(rows)


def cost_figure(table: SweepTable) -> Figure | None:
    """Rotation recall of each solver over its seconds per pair; None for one solver, for more rows than colours, or if
    the table's own figure already shows the time.
    """
    solvers = [row.settings.get(SOLVER) for row in table.rows]
    if len(set(solvers)) < 2 or len(table.rows) > len(COLOURS) or is_swept(table, "start.count"):
        return None
    rows = {label(row.settings): row for row in table.rows}
    return curves_figure(
        [
            Panel(name, TIME, [_curve(title, [row], None, name) for title, row in rows.items()])
            for name in ROTATION_RECALL
        ]
    )


@styled
def curves_figure(panels: Sequence[Panel]) -> Figure:
    """Panels side by side with a shared y-axis; the paper's curves are dashed, with hollow marks."""
    figure, row = _side_by_side(len(panels), 3.3)
    labels = list(dict.fromkeys(curve.label for panel in panels for curve in panel.curves))
    for axes, panel in zip(row, panels, strict=True):
        for curve in panel.curves:
            place, paper = labels.index(curve.label) % len(COLOURS), curve.paper
            axes.errorbar(
                curve.x, curve.mean, yerr=None if paper else curve.std, color=COLOURS[place], marker=MARKERS[place],
                markersize=4.5, markerfacecolor="white" if paper else COLOURS[place], capsize=2, elinewidth=1.0,
                linestyle=DASHES if paper else "-", linewidth=1.0 if paper else 1.5, clip_on=False,
                zorder=2 if paper else 3, label=PAPER if paper else curve.label,
            )  # fmt: skip
        axes.set_xlabel(panel.xlabel)
        if panel.xlabel == TIME:
            axes.set_xscale("log")
            axes.xaxis.set_minor_formatter(NullFormatter())
        else:
            axes.set_xticks(sorted({float(x) for curve in panel.curves for x in curve.x}))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.set_title(panel.title)
        open_frame(axes)
    row[0].set_ylim(top=1.0)
    row[0].set_ylabel("share of pairs")
    _legend(figure)
    return figure


@styled
def rows_figure(rows: Mapping[str, Row]) -> Figure:
    """One line per row, from the top, with its label, in panels of metrics; one mark per metric."""
    figure, panels = _side_by_side(len(PANELS), 1.15 + 0.27 * len(rows), sharex=True)
    for axes, (title, names) in zip(panels, PANELS.items(), strict=True):
        for metric, within, colour, marker in zip(names, WITHIN, COLOURS, MARKERS, strict=False):
            for line, row in enumerate(rows.values()):
                if metric in row.metrics:
                    axes.errorbar(
                        row.metrics[metric].mean, line, xerr=row.metrics[metric].std, color=colour, marker=marker,
                        markersize=5, linestyle="none", elinewidth=1.2, capsize=2, clip_on=False, zorder=3,
                        markerfacecolor="white" if row.paper else colour, label=PAPER if row.paper else within,
                    )  # fmt: skip
        axes.set_title(title)
        axes.set_xlabel("share")
        open_frame(axes)
        axes.grid(visible=False, axis="x")
    panels[0].set_xlim(right=1.0)
    panels[0].set_yticks(range(len(rows)), list(rows))
    panels[0].set_ylim(len(rows) - 0.5, -0.5)
    for tick, row in zip(panels[0].get_yticklabels(), rows.values(), strict=True):
        tick.set_color(MUTED if row.paper else INK)
    _legend(figure)
    return figure


def is_swept(table: SweepTable, key: str) -> bool:
    """Whether the table has several numeric values of the setting `key`."""
    values = [row.settings.get(key) for row in table.rows]
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    return numbers and len(set(values)) > 1


def label(settings: Mapping[str, Any]) -> str:
    """Describe settings briefly.

    >>> label({"solver.name": "two_stage", "solver.gamma": 0.3, "solver.second_stage": False})
    'two_stage, gamma 0.3, without second stage'
    """
    words = []
    for key, value in settings.items():
        last = heading(key).rpartition(".")[2].replace("_", " ")
        if isinstance(value, bool):
            words.append(f"{'with' if value else 'without'} {last}")
        else:
            words.append(shown(value) if key.endswith(".name") or key == "checkpoint" else f"{last} {shown(value)}")
    return ", ".join(words)


def _panels(table: SweepTable, axis: str) -> list[Panel]:
    if axis == "views":
        return [_panel(table, axis, name, {"": name}) for name in ("R@15", "R@30")]
    if axis == "start.count":
        first, *_, last = sorted({row.settings[axis] for row in table.rows})
        by_time = f"R@30 over time, from {shown(first)} to {shown(last)} starts"
        by_count = _panel(table, axis, "R@30 over the number of starts", {"": "R@30"})
        return [by_count, _panel(table, axis, by_time, {"": "R@30"}, by_time=True)]
    if len(table.groups_along(axis)) > 1:  # one colour each
        return [_panel(table, axis, f"{title}, {WITHIN[-1]}", {"": each[-1]}) for title, each in PANELS.items()]
    return [_panel(table, axis, title, dict(zip(WITHIN, each, strict=True))) for title, each in PANELS.items()]


def _panel(table: SweepTable, axis: str, title: str, metrics: Mapping[str, str], by_time: bool = False) -> Panel:
    """One curve per combination of settings other than `axis` and per metric (label to name), ours and the paper's."""
    curves, over = [], None if by_time else axis
    for rows in table.groups_along(axis):
        words = label({key: value for key, value in rows[0].settings.items() if key != axis})
        comparable = [each for row in rows for each in table.paper_rows(row.settings)]
        for extra, name in metrics.items():
            curve_label = ", ".join(filter(None, [words, extra]))
            curves.append(_curve(curve_label, rows, over, name))
            if published := [each for each in comparable if name in each.metrics]:
                curves.append(_curve(curve_label, published, over, name))
    return Panel(title, TIME if by_time else AXES[axis], curves)


def _curve(title: str, rows: Sequence[Row], axis: str | None, metric: str) -> Curve:
    """A metric of rows over the setting `axis`, or over seconds per pair."""
    x = [row.metrics.get(SECONDS, Spread(math.nan)).mean if axis is None else float(row.settings[axis]) for row in rows]
    values = [row.metrics[metric] for row in rows]
    mean, std = (np.array([getattr(each, part) for each in values]) for part in ("mean", "std"))
    return Curve(title, np.array(x), mean, std, rows[0].paper)


def _side_by_side(panels: int, height: float, sharex: bool = False) -> tuple[Figure, Sequence[Axes]]:
    figure = Figure(figsize=(8.0, height))
    figure.set_layout_engine("constrained", wspace=0.05)
    return figure, figure.subplots(1, panels, sharex=sharex, sharey=True, squeeze=False)[0]


def _legend(figure: Figure) -> None:
    """Add a legend above the panels, with as many columns as fit in 120 characters; each mark takes the width of 9."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    keys = dict(sorted(zip(labels, handles, strict=True), key=lambda key: key[0] == PAPER))  # last
    if keys:
        columns = max(1, min(len(keys), 120 // (max(map(len, keys)) + 9)))
        figure.legend(keys.values(), keys.keys(), loc="outside upper left", ncols=columns, columnspacing=1.6)
