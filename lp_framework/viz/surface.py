"""Landscapes in 3-D over their own maps."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, MultipleLocator, StrMethodFormatter
from mpl_toolkits.mplot3d import Axes3D  # type: ignore[import-untyped]
from numpy.typing import NDArray

from lp_framework.analysis.landscapes import Landscape
from lp_framework.viz.maps import LEVELS, RELIEF, TRUTH_MARK, closed, small_marks
from lp_framework.viz.style import FAINT, INK, Sheet, styled


@styled
def surface_figure(landscape: Landscape, truth: NDArray | None = None, title: str = "") -> Figure:
    """The landscape in 3-D over its own map; the true relative pose `[3]` (radians) is marked on both."""
    sheet = Sheet(4.8, 3.6)
    draw_surface(sheet.axes(-0.096, -0.072, 4.704, 3.78, projection="3d"), landscape, truth)
    sheet.head(title)
    return sheet.figure


def small_surface(
    sheet: Sheet, x: float, y: float, wide: float, tall: float, landscape: Landscape, truth: NDArray | None
) -> Axes3D:
    """A landscape as a small surface that fills a box of the sheet, in its own range."""
    axes: Axes3D = sheet.axes(x, y, wide, tall, projection="3d")
    draw_surface(axes, landscape, truth)
    axes.set(xlabel="", ylabel="", zlabel="", xticks=[0, 90, 180, 270], yticks=[-30, 30])
    axes.patch.set_visible(False)
    axes.tick_params(labelsize=6, pad=-4)
    axes.locator_params(axis="z", nbins=3)
    axes.set_box_aspect((2.0, 1.2, 0.95), zoom=1.16)  # axes in 3-D leave wide margins
    small_marks(axes)
    return axes


def draw_surface(axes: Axes3D, landscape: Landscape, truth: NDArray | None = None) -> None:
    """Draw what `surface_figure` shows into axes of projection `3d`."""
    latitude, longitude, energy = closed(landscape)
    low, high = float(np.nanmin(energy)), float(np.nanmax(energy))
    relief = (high - low) or 1.0
    floor = low - 0.45 * relief
    x, y = np.meshgrid(longitude, latitude)
    axes.plot_surface(
        x, y, energy, cmap=RELIEF, vmin=low, vmax=low + relief, rstride=1, cstride=1, edgecolor="white",
        linewidth=0.15, antialiased=True, shade=False,
    )  # fmt: skip
    levels = np.linspace(low, low + relief, 2 * LEVELS)
    axes.contourf(x, y, energy, levels=levels, zdir="z", offset=floor, cmap=RELIEF)
    axes.set(xlim=(0, 360), ylim=(latitude[0], latitude[-1]), zlim=(floor, low + relief))
    if truth is not None:
        place = math.degrees(truth[1]) % 360, math.degrees(truth[0])
        axes.plot(*([each, each] for each in place), [floor, low + relief], color=INK, linewidth=0.8, zorder=10)
        axes.plot(*([each] for each in place), [floor], zorder=11, **TRUTH_MARK)
    axes.view_init(elev=32, azim=-62)
    axes.set_box_aspect((2.0, 1.15, 0.95), zoom=1.04)
    axes.tick_params(pad=-2)
    axes.set_xlabel("relative longitude", labelpad=-2)
    axes.set_ylabel("relative latitude", labelpad=-2)
    axes.set_zlabel("denoising error", labelpad=-2)
    axes.xaxis.set_major_locator(MultipleLocator(60))
    # The corner belongs to 360 degrees.
    axes.set_yticks([each for each in range(-150, 180, 30) if latitude[0] + 1 < each < latitude[-1] + 1])
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(StrMethodFormatter("{x:g}°"))
    axes.set_zticks([each for each in MaxNLocator(4).tick_values(low, high) if low <= each <= high])
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.pane.set_visible(False)
        axis._axinfo["grid"].update(color=FAINT, linewidth=0.4)
