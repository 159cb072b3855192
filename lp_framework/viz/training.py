"""How a training run went: losses and learning rate over the steps."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter
from numpy.typing import NDArray

from lp_framework.viz.style import BLUE, GREEN, INK, MUTED, VERMILION, open_frame, styled

LOSSES = {"train/loss": (BLUE, "training loss"), "val/loss": (VERMILION, "validation loss"),
          "train/view_loss": (GREEN, "training, view readout")}  # fmt: skip


class Curve(NamedTuple):
    """A logged value: `step` `[S]` and `value` `[S]`."""

    step: NDArray
    value: NDArray


def read_curves(path: Path) -> dict[str, Curve]:
    """All columns of a `metrics.csv` of Lightning's CSV logger over its column `step`; empty cells are left out."""
    gathered: dict[str, list[tuple[float, float]]] = {}
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            for name, cell in row.items():
                if name != "step" and cell:
                    gathered.setdefault(name, []).append((float(row["step"]), float(cell)))
    return {name: Curve(*np.array(points).T) for name, points in gathered.items()}


@styled
def training_figure(losses: Mapping[str, Curve], rate: Curve | None) -> Figure:
    """The losses by their logged names on a log scale, and below them the learning rate where there is one."""
    figure = Figure(figsize=(8.0, 3.8 if rate is not None else 3.0), layout="constrained")
    if rate is None:
        above, panels = figure.subplots(), []
    else:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[3.2, 1])
        below.plot(*rate, color=INK, linewidth=1.2)
        below.set(ylabel="learning rate", ylim=(0, None))
        below.ticklabel_format(axis="y", style="sci", scilimits=(0, 0))
        panels = [below]
    for name, curve in losses.items():
        colour, label = LOSSES.get(name, (MUTED, name))
        marker = "o" if len(curve.step) <= 20 else ""
        above.plot(*curve, color=colour, label=label, clip_on=False, marker=marker, markersize=3.5)
    if "val/loss" in losses:
        step, value = losses["val/loss"]
        best = int(np.nanargmin(value))
        above.annotate(
            f"best {value[best]:.3g}", (step[best], value[best]), xytext=(0, 7), textcoords="offset points",
            ha="right", fontsize=7.5, color=VERMILION,
        )  # fmt: skip
    above.set(yscale="log", ylabel="loss (log scale)")
    above.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    above.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    above.yaxis.set_minor_locator(NullLocator())
    for axes in (above, *panels):
        open_frame(axes)
        axes.set_xlim(0, max(curve.step.max() for curve in losses.values()))
    above.legend(loc="lower left")
    (panels or [above])[-1].set_xlabel("training step")
    return figure
