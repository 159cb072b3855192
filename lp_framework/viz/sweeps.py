"""Figures of sweeps: shares over a number that was swept, and combinations of settings beside each other."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, LogLocator, NullFormatter, NullLocator, StrMethodFormatter
from numpy.typing import NDArray

from lp_framework.viz.style import BLUE, GREEN, INK, MUTED, ORANGE, PURPLE, VERMILION, open_frame, styled

COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, INK, MUTED)
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
PAPER = (0, (3, 2))  # dashes


@dataclass(frozen=True)
class Curve:
    """Means `[K]` with standard deviations `[K]` (NaN for a single run) over `x` `[K]`.

    Curves of one `label` share a colour; the paper's are dashed, with hollow marks.
    """

    label: str
    x: NDArray
    mean: NDArray
    std: NDArray
    paper: bool = False


@dataclass(frozen=True)
class Panel:
    """Curves over one axis: its label, and whether it is logarithmic."""

    title: str
    xlabel: str
    curves: Sequence[Curve]
    logarithmic: bool = False


@dataclass(frozen=True)
class Entry:
    """Shares by metric of one combination of settings, mean and standard deviation; or of a row of the paper."""

    label: str
    metrics: Mapping[str, tuple[float, float]]
    paper: bool = False


@styled
def curves_figure(panels: Sequence[Panel], paper: str) -> Figure:
    """Panels side by side on one axis of shares; `paper` says in the legend what the paper's curves are of."""
    figure = Figure(figsize=(8.0, 3.3), layout=ConstrainedLayoutEngine(wspace=0.05))
    row = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    drawn = [curve for panel in panels for curve in panel.curves]
    labels = list(dict.fromkeys(curve.label for curve in drawn))
    for axes, panel in zip(row, panels, strict=True):
        for curve in panel.curves:
            place, theirs = labels.index(curve.label) % len(COLOURS), curve.paper
            axes.errorbar(
                curve.x, curve.mean, yerr=None if theirs else curve.std, color=COLOURS[place], marker=MARKERS[place],
                markersize=4.5, markerfacecolor="white" if theirs else COLOURS[place], capsize=2, elinewidth=1.0,
                linestyle=PAPER if theirs else "-", linewidth=1.0 if theirs else 1.5, clip_on=False,
                zorder=2 if theirs else 3,
            )  # fmt: skip
        _across(axes, panel)
        axes.set_title(panel.title)
        open_frame(axes)
    values = np.concatenate([[*curve.mean, *(curve.mean - np.nan_to_num(curve.std))] for curve in drawn])
    row[0].set_ylim(_lowest(values, 0.2), 1.0)
    row[0].set_ylabel("share of pairs")
    keys = [_key(label, place % len(COLOURS)) for place, label in enumerate(labels)]
    _legend(figure, keys, paper if any(curve.paper for curve in drawn) else None, linestyle=PAPER)
    return figure


@styled
def entries_figure(entries: Sequence[Entry], panels: Mapping[str, Sequence[str]], paper: str) -> Figure:
    """A line an entry, from the top, in panels of metrics (title to names): a mark a metric at its share.

    `paper` says in the legend what the paper's entries, with hollow marks, are of.
    """
    figure = Figure(figsize=(8.0, 1.15 + 0.27 * len(entries)), layout=ConstrainedLayoutEngine(wspace=0.05))
    row = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    drawn = []
    for axes, (title, names) in zip(row, panels.items(), strict=True):
        for place, metric in enumerate(names):
            for line, entry in enumerate(entries):
                if metric in entry.metrics:
                    mean, std = entry.metrics[metric]
                    drawn.append(mean)
                    axes.errorbar(
                        mean, line, xerr=std, color=COLOURS[place], marker=MARKERS[place], markersize=5,
                        linestyle="none", elinewidth=1.2, capsize=2, clip_on=False, zorder=3,
                        markerfacecolor="white" if entry.paper else COLOURS[place],
                    )  # fmt: skip
        axes.set_title(title)
        axes.set_xlabel("share")
        open_frame(axes)
        axes.grid(visible=False, axis="x")
    row[0].set_xlim(_lowest(drawn, 0.3), 1.0)
    row[0].set_yticks(range(len(entries)), [entry.label for entry in entries])
    row[0].set_ylim(len(entries) - 0.5, -0.5)
    for tick, entry in zip(row[0].get_yticklabels(), entries, strict=True):
        tick.set_color(MUTED if entry.paper else INK)
    degrees = [name.partition("@")[2] for name in next(iter(panels.values()))]
    keys = [_key(f"within {each}°", place, linestyle="none", markersize=5) for place, each in enumerate(degrees)]
    _legend(figure, keys, paper if any(entry.paper for entry in entries) else None, linestyle="none", markersize=5)
    return figure


def _key(label: str, place: int, **more: Any) -> Line2D:
    return Line2D([], [], color=COLOURS[place], marker=MARKERS[place], label=label, **{"markersize": 4.5, **more})


def _legend(figure: Figure, keys: Sequence[Line2D], paper: str | None, **look: Any) -> None:
    """Above the panels, in as many columns as fit: about 120 letters, and each key's mark takes the room of 9."""
    if paper is not None:
        hollow = {"color": MUTED, "linewidth": 1.0, "marker": "o", "markersize": 4.5, "markerfacecolor": "white"}
        keys = [*keys, Line2D([], [], label=paper, **{**hollow, **look})]
    lengths = [len(str(key.get_label())) + 9 for key in keys]
    columns = len(keys) if sum(lengths) <= 120 else max(1, 120 // max(lengths))
    figure.legend(handles=keys, loc="outside upper left", ncols=columns, columnspacing=1.6)


def _across(axes: Axes, panel: Panel) -> None:
    """The horizontal axis: a tick for every value that was swept, or a logarithmic one."""
    axes.set_xlabel(panel.xlabel)
    if panel.logarithmic:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(10, subs=(1.0,), numticks=8))
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        axes.xaxis.set_major_locator(FixedLocator(sorted({float(x) for curve in panel.curves for x in curve.x})))
        axes.xaxis.set_minor_locator(NullLocator())
    axes.margins(x=0.08 if panel.logarithmic else 0.04)
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))


def _lowest(shares: Iterable[float], room: float) -> float:
    """Where an axis of shares begins: at a tenth, `room` tenths or more below the least of them, at most at 0.8."""
    least = min((share for share in shares if math.isfinite(share)), default=0.0)
    return min(0.8, max(0.0, math.floor(10 * least - room) / 10))
