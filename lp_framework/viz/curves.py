"""Figures with curves: errors of an evaluation, losses of a training run, the energy around objects."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FixedLocator, LogLocator, NullLocator, PercentFormatter, StrMethodFormatter
from numpy.typing import NDArray

from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS, TRANSLATION_THRESHOLD
from lp_framework.viz import style

NEAREST = 0.01  # scene units; start of the logarithmic axis of translation errors
DASHED: dict[str, Any] = {"linewidth": 1.0, "linestyle": (0, (3, 2)), "zorder": 2}
LOSSES = {"train/loss": (style.BLUE, "training loss"), "val/loss": (style.VERMILION, "validation loss"),
          "train/view_loss": (style.GREEN, "training loss of the view readout")}  # fmt: skip
COLUMNS = 4  # of objects


def cumulative(errors: NDArray, end: float) -> tuple[NDArray, NDArray]:
    """Empirical cumulative distribution of `errors` `[E]` from 0 to `end`: x and the share of errors <= x, `[U]` each.

    Draw it as a step function (`drawstyle="steps-post"`). NaN counts as an error beyond any x.

    >>> cumulative(np.array([3.0, 1.0, np.nan, 3.0]), 180.0)
    (array([  0.,   1.,   3., 180.]), array([0.  , 0.25, 0.75, 0.75]))
    """
    reached, counts = np.unique(errors[np.isfinite(errors) & (errors <= end)], return_counts=True)
    share = np.cumsum(counts) / max(1, errors.size)
    last = share[-1] if len(share) else 0.0
    return np.concatenate([[0.0], reached, [end]]), np.concatenate([[0.0], share, [last]])


@style.styled
def errors_figure(rotation: NDArray, translation: NDArray, chosen: NDArray, classes: Sequence[str]) -> Figure:
    """Share of pairs within an error, one curve per ambiguity class: the chosen start and, dashed, all starts if N > 1.

    Takes `rotation` (degrees) and `translation` (scene units) `[P, N]`, the chosen start `[P]`, and the class `[P]`.
    """
    figure = Figure(figsize=(8.0, 3.5))
    figure.set_layout_engine("constrained", wspace=0.06)
    left, right = figure.subplots(1, 2, width_ratios=[1.7, 1], sharey=True)
    several = rotation.shape[1] > 1
    keys = []
    for name in sorted(set(classes), key=list(style.CLASS_COLOURS).index):
        rows, colour = np.array(classes) == name, style.CLASS_COLOURS[name]
        for axes, errors, end in ((left, rotation, 180.0), (right, translation, 4.0)):
            answer = np.take_along_axis(errors[rows], chosen[rows, None], axis=1)
            stairs = {"color": colour, "drawstyle": "steps-post"}
            axes.plot(*cumulative(answer.ravel(), end), label=name, zorder=3, **stairs)
            if several:
                axes.plot(*cumulative(errors[rows].ravel(), end), label=f"{name}, all starts", **stairs, **DASHED)
        keys.append(Line2D([], [], color=colour, label=f"{name} ({rows.sum()} pairs)"))
    if several:
        keys.append(Line2D([], [], color=style.INK, label="chosen start"))
        keys.append(Line2D([], [], color=style.INK, label=f"all {rotation.shape[1]} starts", **DASHED))
    # Small errors matter most: a square-root axis gives them room and still starts at 0.
    left.set_xscale(
        "function", functions=(lambda x: np.sign(x) * np.sqrt(np.abs(x)), lambda x: np.sign(x) * np.square(x))
    )
    left.set(xlim=(0, 180), ylim=(0, 1.005), xlabel="rotation error (square-root scale)")
    left.set_ylabel("share of pairs within the error")
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
        style.open_frame(axes)
        for threshold in thresholds:
            axes.axvline(threshold, color=style.MUTED, linewidth=0.8, linestyle=(0, (1, 1.5)), zorder=1)
    figure.legend(handles=keys, loc="outside upper left", ncols=len(keys), columnspacing=1.6, handlelength=1.8)
    return figure


@style.styled
def calibration_figure(bins: Sequence[Mapping[str, float]], title: str) -> Figure:
    """Share of correct answers over their probability, for bins of `evaluation.breakdown`; areas show pair counts."""
    figure = Figure(figsize=(4.4, 4.4), layout="constrained")
    axes = figure.subplots()
    probability, right, pairs = (np.array([each[key] for each in bins]) for key in ("probability", "right", "pairs"))
    axes.plot([0, 1], [0, 1], color=style.MUTED, label="perfect calibration", **DASHED)
    axes.plot(probability, right, color=style.BLUE, zorder=3)
    axes.scatter(probability, right, 20 + 600 * pairs / pairs.sum(), color=style.BLUE, alpha=0.6, zorder=4, linewidth=0)
    axes.set(xlim=(0, 1), ylim=(0, 1.02), aspect="equal", xlabel="predicted probability")
    axes.set_ylabel("share within 30°")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(PercentFormatter(1.0))
    axes.set_title(title, loc="left")
    axes.legend(loc="upper left", frameon=False)
    style.open_frame(axes)
    return figure


class Curve(NamedTuple):
    """A logged value: `step` `[S]` and `value` `[S]`."""

    step: NDArray
    value: NDArray


def read_losses(path: Path) -> tuple[dict[str, Curve], Curve | None]:
    """Read the curves of `LOSSES` and the learning rate from Lightning's `metrics.csv`; none without this file."""
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
    """Draw `training.png` and `.pdf` from the `metrics.csv` in a training run's folder; none if nothing was logged."""
    losses, rate = read_losses(folder / "metrics.csv")
    return style.save_figure(training_figure(losses, rate), folder / "training")[:1] if losses else []


