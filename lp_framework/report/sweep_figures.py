"""The figures of a sweep's table: which ones, and what goes into them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS
from lp_framework.report.paper import PaperRow
from lp_framework.report.printed_tables import heading, shown
from lp_framework.report.sweep_tables import Row, SweepTable
from lp_framework.viz.sweeps import COLOURS, Curve, Entry, Panel, curves_figure, entries_figure

AXES = ("views", "start.count", "solver.gamma")  # numbers with a figure of their own, the first that varies wins
RECALL, SUCCESS = ([f"{prefix}@{degrees}" for degrees in ROTATION_THRESHOLDS] for prefix in ("R", "SR"))
PANELS = {"Recall R (chosen start)": RECALL, "Success rate SR (all starts)": SUCCESS}
WITHIN = [f"within {degrees}°" for degrees in ROTATION_THRESHOLDS]
NOISE = "noise scale \u03b3 of the longitude"
TIME = "seconds a pair (log scale)"
SECONDS, SOLVER = "seconds_per_pair", "solver.name"
ROTATION_RECALL = [f"R(R)@{degrees}" for degrees in ROTATION_THRESHOLDS]


def sweep_figure(table: SweepTable) -> Figure | None:
    """What the settings that vary call for: shares over a number, or the rows beside each other; None for one row."""
    paper = "the paper: other data, other prior"
    axis = next((key for key in AXES if is_swept(table, key)), None)
    if axis is not None and len(table.apart_from(axis)) <= len(COLOURS):
        return curves_figure(_panels(table, axis), paper)
    if len(table.rows) < 2 and table.paper is None:
        return None
    entries = []
    told: list[PaperRow] = []
    for row, beside in table.beside_paper():
        if row is not None:
            entries.append(Entry(label(row.settings), row.means, row.stds))
        entries += [Entry(f"paper: {each.label}", each.metrics, {}, paper=True) for each in beside if each not in told]
        told += beside
    return entries_figure(entries, PANELS, paper)


def cost_figure(table: SweepTable) -> Figure | None:
    """Rotation recall of each solver against its seconds a pair; None where there is one solver, where there are more
    rows than colours, or where the table's own figure has the time.
    """
    solvers = [row.settings.get(SOLVER) for row in table.rows]
    if len(set(solvers)) < 2 or len(table.rows) > len(COLOURS) or is_swept(table, "start.count"):
        return None
    marks = [(_called(table, row), row) for row in table.rows]
    panels = []
    for name in ROTATION_RECALL:
        curves = [_curve(words, [(row.means[SECONDS], row.means[name], row.stds[name])]) for words, row in marks]
        panels.append(Panel(name, TIME, curves, logarithmic=True))
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
    words = []
    switches = {_last(key): value for key, value in settings.items() if isinstance(value, bool)}
    for key, value in settings.items():
        if not isinstance(value, bool):
            named = key.endswith(".name") or key == "checkpoint"
            words.append(shown(value) if named else f"{_last(key)} {shown(value)}")
    if switches and all(switches.values()):
        words.append(" and ".join(switches))
    elif switches:
        words.append("without " + " or ".join(name for name, on in switches.items() if not on))
    return ", ".join(words)


def _last(key: str) -> str:
    """The last part of a dotted key, in words."""
    return heading(key).rpartition(".")[2].replace("_", " ")


def _called(table: SweepTable, row: Row) -> str:
    """A row by its solver, and by what differs among the rows of that."""
    siblings = [each.settings for each in table.rows if each.settings.get(SOLVER) == row.settings.get(SOLVER)]
    told = {key: value for key, value in row.settings.items() if any(each.get(key) != value for each in siblings)}
    return label({SOLVER: row.settings.get(SOLVER), **told})


def _panels(table: SweepTable, axis: str) -> list[Panel]:
    if axis == "views":
        return [Panel(name, "number of images", _curves(table, axis, {"": name})) for name in ("R@15", "R@30")]
    if axis == "start.count":
        count = _curves(table, axis, {"": "R@30"})
        time = _curves(table, axis, {"": "R@30"}, lambda _, metrics: metrics.get(SECONDS, math.nan))
        time = [
            replace(b, words=[shown(a.x[0]), *[""] * (len(a.x) - 2), shown(a.x[-1])])
            for a, b in zip(count, time, strict=True)
        ]
        first, *_, last = sorted({row.settings[axis] for row in table.rows})
        title = f"R@30 by time, from {shown(first)} to {shown(last)} starts"
        return [Panel("R@30 by number of starts", "number of starts", count), Panel(title, TIME, time, True)]
    if len(table.apart_from(axis)) > 1:  # a colour each
        return [
            Panel(f"{title}, {WITHIN[-1]}", NOISE, _curves(table, axis, {"": names[-1]}))
            for title, names in PANELS.items()
        ]
    return [
        Panel(title, NOISE, _curves(table, axis, dict(zip(WITHIN, names, strict=True))))
        for title, names in PANELS.items()
    ]


def _curves(
    table: SweepTable,
    axis: str,
    metrics: Mapping[str, str],
    place: Callable[[Any, Mapping[str, float]], float] = lambda value, _: float(value),
) -> list[Curve]:
    """A curve for each of the settings besides `axis` and each of `metrics` (label to name), ours and the paper's.

    `place` gives the horizontal position of a row by its value of `axis` and its metrics.
    """
    curves = []
    for rows in table.apart_from(axis):
        words = label({key: value for key, value in rows[0].settings.items() if key != axis})
        paper = [each for row in rows for each in table.papers(row.settings)]
        for extra, name in metrics.items():
            title = ", ".join(filter(None, [words, extra]))
            ours = [(place(row.settings[axis], row.means), row.means[name], row.stds[name]) for row in rows]
            theirs = [
                (place(each.settings[axis], each.metrics), each.metrics[name], math.nan)
                for each in paper
                if name in each.metrics
            ]
            curves.append(_curve(title, ours))
            curves += [_curve(title, theirs, paper=True)] if theirs else []
    return curves


def _curve(title: str, points: Sequence[tuple[float, float, float]], paper: bool = False) -> Curve:
    """A curve through points: where they are, mean and standard deviation."""
    x, mean, std = np.array(points).T
    return Curve(title, x, mean, std, paper)
