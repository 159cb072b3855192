"""How a training run went: losses and learning rate over the steps."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter
from numpy.typing import NDArray

from lp_framework.viz.style import BLUE, GREEN, INK, VERMILION, open_frame, save_figure, styled

LOSSES = {"train/loss": (BLUE, "training loss"), "val/loss": (VERMILION, "validation loss"),
          "train/view_loss": (GREEN, "training, view readout")}  # fmt: skip


class Curve(NamedTuple):
    """A logged value: `step` `[S]` and `value` `[S]`."""

    step: NDArray
    value: NDArray


def read_losses(path: Path) -> tuple[dict[str, Curve], Curve | None]:
    """The curves of `LOSSES`, and the learning rate, in a `metrics.csv` of Lightning's CSV logger, over its `step`.

    Empty cells are left out; a file that is not there has no curves.
    """
    gathered: dict[str, list[tuple[float, float]]] = {}
    if path.is_file():
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                for name, cell in row.items():
                    if name != "step" and cell:
                        gathered.setdefault(name, []).append((float(row["step"]), float(cell)))
    curves = {name: Curve(*np.array(points).T) for name, points in gathered.items()}
    rate = next((curve for name, curve in curves.items() if name.startswith("lr-")), None)
    return {name: curves[name] for name in LOSSES if name in curves}, rate


def save_training_picture(folder: Path) -> list[Path]:
    """`training.png` and `.pdf` in a training run's folder, from its `metrics.csv`; none where nothing was logged."""
    losses, rate = read_losses(folder / "metrics.csv")
    return save_figure(training_figure(losses, rate), folder / "training")[:1] if losses else []


def running_mean(values: NDArray, window: int) -> NDArray:
    """Mean of the `window` values around each of `values` `[S]`; of fewer at the ends.

    >>> running_mean(np.array([1.0, 2.0, 6.0, 4.0]), 3)
    array([1.5, 3. , 4. , 5. ])
    """
    ones = np.ones(window)
    mean: NDArray = np.convolve(values, ones, mode="same") / np.convolve(np.ones_like(values), ones, mode="same")
    return mean


@styled
def training_figure(losses: Mapping[str, Curve], rate: Curve | None) -> Figure:
    """The losses by their logged names on a log scale, and below them the learning rate where there is one."""
    heights = [3.2] if rate is None else [3.2, 1.0]
    figure = Figure(figsize=(8.0, 3.0 if rate is None else 3.8), layout="constrained")
    panels = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    above = panels[0]
    if rate is not None:
        panels[1].plot(*rate, color=INK, linewidth=1.2)
        panels[1].set(ylabel="learning rate", ylim=(0, None))
        panels[1].ticklabel_format(axis="y", style="sci", scilimits=(0, 0))
    drawn = []
    for name, curve in losses.items():
        colour, label = LOSSES[name]
        window = len(curve.step) // 20
        if window > 1:
            # Single batches scatter: they stay visible, pale, behind their running mean.
            above.plot(*curve, color=colour, linewidth=0.6, alpha=0.3, zorder=1)
            curve, label = Curve(curve.step, running_mean(curve.value, window)), f"{label}, mean of {window} records"
        marker = "" if len(curve.step) > 30 else "o"
        above.plot(*curve, color=colour, label=label, clip_on=False, marker=marker, markersize=3.5)
        drawn.append(curve.value)
    shown = np.concatenate(drawn)
    shown = shown[np.isfinite(shown) & (shown > 0)]
    if len(shown):
        above.set_ylim(shown.min() / 1.6, shown.max() * 1.3)
    if "val/loss" in losses and np.isfinite(losses["val/loss"].value).any():
        step, value = losses["val/loss"]
        best = int(np.nanargmin(value))
        above.annotate(
            f"best {value[best]:.3g}", (step[best], value[best]), xytext=(0, 7), textcoords="offset points",
            ha="right", fontsize=7.5, color=VERMILION, zorder=5,
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
        )  # fmt: skip
    above.set(yscale="log", ylabel="loss (log scale)")
    above.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    above.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    above.yaxis.set_minor_locator(NullLocator())
    for axes in panels:
        open_frame(axes)
        axes.set_xlim(0, max(curve.step.max() for curve in losses.values()))
    above.legend(loc="lower left")
    panels[-1].set_xlabel("training step")
    return figure
