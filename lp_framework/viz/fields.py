"""Score fields over longitude and latitude, with the way a solver took through them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.quiver import Quiver
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.viz.style import (
    ANSWER,
    DENSITY,
    FAINT,
    INK,
    MAGNITUDE,
    MUTED,
    OTHERS,
    TRUTH,
    degrees,
    place_axes,
    show_image,
    styled,
)

ARROW_SPACING, DENSITY_SPACING = 12.0, 3.0  # degrees
SEAM = 0.5  # degrees; what is nearer to the seam is drawn on both sides of it


@dataclass(frozen=True)
class Grid:
    """Values on a regular grid: `latitude` `[A]` and `longitude` `[O]` in degrees (centres of cells), `score`
    `[A, O, 3]` (latitude, longitude, radius; radians, scene units), `energy` `[A, O]` of models that have one.
    """

    latitude: NDArray
    longitude: NDArray
    score: NDArray
    energy: NDArray | None = None


@dataclass(frozen=True)
class FieldMap:
    """One map: its title, arrows, energy on a finer grid, and what a solver did there.

    `ends` `[N, 3]` final relative poses, `chosen` the index of the answer, `starts` `[N, 3]` and `paths`
    `[N, S, 3]` (longitudes unreduced) where known; radians.
    """

    title: str
    arrows: Grid | None = None
    density: Grid | None = None
    starts: NDArray | None = None
    paths: NDArray | None = None
    ends: NDArray | None = None
    chosen: int | None = None


def pose_grid(radius: float, spacing: float, limit: float = 60.0) -> Tensor:
    """Relative poses `[A, O, 3]` (radians) at the centres of cells of about `spacing` degrees, float32.

    The cells fill longitudes 0..360 and latitudes -`limit`..`limit` (degrees), at one relative radius.

    >>> torch.rad2deg(pose_grid(0.0, 60.0)[:, 0, :2])
    tensor([[-30.0000,  30.0000],
            [ 30.0000,  30.0000]])
    """
    rows, columns = max(1, round(2 * limit / spacing)), max(1, round(360 / spacing))
    latitude = (torch.arange(rows, dtype=torch.float64) + 0.5) * (2 * limit / rows) - limit
    longitude = (torch.arange(columns, dtype=torch.float64) + 0.5) * (360 / columns)
    plane = torch.stack(torch.meshgrid(latitude.deg2rad(), longitude.deg2rad(), indexing="ij"), dim=-1)
    return torch.cat([plane, torch.full_like(plane[..., :1], radius)], dim=-1).float()


def field_on_grid(
    field: Callable[[Tensor], tuple[Tensor, Tensor | None]], radius: float, spacing: float, limit: float = 60.0
) -> Grid:
    """A field on `pose_grid`; `field` maps relative poses `[A, O, 3]` to scores `[A, O, 3]` and energies `[A, O]`."""
    poses = pose_grid(radius, spacing, limit)
    score, energy = field(poses)
    return Grid(
        latitude=np.rad2deg(poses[:, 0, 0].numpy()),
        longitude=np.rad2deg(poses[0, :, 1].numpy()),
        score=score.detach().cpu().numpy(),
        energy=None if energy is None else energy.detach().cpu().numpy(),
    )


def broken_at_seam(latitude: NDArray, longitude: NDArray) -> tuple[NDArray, NDArray]:
    """A path `[S]`, `[S]` (degrees) as a line on the map 0..360: (latitude, longitude), both `[S + 3 K]`.

    Each of the K times that the path crosses the seam the line runs up to one edge of the map, breaks (NaN), and goes
    on from the other edge. From one point to the next the path takes the shorter way around.

    >>> broken_at_seam(np.array([0.0, 4.0]), np.array([350.0, 370.0]))
    (array([ 0.,  2., nan,  2.,  4.]), array([350., 360.,  nan,   0.,  10.]))
    """
    unreduced = np.unwrap(np.asarray(longitude, dtype=float), period=360.0)
    lap = np.floor(unreduced / 360.0)
    columns = [[float(latitude[0])], [float(unreduced[0] - 360.0 * lap[0])]]
    for step in range(1, len(unreduced)):
        if lap[step] != lap[step - 1]:
            seam = 360.0 * max(lap[step], lap[step - 1])
            share = (seam - unreduced[step - 1]) / (unreduced[step] - unreduced[step - 1])
            crossing = float(latitude[step - 1] + share * (latitude[step] - latitude[step - 1]))
            edges = (360.0, 0.0) if lap[step] > lap[step - 1] else (0.0, 360.0)
            columns[0] += [crossing, math.nan, crossing]
            columns[1] += [edges[0], math.nan, edges[1]]
        columns[0].append(float(latitude[step]))
        columns[1].append(float(unreduced[step] - 360.0 * lap[step]))
    return np.array(columns[0]), np.array(columns[1])


# Inches: the figure's width, margins, and the room for tick labels between images and maps.
WIDTH, SIDE, TOP, BOTTOM, LABELS, BAR, BETWEEN = 8.0, 0.1, 0.74, 0.74, 0.62, 0.74, 0.3


@styled
def field_figure(
    reference: NDArray, query: NDArray, truth: NDArray, maps: Sequence[FieldMap], title: str, note: str
) -> Figure:
    """Reference and query image `[H, W, 3]` beside maps, one below the other, with the true relative pose `[3]`."""
    limit = _latitude_limit(truth, maps)
    columns = 1 if len(maps) > 1 else 2  # of images
    greatest = max((longest(each.arrows) for each in maps if each.arrows is not None), default=0.0)
    right = BAR if greatest > 0 else 2 * SIDE
    # Images are as high as the maps, whose scale is the same along both axes.
    wide = (WIDTH - SIDE - 0.1 * (columns - 1) - LABELS - right) / (1 + columns * limit / 180)
    high = wide * limit / 180
    height = TOP + len(maps) * high + (len(maps) - 1) * BETWEEN + BOTTOM
    figure = Figure(figsize=(WIDTH, height))

    def place(x: float, row: int, width: float) -> Axes:
        return place_axes(figure, x, height - TOP - (row + 1) * high - row * BETWEEN, width, high)

    for index, (image, name) in enumerate(((reference, "reference"), (query, "query"))):
        column, row = (0, index) if columns == 1 else (index, 0)
        show_image(place(SIDE + column * (high + 0.1), row, high), image, name)
    x = WIDTH - right - wide
    for row, content in enumerate(maps):
        axes = place(x, row, wide)
        if row == 0 and content.arrows is not None:
            radius = f"{truth[2]:+.2f}".replace("-", "\u2212")
            axes.set_title(f"at the true relative radius, {radius}", loc="right", color=MUTED, pad=3)
        quiver = draw_map(axes, content, truth, limit, greatest)
        axes.tick_params(labelbottom=row == len(maps) - 1)
        axes.set_ylabel("latitude")
    axes.set_xlabel("longitude of the query relative to the reference")
    if greatest > 0 and quiver is not None:
        bar_axes = place_axes(figure, WIDTH - BAR + 0.12, BOTTOM, 0.1, height - TOP - BOTTOM)
        bar = figure.colorbar(quiver, cax=bar_axes)
        bar.set_label("score magnitude (1/rad)")
        bar_axes.spines[:].set_visible(False)
    figure.text(SIDE / WIDTH, 1 - 0.1 / height, title, fontsize=10, fontweight="bold", va="top")
    figure.text(SIDE / WIDTH, 1 - 0.3 / height, note, color=MUTED, va="top")
    keys = _keys(maps)
    figure.legend(
        handles=keys, loc="lower right", bbox_to_anchor=(1 - right / WIDTH, 0.08 / height), ncols=len(keys),
        columnspacing=1.5, handletextpad=0.4, borderaxespad=0.0, borderpad=0.0, handlelength=1.6,
    )  # fmt: skip
    return figure


def draw_map(axes: Axes, content: FieldMap, truth: NDArray, limit: float, greatest: float) -> Quiver | None:
    """Draw one map: latitudes within `limit` degrees; the longest arrow stands for a score of length `greatest`."""
    axes.set(xlim=(0, 360), ylim=(-limit, limit))
    degrees(axes, "x", 60)
    degrees(axes, "y", 30)
    axes.spines[:].set(color=FAINT)
    axes.set_title(content.title, pad=3)
    if content.density is not None and content.density.energy is not None:
        energy, latitude = content.density.energy, content.density.latitude
        edge = (latitude[-1] - latitude[0]) / (len(latitude) - 1) / 2  # from a cell's centre
        axes.imshow(
            np.exp(energy.min() - energy), cmap=DENSITY, vmin=0, vmax=1, origin="lower", aspect="auto",
            extent=(0, 360, latitude[0] - edge, latitude[-1] + edge), interpolation="bilinear", zorder=0,
        )  # fmt: skip
        axes.set(xlim=(0, 360), ylim=(-limit, limit))  # imshow fits them to the image
    quiver = None
    if content.arrows is not None and greatest > 0:
        quiver = draw_arrows(axes, content.arrows, greatest)
    _draw_ways(axes, content, limit)
    _points(axes, truth[None], limit, **TRUTH_MARK, zorder=7)
    return quiver


def draw_arrows(axes: Axes, grid: Grid, greatest: float) -> Quiver:
    """The score's arrows in degrees; one of a score of length `greatest` is about as long as columns are apart."""
    spacing = 360 / len(grid.longitude)
    return axes.quiver(
        grid.longitude, grid.latitude, grid.score[..., 1], grid.score[..., 0], _magnitude(grid),
        cmap=MAGNITUDE, norm=Normalize(0, greatest), angles="xy", scale_units="xy",
        scale=greatest / (1.15 * spacing), pivot="mid", units="inches", width=0.0125,
        headwidth=4, headlength=4.5, headaxislength=4, minlength=0.5, zorder=1,
    )  # fmt: skip


