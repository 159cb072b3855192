"""The prior's energy around a pair of views: as a surface, and as a map with the ways that a solver took over it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator, MultipleLocator, StrMethodFormatter
from mpl_toolkits.mplot3d import Axes3D  # type: ignore[import-untyped]
from numpy.typing import NDArray

from lp_framework.evaluation.landscape import FLAT, Landscape, LandscapeMinimum
from lp_framework.viz import fields
from lp_framework.viz.fields import CHOSEN_MARK, END_MARK, START_MARK, TRUTH_MARK, FieldMap
from lp_framework.viz.style import ANSWER, FAINT, INK, MUTED, place_axes, show_image, styled

# From dark valleys to light heights, evenly in lightness, so that grey and any kind of colour vision see the same.
RELIEF = "cividis"
LEVELS = 9  # contour lines
NOWHERE = np.full(3, np.nan)
MINIMUM_MARK: dict[str, Any] = {
    "marker": "+", "markersize": 9, "markeredgecolor": "white", "markeredgewidth": 1.3,
    "path_effects": [withStroke(linewidth=2.5, foreground=INK)],
}  # fmt: skip


@styled
def surface_figure(landscape: Landscape, truth: NDArray | None = None, title: str = "") -> Figure:
    """The landscape in 3-D over its own map; the true relative pose `[3]` (radians) is marked on both."""
    figure = Figure(figsize=(4.8, 3.6))
    axes = figure.add_axes((-0.02, -0.03, 0.98, 1.05), projection="3d")
    assert isinstance(axes, Axes3D)
    draw_surface(axes, landscape, truth)
    figure.text(0.02, 0.97, title, fontsize=10, fontweight="bold", va="top")
    return figure


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
        axes.plot(*([each] for each in place), [floor], linestyle="none", zorder=11, **TRUTH_MARK)
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
        axis.set_major_formatter(StrMethodFormatter("{x:g}\u00b0"))
    axes.set_zticks([each for each in MaxNLocator(4).tick_values(low, high) if low <= each <= high])
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.pane.set_visible(False)
        axis._axinfo["grid"].update(color=FAINT, linewidth=0.4)


@styled
def map_figure(
    landscape: Landscape,
    trajectories: NDArray | None = None,
    truth: NDArray | None = None,
    chosen: int | None = None,
    title: str = "",
) -> Figure:
    """The landscape from above, with trajectories `[N, S, 3]` (radians, longitudes unreduced) and the truth `[3]`.

    The trajectory `chosen` is the solver's answer. Local minima are marked.
    """
    wide, high = 4.6, 4.6 * _limit(landscape) / 180
    width, height = LABELS + wide + BAR, (CAPTION if title else SIDE) + high + BELOW
    figure = Figure(figsize=(width, height))
    axes = place_axes(figure, LABELS, BELOW, wide, high)
    relief = draw_map(axes, landscape, trajectories, truth, chosen, title)
    _finish(figure, axes, relief, _keys(landscape, trajectories, truth, chosen))
    return figure


# Inches: the page's width, the sides of both images and of the largest view, and the room between things.
WIDTH, IMAGE, LARGEST_VIEW, SIDE, TOP, CAPTION, LABELS, BAR = 8.0, 1.72, 1.2, 0.1, 0.74, 0.2, 0.62, 0.78
BELOW = 0.66  # the map: its labels and its key


@styled
def pair_figure(
    reference: NDArray,
    query: NDArray,
    landscape: Landscape,
    trajectories: NDArray | None,
    truth: NDArray | None,
    chosen: int | None,
    views: Sequence[NDArray],
    captions: Sequence[str],
    title: str,
    note: str,
    heading: str = "",
) -> Figure:
    """The paper's Figure 2: both images `[H, W, 3]`, the map, and below it what the prior generates at the ends.

    `views` are N images, one a trajectory, with their captions; `heading` is the map's; the rest is as for
    `map_figure`.
    """
    left = SIDE + IMAGE + LABELS
    wide = WIDTH - left - BAR
    high = wide * _limit(landscape) / 180
    columns = max(1, min(len(views), 5))
    view = min(LARGEST_VIEW, (wide - 0.1 * (columns - 1)) / columns)
    rows = -(-len(views) // columns)
    content = max(2 * IMAGE + CAPTION, high + BELOW + bool(views) * CAPTION + rows * (view + CAPTION))
    height = TOP + content + SIDE
    figure = Figure(figsize=(WIDTH, height))

    def place(x: float, down: float, across: float, tall: float) -> Axes:
        return figure.add_axes((x / WIDTH, 1 - (TOP + down + tall) / height, across / WIDTH, tall / height))

    show_image(place(SIDE, 0.0, IMAGE, IMAGE), reference, "reference")
    show_image(place(SIDE, content - IMAGE, IMAGE, IMAGE), query, "query")
    axes = place(left, 0.0, wide, high)
    relief = draw_map(axes, landscape, trajectories, truth, chosen, heading)
    _finish(figure, axes, relief, _keys(landscape, trajectories, truth, chosen))
    if views:
        lowest = (SIDE + rows * (view + CAPTION) + 0.05) / height
        figure.text(left / WIDTH, lowest, "Generated at the ends of the trajectories, by their starts", va="bottom")
    for number, (image, caption) in enumerate(zip(views, captions, strict=True)):
        row, column = divmod(number, columns)
        down = content - (rows - row) * (view + CAPTION) + CAPTION
        cell = place(left + column * (wide - view) / max(1, columns - 1), down, view, view)
        show_image(cell, image, caption)
        if number == chosen:
            cell.spines[:].set(color=ANSWER, linewidth=1.6)
    figure.text(SIDE / WIDTH, 1 - 0.1 / height, title, fontsize=10, fontweight="bold", va="top")
    figure.text(SIDE / WIDTH, 1 - 0.3 / height, note, color=MUTED, va="top")
    return figure


def draw_map(
    axes: Axes,
    landscape: Landscape,
    trajectories: NDArray | None = None,
    truth: NDArray | None = None,
    chosen: int | None = None,
    title: str = "",
) -> ScalarMappable:
    """Draw what `map_figure` shows into `axes`; returns what a colour bar needs. One-pose trajectories are ends."""
    latitude, longitude, energy = closed(landscape)
    relief = axes.pcolormesh(longitude, latitude, energy, cmap=RELIEF, shading="gouraud", zorder=0)
    if np.nanmax(energy) > np.nanmin(energy):
        axes.contour(longitude, latitude, energy, levels=LEVELS, colors="white", linewidths=0.4, alpha=0.55, zorder=0.5)
    for minimum in _marked(landscape):
        axes.plot(
            math.degrees(minimum.longitude), math.degrees(minimum.latitude), linestyle="none", zorder=2,
            **MINIMUM_MARK,
        )  # fmt: skip
    way = FieldMap(title)
    if trajectories is not None:
        walked = trajectories.shape[1] > 1
        way = FieldMap(
            title,
            starts=trajectories[:, 0] if walked else None,
            paths=trajectories if walked else None,
            ends=trajectories[:, -1],
            chosen=chosen,
        )
    fields.draw_map(axes, way, NOWHERE if truth is None else truth, _limit(landscape), greatest=0.0)
    axes.set_ylim(latitude[0], latitude[-1])
    return relief


def _finish(figure: Figure, axes: Axes, relief: ScalarMappable, keys: Sequence[Line2D]) -> None:
    """The map's labels, colour bar and key, around it."""
    width, height = figure.get_size_inches()
    box = axes.get_position()
    axes.set_xlabel("longitude of the query relative to the reference")
    axes.set_ylabel("latitude")
    bar_axes = figure.add_axes((box.x1 + 0.12 / width, box.y0, 0.1 / width, box.height))
    bar = figure.colorbar(relief, cax=bar_axes)
    bar.set_label("denoising error")
    bar_axes.locator_params(axis="y", nbins=5)
    bar_axes.spines[:].set_visible(False)
    figure.legend(
        handles=list(keys), loc="upper right", bbox_to_anchor=(box.x1, box.y0 - 0.42 / height), ncols=len(keys),
        columnspacing=1.3, handletextpad=0.3, borderaxespad=0.0, borderpad=0.0, handlelength=1.4,
    )  # fmt: skip


