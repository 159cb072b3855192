"""Figures of sweeps: shares over a number that was swept, and combinations of settings beside each other."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

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
    """Means `[K]` with standard deviations `[K]` (NaN for a single run) over `x` `[K]`, and a word at each, if any.

    Curves of one `label` share a colour; the paper's are dashed, with hollow marks.
    """

    label: str
    x: NDArray
    mean: NDArray
    std: NDArray
    paper: bool = False
    words: Sequence[str] = ()


@dataclass(frozen=True)
class Panel:
    """Curves over one axis: its label, and whether it is logarithmic."""

    title: str
    xlabel: str
    curves: Sequence[Curve]
    logarithmic: bool = False


@dataclass(frozen=True)
class Entry:
    """Shares by metric of one combination of settings, means and standard deviations; or of a row of the paper."""

    label: str
    means: Mapping[str, float]
    stds: Mapping[str, float]
    paper: bool = False


@styled
def curves_figure(panels: Sequence[Panel], paper: str) -> Figure:
    """Panels side by side on one axis of shares; `paper` says in the legend what the paper's curves are of."""
    figure = Figure(figsize=(8.0, 3.3), layout=ConstrainedLayoutEngine(wspace=0.05))
    row = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    labels = list(dict.fromkeys(curve.label for panel in panels for curve in panel.curves))
    for axes, panel in zip(row, panels, strict=True):
        for curve in panel.curves:
            _draw_curve(axes, curve, labels.index(curve.label) % len(COLOURS))
        _across(axes, panel)
        axes.set_title(panel.title)
        open_frame(axes)
    drawn = [curve for panel in panels for curve in panel.curves]
    _shares(row[0], [value for curve in drawn for value in (*(curve.mean - np.nan_to_num(curve.std)), *curve.mean)])
    keys = [
        Line2D([], [], color=COLOURS[place % len(COLOURS)], marker=MARKERS[place % len(COLOURS)], markersize=4.5,
               label=label)
        for place, label in enumerate(labels)
    ]  # fmt: skip
    if any(curve.paper for curve in drawn):
        keys.append(
            Line2D([], [], color=MUTED, linestyle=PAPER, linewidth=1.0, marker="o", markersize=4.5,
                   markerfacecolor="white", label=paper)
        )  # fmt: skip
    _legend(figure, keys)
    return figure


@styled
def entries_figure(entries: Sequence[Entry], panels: Mapping[str, Sequence[str]], paper: str) -> Figure:
    """A line an entry, from the top, in panels of metrics (title to names): a mark a metric at its share.

    `paper` says in the legend what the paper's entries, with hollow marks, are of.
    """
    figure = Figure(figsize=(8.0, 1.15 + 0.27 * len(entries)), layout=ConstrainedLayoutEngine(wspace=0.05))
    row = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    shown = []
    for axes, (title, metrics) in zip(row, panels.items(), strict=True):
        for place, metric in enumerate(metrics):
            colour, marker = COLOURS[place], MARKERS[place]
            for line, entry in enumerate(entries):
                if metric not in entry.means:
                    continue
                shown.append(entry.means[metric])
                axes.errorbar(
                    entry.means[metric], line, xerr=entry.stds.get(metric, math.nan), color=colour, marker=marker,
                    markersize=5, markerfacecolor="white" if entry.paper else colour, linestyle="none", elinewidth=1.2,
                    capsize=2, clip_on=False, zorder=3,
                )  # fmt: skip
        axes.set_title(title)
        axes.set_xlabel("share")
        open_frame(axes)
        axes.grid(visible=False, axis="x")
    row[0].set_yticks(range(len(entries)), [entry.label for entry in entries])
    row[0].set_ylim(len(entries) - 0.5, -0.5)
    row[0].set_xlim(min(0.8, max(0.0, math.floor(10 * min(shown) - 0.3) / 10)) if shown else 0.0, 1.0)
    for tick, entry in zip(row[0].get_yticklabels(), entries, strict=True):
        tick.set_color(MUTED if entry.paper else INK)
    degrees = [name.partition("@")[2] for name in next(iter(panels.values()))]
    keys = [
        Line2D([], [], color=COLOURS[place], marker=MARKERS[place], markersize=5, linestyle="none",
               label=f"within {each}°")
        for place, each in enumerate(degrees)
    ]  # fmt: skip
    if any(entry.paper for entry in entries):
        keys.append(
            Line2D(
                [], [], color=MUTED, marker="o", markersize=5, markerfacecolor="white", linestyle="none", label=paper
            )
        )
    _legend(figure, keys)
    return figure


def _draw_curve(axes: Axes, curve: Curve, place: int) -> None:
    colour, marker = COLOURS[place], MARKERS[place]
    axes.errorbar(
        curve.x, curve.mean, yerr=None if curve.paper else curve.std, color=colour, marker=marker, markersize=4.5,
        markerfacecolor="white" if curve.paper else colour, linestyle=PAPER if curve.paper else "-",
        linewidth=1.0 if curve.paper else 1.5, capsize=2, elinewidth=1.0, clip_on=False, zorder=2 if curve.paper else 3,
    )  # fmt: skip
    for x, y, word in zip(curve.x, curve.mean, curve.words, strict=False):
        axes.annotate(word, (x, y), (5, -9), textcoords="offset points", fontsize=6.5, color=MUTED)


def _legend(figure: Figure, keys: Sequence[Line2D]) -> None:
    """Above the panels, in as many columns as fit: about 120 letters, and each key's mark takes the room of 9."""
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
        axes.margins(x=0.08)
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    else:
        axes.xaxis.set_major_locator(FixedLocator(sorted({float(x) for curve in panel.curves for x in curve.x})))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.margins(x=0.04)


def _shares(axes: Axes, values: Sequence[float]) -> None:
    """The vertical axis: up to 1, from the tenth below the least of `values`."""
    least = min((value for value in values if math.isfinite(value)), default=0.0)
    axes.set_ylim(min(0.8, max(0.0, math.floor(10 * least - 0.2) / 10)), 1.0)
    axes.set_ylabel("share of pairs")
