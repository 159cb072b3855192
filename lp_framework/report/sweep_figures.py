"""The figure of a sweep's table: which one, and what goes into it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS
from lp_framework.report.printed_tables import heading, shown
from lp_framework.report.sweep_tables import Row, SweepTable
from lp_framework.viz.sweeps import COLOURS, Curve, Entry, Panel, curves_figure, entries_figure

AXES = ("views", "start.count", "solver.gamma")  # numbers with a figure of their own, the first that varies wins
RECALL, SUCCESS = ([f"{prefix}@{degrees}" for degrees in ROTATION_THRESHOLDS] for prefix in ("R", "SR"))
PANELS = {"Recall R (chosen start)": RECALL, "Success rate SR (all starts)": SUCCESS}
NOISE = "noise scale \u03b3 of the longitude"
SECONDS, SOLVER = "seconds_per_pair", "solver.name"
ROTATION_RECALL = [f"R(R)@{degrees}" for degrees in ROTATION_THRESHOLDS]


def sweep_figure(table: SweepTable) -> Figure | None:
    """What the settings that vary call for: shares over a number, or the rows beside each other; None for one row."""
    axis = next((key for key in AXES if is_swept(table, key)), None)
    paper = "the paper: other data, other prior"
    if axis is not None and len({label(_others(row, axis)) for row in table.rows}) <= len(COLOURS):
        return curves_figure(_panels(table, axis), paper)
    rest = list(table.paper.rows) if table.paper is not None else []
    if len(table.rows) < 2 and not rest:
        return None
    entries = []
    for row in table.rows:
        means = {name: each.mean for name, each in row.metrics.items()}
        stds = {name: math.nan if each.std is None else each.std for name, each in row.metrics.items()}
        entries.append(Entry(label(row.settings), means, stds))
        beside = [each for each in rest if each in (table.paper.matching(row.settings) if table.paper else [])]
        entries += [Entry(f"paper: {each.label}", each.metrics, {}, paper=True) for each in beside]
        rest = [each for each in rest if each not in beside]
    entries += [Entry(f"paper: {each.label}", each.metrics, {}, paper=True) for each in rest]
    return entries_figure(entries, PANELS, paper)


def cost_figure(table: SweepTable) -> Figure | None:
    """Rotation recall of each solver against its seconds a pair; None where there is one solver, where there are more
    rows than colours, or where the table's own figure has the time.
    """
    solvers = [row.settings.get(SOLVER) for row in table.rows]
    if len(set(solvers)) < 2 or len(table.rows) > len(COLOURS) or is_swept(table, "start.count"):
        return None
    panels = [
        Panel(name, "seconds a pair (log scale)", [_mark(table, row, name) for row in table.rows], logarithmic=True)
        for name in ROTATION_RECALL
    ]
    return curves_figure(panels, "")


def _mark(table: SweepTable, row: Row, name: str) -> Curve:
    """A metric of one row over its seconds, called by its solver and by what differs among the rows of that."""
    siblings = [each.settings for each in table.rows if each.settings.get(SOLVER) == row.settings.get(SOLVER)]
    told = {key: value for key, value in row.settings.items() if any(each.get(key) != value for each in siblings)}
    value = row.metrics[name]
    return Curve(
        label({SOLVER: row.settings.get(SOLVER), **told}),
        np.array([row.metrics[SECONDS].mean]),
        np.array([value.mean]),
        np.array([math.nan if value.std is None else value.std]),
    )


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
        if isinstance(value, bool):
            continue
        words.append(shown(value) if key.endswith(".name") or key == "checkpoint" else f"{_last(key)} {shown(value)}")
    if switches and all(switches.values()):
        words.append(" and ".join(switches))
    elif switches:
        words.append("without " + " or ".join(name for name, on in switches.items() if not on))
    return ", ".join(words)


def _panels(table: SweepTable, axis: str) -> list[Panel]:
    if axis == "views":
        return [Panel(name, "number of images", _curves(table, axis, {"": name})) for name in ("R@15", "R@30")]
    if axis == "start.count":
        count = _curves(table, axis, {"": "R@30"})
        time = [
            replace(curve, words=[shown(numbers.x[0]), *[""] * (len(numbers.x) - 2), shown(numbers.x[-1])])
            for curve, numbers in zip(
                _curves(table, axis, {"": "R@30"}, lambda _, metrics: metrics.get(SECONDS, math.nan)),
                count,
                strict=True,
            )
        ]
        counts = [row.settings[axis] for row in table.rows]
        return [
            Panel("R@30 by number of starts", "number of starts", count),
            Panel(
                f"R@30 by time, from {shown(min(counts))} to {shown(max(counts))} starts",
                "seconds a pair (log scale)",
                time,
                logarithmic=True,
            ),
        ]
    several = len({label(_others(row, axis)) for row in table.rows}) > 1
    if several:  # a colour each
        chosen = {title: {"": names[-1]} for title, names in PANELS.items()}
        return [
            Panel(
                f"{title}, within {ROTATION_THRESHOLDS[-1]}°",
                NOISE,
                _curves(table, axis, names),
            )
            for title, names in chosen.items()
        ]
    within = [f"within {degrees}°" for degrees in ROTATION_THRESHOLDS]
    return [
        Panel(title, NOISE, _curves(table, axis, dict(zip(within, names, strict=True))))
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
    groups: dict[str, list[Row]] = {}
    for row in table.rows:
        groups.setdefault(label(_others(row, axis)), []).append(row)
    curves = []
    for words, rows in groups.items():
        paper = [each for row in rows for each in (table.paper.matching(row.settings) if table.paper else [])]
        for extra, name in metrics.items():
            title = ", ".join(filter(None, [words, extra]))
            x = [place(row.settings[axis], {key: each.mean for key, each in row.metrics.items()}) for row in rows]
            stds = [row.metrics[name].std for row in rows]
            curves.append(
                Curve(title, np.array(x), np.array([row.metrics[name].mean for row in rows]),
                      np.array([math.nan if std is None else std for std in stds]))
            )  # fmt: skip
            theirs = [each for each in paper if name in each.metrics]
            if theirs:
                x = [place(each.settings[axis], each.metrics) for each in theirs]
                means = np.array([each.metrics[name] for each in theirs])
                curves.append(Curve(title, np.array(x), means, np.full(len(means), math.nan), paper=True))
    return curves


def is_swept(table: SweepTable, key: str) -> bool:
    """Whether the table has several numbers of the setting `key`."""
    values = [row.settings.get(key) for row in table.rows]
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    return numbers and len(set(values)) > 1


def _others(row: Row, axis: str) -> dict[str, Any]:
    return {key: value for key, value in row.settings.items() if key != axis}


def _last(key: str) -> str:
    """The last part of a dotted key, in words."""
    return heading(key).rpartition(".")[2].replace("_", " ")