def _keys(
    landscape: Landscape, trajectories: NDArray | None, truth: NDArray | None, chosen: int | None
) -> list[Line2D]:
    """The key's entries, for what is drawn."""
    entries: list[tuple[bool, str, dict[str, Any]]] = [
        (truth is not None, "true pose", TRUTH_MARK),
        (chosen is not None, "answer", CHOSEN_MARK),
        (trajectories is not None and len(trajectories) > (chosen is not None), "end", END_MARK),
        (trajectories is not None and trajectories.shape[1] > 1, "start", START_MARK),
        (bool(_marked(landscape)), "local minimum", MINIMUM_MARK),
    ]
    return [Line2D([], [], linestyle="none", label=label, **mark) for shown, label, mark in entries if shown]


def _marked(landscape: Landscape) -> list[LandscapeMinimum]:
    """The minima that are marked: none on a plateau, where any place along the longitude would do."""
    return landscape.minima() if landscape.flatness() < FLAT else []


def _limit(landscape: Landscape) -> float:
    """The greatest latitude, degrees."""
    return math.degrees(landscape.latitude.abs().max().item())


def closed(landscape: Landscape) -> tuple[NDArray, NDArray, NDArray]:
    """Latitudes `[A]` and longitudes `[O + 1]` in degrees, and energies `[A, O + 1]`: 360 degrees is 0 again."""
    energy = landscape.energy.double().cpu().numpy()
    latitude, longitude = (np.rad2deg(each.double().cpu().numpy()) for each in landscape[:2])
    return latitude, np.append(longitude, 360.0), np.concatenate([energy, energy[:, :1]], axis=1)