def running_mean(values: NDArray, window: int) -> NDArray:
    """Mean of the `window` values around each of `values` `[S]`; fewer at the ends.

    >>> running_mean(np.array([1.0, 2.0, 6.0, 4.0]), 3)
    array([1.5, 3. , 4. , 5. ])
    """
    ones = np.ones(window)
    return np.asarray(np.convolve(values, ones, "same") / np.convolve(np.ones_like(values), ones, "same"))


@style.styled
def training_figure(losses: Mapping[str, Curve], rate: Curve | None) -> Figure:
    """Plot the losses by their logged names on a log scale, and below them the learning rate, if any."""
    figure = Figure(figsize=(8.0, 3.0 if rate is None else 3.8), layout="constrained")
    heights = [1.0] if rate is None else [3.2, 1.0]
    above, *below = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    for name, curve in losses.items():
        colour, label = LOSSES[name]
        window = len(curve.step) // 20
        if window > 1:
            # Losses of single batches are noisy: draw them pale, behind their running mean.
            above.plot(*curve, color=colour, marker=".", markersize=2.5, linestyle="none", alpha=0.3, zorder=1)
            curve, label = Curve(curve.step, running_mean(curve.value, window)), f"{label}, mean over {window} values"
        marker = "" if len(curve.step) > 30 else "o"
        above.plot(*curve, color=colour, label=label, clip_on=False, marker=marker, markersize=3.5)
        if name == "val/loss" and np.isfinite(curve.value).any():
            best = int(np.nanargmin(losses[name].value))
            step, value = curve.step[best], losses[name].value[best]
            halo = [withStroke(linewidth=2.5, foreground="white")]
            above.annotate(f"best {value:.3g}", (step, value), (0, 7), textcoords="offset points", ha="right",
                           fontsize=7.5, color=colour, zorder=5, path_effects=halo)  # fmt: skip
    above.set(yscale="log", ylabel="loss (log scale)")
    above.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    above.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    above.yaxis.set_minor_locator(NullLocator())
    above.legend(loc="lower left")
    if rate is not None:
        (axes,) = below
        axes.plot(*rate, color=style.INK, linewidth=1.2)
        axes.set(ylabel="learning rate", ylim=(0, None))
        axes.ticklabel_format(axis="y", style="sci", scilimits=(0, 0))
    for axes in figure.axes:
        style.open_frame(axes)
        axes.set_xlim(0, max(curve.step.max() for curve in losses.values()))
    figure.axes[-1].set_xlabel("training step")
    return figure


@style.styled
def azimuth_figure(objects: Sequence[Mapping[str, Any]]) -> Figure:
    """One panel per object, with the truth and the share of pairs whose lowest energy is within 15 degrees of it.

    Each has `object` (name), `ambiguity`, that share as `within`, and its mean `energy` over `degrees` from the truth.
    """
    rows, columns = math.ceil(len(objects) / COLUMNS), min(COLUMNS, len(objects))
    figure = Figure(figsize=(2.1 * columns, 1.5 * rows + 0.2))
    figure.set_layout_engine("constrained", wspace=0.04, hspace=0.06)
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for axes, each in zip(grid.flat, objects, strict=False):
        style.open_frame(axes)
        axes.axvline(0, color=style.TRUTH, linewidth=2.5, alpha=0.8, zorder=1)
        # Close the circle: -180 and 180 are the same.
        place = [*each["degrees"], each["degrees"][0] + 360]
        above = np.array([*each["energy"], each["energy"][0]]) - min(each["energy"])
        axes.plot(place, above, color=style.CLASS_COLOURS[each["ambiguity"]], zorder=3)
        axes.set_title(f"{each['object'].replace('_', ' ')}, {each['within']:.0%}")
        axes.set_xlim(-180, 180)
        style.degrees(axes.xaxis, 90)
        axes.locator_params(axis="y", nbins=4)
    for axes in list(grid.flat)[len(objects) :]:
        axes.remove()
    figure.supxlabel("longitude from the truth; in titles: share of pairs with the lowest energy within 15°", size=8)
    figure.supylabel("denoising error above its minimum", size=8)
    keys = style.class_keys([each["ambiguity"] for each in objects])
    figure.legend(handles=keys, loc="outside upper center", ncols=len(keys), labelcolor=style.MUTED)
    return figure
