"""The figures of a sweep's table: which ones, and what goes into them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS
from lp_framework.report.sweep_tables import Row, Spread, SweepTable, heading, shown
from lp_framework.viz.sweeps import COLOURS, Curve, Entry, Panel, curves_figure, entries_figure

AXES = ("views", "start.count", "solver.gamma")  # numbers with a figure of their own, the first that varies wins
RECALL, SUCCESS, ROTATION_RECALL = (
    [f"{prefix}@{degrees}" for degrees in ROTATION_THRESHOLDS] for prefix in ("R", "SR", "R(R)")
)
PANELS = {"Recall R (chosen start)": RECALL, "Success rate SR (all starts)": SUCCESS}
WITHIN = [f"within {degrees}°" for degrees in ROTATION_THRESHOLDS]
NOISE = "noise scale \u03b3 of the longitude"
TIME = "seconds a pair (log scale)"
SECONDS, SOLVER = "seconds_per_pair", "solver.name"
NONE = Spread(math.nan, math.nan)


def sweep_figure(table: SweepTable) -> Figure | None:
    """What the settings that vary call for: shares over a number, or the rows beside each other; None for one row."""
    paper = "the paper: other data, other prior"
    axis = next((key for key in AXES if is_swept(table, key)), None)
    if axis is not None and len(table.apart_from(axis)) <= len(COLOURS):
        return curves_figure(_panels(table, axis), paper)
    if len(table.rows) < 2 and table.paper is None:
        return None
    entries: list[Entry] = []
    for row in table.with_paper():
        named = row.source if row.paper else label(row.settings)
        if named not in [entry.label for entry in entries]:
            entries.append(Entry(named, row.metrics, row.paper))
    return entries_figure(entries, PANELS, paper)


def cost_figure(table: SweepTable) -> Figure | None:
    """Rotation recall of each solver against its seconds a pair; None where there is one solver, where there are more
    rows than colours, or where the table's own figure has the time.
    """
    solvers = [row.settings.get(SOLVER) for row in table.rows]
    if len(set(solvers)) < 2 or len(table.rows) > len(COLOURS) or is_swept(table, "start.count"):
        return None
    panels = [
        Panel(name, TIME, [_curve(_called(table, row), [row], None, name) for row in table.rows], logarithmic=True)
        for name in ROTATION_RECALL
    ]
    return curves_figure(panels, "")


def is_swept(table: SweepTable, key: str) -> bool:
    """Whether the table has several numbers of the setting `key`."""
    values = [row.settings.get(key) for row in table.rows]
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    return numbers and len(set(values)) > 1


def label(settings: Mapping[str, Any]) -> str:
    """Settings in a few words.

    >>> label({"solver.name": "two_stage", "solver.gamma": 0.3})
    'two_stage, gamma 0.3'
    >>> label({"solver.first_stage": False, "solver.second_stage": True})
    'without first stage'
    >>> label({"solver.first_stage": True, "solver.second_stage": True})
    'first stage and second stage'
    """
    words, switches = [], {}
    for key, value in settings.items():
        last = heading(key).rpartition(".")[2].replace("_", " ")
        if isinstance(value, bool):
            switches[last] = value
        else:
            words.append(shown(value) if key.endswith(".name") or key == "checkpoint" else f"{last} {shown(value)}")
    if switches and all(switches.values()):
        words.append(" and ".join(switches))
    elif switches:
        words.append("without " + " or ".join(name for name, on in switches.items() if not on))
    return ", ".join(words)


def _called(table: SweepTable, row: Row) -> str:
    """A row by its solver, and by what differs among the rows of that."""
    siblings = [each.settings for each in table.rows if each.settings.get(SOLVER) == row.settings.get(SOLVER)]
    told = {key: value for key, value in row.settings.items() if any(each.get(key) != value for each in siblings)}
    return label({SOLVER: row.settings.get(SOLVER), **told})


def _panels(table: SweepTable, axis: str) -> list[Panel]:
    if axis == "views":
        return [_panel(table, axis, name, "number of images", {"": name}) for name in ("R@15", "R@30")]
    if axis == "start.count":
        first, *_, last = sorted({row.settings[axis] for row in table.rows})
        by_time = f"R@30 by time, from {shown(first)} to {shown(last)} starts"
        by_count = _panel(table, axis, "R@30 by number of starts", "number of starts", {"": "R@30"})
        return [by_count, _panel(table, axis, by_time, TIME, {"": "R@30"}, by_time=True)]
    if len(table.apart_from(axis)) > 1:  # a colour each
        return [_panel(table, axis, f"{title}, {WITHIN[-1]}", NOISE, {"": each[-1]}) for title, each in PANELS.items()]
    return [_panel(table, axis, title, NOISE, dict(zip(WITHIN, each, strict=True))) for title, each in PANELS.items()]


def _panel(
    table: SweepTable, axis: str, title: str, xlabel: str, metrics: Mapping[str, str], by_time: bool = False
) -> Panel:
    """A curve for each of the settings besides `axis` and each of `metrics` (label to name), ours and the paper's,
    over the values of `axis` or over the seconds a pair.
    """
    curves, over = [], None if by_time else axis
    for rows in table.apart_from(axis):
        words = label({key: value for key, value in rows[0].settings.items() if key != axis})
        papers = [each for row in rows for each in table.papers(row.settings)]
        for extra, name in metrics.items():
            called = ", ".join(filter(None, [words, extra]))
            curves.append(_curve(called, rows, over, name))
            if theirs := [each for each in papers if name in each.metrics]:
                curves.append(_curve(called, theirs, over, name))
    return Panel(title, xlabel, curves, logarithmic=by_time)


def _curve(title: str, rows: Sequence[Row], axis: str | None, metric: str) -> Curve:
    """A metric of rows over a setting, or over the seconds a pair."""
    x = [row.metrics.get(SECONDS, NONE).mean if axis is None else float(row.settings[axis]) for row in rows]
    mean, std = np.array([row.metrics[metric] for row in rows]).T
    return Curve(title, np.array(x), mean, std, rows[0].paper)