TRUTH_MARK: dict[str, Any] = {
    "marker": "*", "markersize": 14, "markerfacecolor": TRUTH, "markeredgecolor": INK, "markeredgewidth": 0.8,
}  # fmt: skip
CHOSEN_MARK: dict[str, Any] = {
    "marker": "D", "markersize": 5, "markerfacecolor": ANSWER, "markeredgecolor": "white", "markeredgewidth": 0.8,
}  # fmt: skip
END_MARK: dict[str, Any] = {
    "marker": "o", "markersize": 4, "markerfacecolor": OTHERS, "markeredgecolor": "white", "markeredgewidth": 0.6,
}  # fmt: skip
START_MARK: dict[str, Any] = {
    "marker": "o", "markersize": 4.5, "markerfacecolor": "white", "markeredgecolor": OTHERS, "markeredgewidth": 1.0,
}  # fmt: skip


def _draw_ways(axes: Axes, content: FieldMap, limit: float) -> None:
    chosen = content.chosen
    for number, path in enumerate(() if content.paths is None else np.rad2deg(content.paths)):
        latitude, longitude = broken_at_seam(path[:, 0], path[:, 1])
        answer = number == chosen
        width = 1.5 if answer else 0.8
        axes.plot(
            longitude, latitude, color=ANSWER if answer else OTHERS, linewidth=width, solid_joinstyle="round",
            path_effects=[withStroke(linewidth=width + 1.0, foreground="white")],
            zorder=4 if answer else 3,
        )  # fmt: skip
    if content.starts is not None:
        _points(axes, content.starts, limit, **START_MARK, zorder=5)
    if content.ends is not None:
        _points(axes, content.ends, limit, **END_MARK, zorder=5)
        if chosen is not None:
            _points(axes, content.ends[[chosen]], limit, **CHOSEN_MARK, zorder=8)


