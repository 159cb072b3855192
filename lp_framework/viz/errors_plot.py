"""Errors of an evaluation: cumulative curves, and a contact sheet of the objects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, NullLocator, PercentFormatter, StrMethodFormatter
from numpy.typing import NDArray

from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS, TRANSLATION_THRESHOLD
from lp_framework.viz.style import CLASS_COLOURS, FAINT, INK, MUTED, Sheet, open_frame, shortened, styled

MOST_OBJECTS = 42  # on a contact sheet
NEAREST = 0.01  # scene units; where the logarithmic axis of translation errors begins
DASHED: dict[str, Any] = {"linewidth": 1.0, "linestyle": (0, (3, 2)), "zorder": 2}


def cumulative(errors: NDArray, end: float) -> tuple[NDArray, NDArray]:
    """The share of `errors` `[E]` that are at most x, as a staircase from 0 to `end`: x and share `[U]`.

    Between two points the share is that of the point before (`drawstyle="steps-post"`). What is NaN is never reached.

    >>> cumulative(np.array([3.0, 1.0, np.nan, 3.0]), 180.0)
    (array([  0.,   1.,   3., 180.]), array([0.  , 0.25, 0.75, 0.75]))
    """
    reached, counts = np.unique(errors[np.isfinite(errors) & (errors <= end)], return_counts=True)
    share = np.cumsum(counts) / max(1, errors.size)
    last = share[-1] if len(share) else 0.0
    return np.concatenate([[0.0], reached, [end]]), np.concatenate([[0.0], share, [last]])


@styled
def errors_figure(rotation: NDArray, translation: NDArray, chosen: NDArray, classes: Sequence[str]) -> Figure:
    """Share of pairs within an error, one curve an ambiguity class.

    `rotation` (degrees) and `translation` (scene units) `[P, N]`, the chosen start `[P]`, and every pair's class `[P]`.
    Solid: the chosen start. Dashed: all starts, where there are several.
    """
    figure = Figure(figsize=(8.0, 3.5), layout=ConstrainedLayoutEngine(wspace=0.06))
    left, right = figure.subplots(1, 2, width_ratios=[1.7, 1], sharey=True)
    several = rotation.shape[1] > 1
    labels = np.array(classes)
    keys = []
    for name in sorted(set(classes), key=list(CLASS_COLOURS).index):
        rows = labels == name
        colour = CLASS_COLOURS[name]
        for axes, errors, end in ((left, rotation, 180.0), (right, translation, 4.0)):
            answer = np.take_along_axis(errors[rows], chosen[rows, None], axis=1)
            stairs = {"color": colour, "drawstyle": "steps-post"}
            axes.plot(*cumulative(answer.ravel(), end), label=name, zorder=3, **stairs)
            if several:
                axes.plot(*cumulative(errors[rows].ravel(), end), label=f"{name}, all starts", **stairs, **DASHED)
        keys.append(Line2D([], [], color=colour, label=f"{name} ({rows.sum()} pairs)"))
    if several:
        keys.append(Line2D([], [], color=INK, label="chosen start"))
        keys.append(Line2D([], [], color=INK, label=f"all {rotation.shape[1]} starts", **DASHED))
    # Small errors matter most: a square-root axis gives them room and still begins at 0.
    left.set_xscale(
        "function", functions=(lambda x: np.sign(x) * np.sqrt(np.abs(x)), lambda x: np.sign(x) * np.square(x))
    )
    left.set(xlim=(0, 180), ylim=(0, 1.005), ylabel="share of pairs within the error")
    left.set_xlabel("rotation error (square-root scale)")
    left.yaxis.set_major_formatter(PercentFormatter(1.0))
    right.set_xscale("log")
    right.set(xlim=(NEAREST, 4), xlabel="translation error (object sizes, log scale)")
    for axes, thresholds, others, unit in (
        (left, ROTATION_THRESHOLDS, (0, 60, 90, 120, 180), "°"),
        (right, (TRANSLATION_THRESHOLD,), (0.01, 0.05, 1, 4), ""),
    ):
        axes.xaxis.set_major_locator(FixedLocator(sorted([*thresholds, *others])))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}" + unit))
        open_frame(axes)
        for threshold in thresholds:
            axes.axvline(threshold, color=MUTED, linewidth=0.8, linestyle=(0, (1, 1.5)), zorder=1)
    figure.legend(handles=keys, loc="outside upper left", ncols=len(keys), columnspacing=1.6, handlelength=1.8)
    return figure


@dataclass(frozen=True)
class ObjectCard:
    """An object on the contact sheet: a view `[H, W, 3]` of it, and its recall and success rate, if any, in [0, 1]."""

    name: str
    ambiguity: str
    image: NDArray
    recall: float
    success: float | None


@styled
def objects_figure(cards: Sequence[ObjectCard]) -> Figure:
    """The objects, worst recall first (then worst success rate, then by name); at most the worst `MOST_OBJECTS`."""
    ranked = sorted(cards, key=lambda card: (card.recall, card.success or 0.0, card.name))
    shown = ranked[:MOST_OBJECTS]
    columns = min(len(shown), 4 if len(shown) <= 8 else 6 if len(shown) <= 18 else 7)
    rows = math.ceil(len(shown) / columns)
    card, text, top, gap = min((8.0 - 0.1) / columns, 1.6), 0.62, 0.38, 0.12  # inches
    side = card - gap
    sheet = Sheet(8.0, top + rows * (side + text))
    left_out = len(ranked) - len(shown)
    sheet.head("Objects, worst first" + (f" (the {len(shown)} worst of {len(ranked)})" if left_out else ""))
    for index, each in enumerate(shown):
        row, column = divmod(index, columns)
        x, y = 0.1 + column * card, top + row * (side + text)
        sheet.image(x, y, side, each.image)
        _write_card(sheet.axes(x, y + side, side, text), each, side)
    mark: dict[str, Any] = {"linestyle": "none", "marker": "s", "markersize": 5}
    present = [name for name in CLASS_COLOURS if name in {each.ambiguity for each in shown}]
    keys = [Line2D([], [], color=CLASS_COLOURS[name], label=name, **mark) for name in present]
    sheet.legend(keys, 7.9, 0.08, columnspacing=1.2, handletextpad=0.2)
    return sheet.figure


def _write_card(axes: Axes, card: ObjectCard, side: float) -> None:
    """Name and class, then a bar and a number for each of the two shares; one data unit is an inch."""
    axes.set(xlim=(0, side), ylim=(0.62, 0))
    axes.axis("off")
    name = shortened(card.name.replace("_", " "), 14.5 * side)
    axes.text(0, 0.1, name, va="center", fontsize=7.5, fontweight="bold")
    axes.plot([side - 0.04], [0.1], marker="s", markersize=5, color=CLASS_COLOURS[card.ambiguity], clip_on=False)
    left, width = 0.5, side - 0.5 - 0.28
    for line, (label, share) in enumerate((("R(R)@15", card.recall), ("SR(R)@30", card.success))):
        if share is None:
            continue
        y = 0.25 + 0.14 * line
        axes.text(0, y, label, va="center", fontsize=6, color=MUTED)
        axes.barh(y, width, left=left, height=0.05, color=FAINT)
        axes.barh(y, width * share, left=left, height=0.05, color=INK)
        axes.text(side, y, f"{share:.2f}", va="center", ha="right", fontsize=6.5)