def _points(axes: Axes, poses: NDArray, limit: float, **mark: Any) -> None:
    latitude, longitude = np.rad2deg(poses[:, 0]), np.rad2deg(poses[:, 1]) % 360
    # What lies on the seam is on both edges of the map, and none of its mark is cut off there.
    for shift in (0.0, 360.0, -360.0):
        shown = (np.abs(latitude) <= limit) & (np.abs(longitude + shift - 180) <= 180 + SEAM)
        axes.plot(longitude[shown] + shift, latitude[shown], linestyle="none", clip_on=False, **mark)


def _keys(maps: Sequence[FieldMap]) -> list[Line2D]:
    """The legend's entries, for what is drawn."""
    keys = [Line2D([], [], linestyle="none", label="true pose", **TRUTH_MARK)]
    if any(each.chosen is not None for each in maps):
        keys.append(Line2D([], [], linestyle="none", label="answer", **CHOSEN_MARK))
    if any(each.ends is not None and len(each.ends) > 1 for each in maps):
        keys.append(Line2D([], [], linestyle="none", label="other ends", **END_MARK))
    if any(each.starts is not None for each in maps):
        keys.append(Line2D([], [], linestyle="none", label="start", **START_MARK))
    return keys


def _magnitude(grid: Grid) -> NDArray:
    """Length of the score in the plane of the map, `[A, O]`."""
    return np.hypot(grid.score[..., 0], grid.score[..., 1])


def longest(grid: Grid) -> float:
    """The greatest length of the score in the plane of the map, 0 for a field of nothing."""
    return float(np.nan_to_num(_magnitude(grid), posinf=0.0).max())


def _latitude_limit(truth: NDArray, maps: Sequence[FieldMap]) -> float:
    """60 degrees, or the multiple of 15 above it that shows the truth and every answer (at most 180)."""
    shown = [truth] + [each.ends[each.chosen] for each in maps if each.ends is not None and each.chosen is not None]
    furthest = max((abs(math.degrees(pose[0])) for pose in shown if math.isfinite(pose[0])), default=0.0)
    return min(180.0, max(60.0, 15.0 * math.ceil((furthest + 2) / 15)))
