"""The paper's figures of landscapes: surfaces of several objects, trajectories, and views where a landscape is flat."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D  # type: ignore[import-untyped]
from numpy.typing import NDArray

from lp_framework.evaluation.landscape import Landscape
from lp_framework.viz.landscape import draw_map, draw_surface
from lp_framework.viz.style import ANSWER, INK, MUTED, place_axes, show_image, styled, write

WIDTH, SIDE, TITLE = 7.0, 0.06, 0.24  # inches: the figure's width and margin, room for a title
COLUMNS = 3  # of surfaces


class SurfacePanel(NamedTuple):
    """One pair: reference and query image `[H, W, 3]`, the landscape, the true relative pose `[3]`, name and a word."""

    title: str
    word: str
    reference: NDArray
    query: NDArray
    landscape: Landscape
    truth: NDArray


@styled
def surfaces_figure(panels: Sequence[SurfacePanel]) -> Figure:
    """A column a pair: reference and query above the surface of the landscape, whose height is its own range."""
    columns = min(COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    wide, gap, image, tall = (WIDTH - 2 * SIDE) / columns, 0.05, 0.96, 1.72
    height = rows * (TITLE + image + tall)
    figure = Figure(figsize=(WIDTH, height))
    for number, panel in enumerate(panels):
        row, column = divmod(number, columns)
        x, y = SIDE + column * wide, height - row * (TITLE + image + tall) - TITLE
        write(figure, x, y, f"({chr(ord('a') + number)}) {panel.title}")
        for place, picture in enumerate((panel.reference, panel.query)):
            show_image(place_axes(figure, x + place * (image + gap), y - image, image, image), picture, "")
        right = x + 2 * image + gap
        figure.text(right / WIDTH, (y + 0.05) / height, panel.word, color=MUTED, fontsize=7.5, ha="right")
        box = (x - 0.06, y - image - tall + 0.08, wide + 0.04, tall - 0.1)
        axes = place_surface(figure, *box, panel.landscape, panel.truth)
        axes.set_xlabel("longitude", fontsize=7, labelpad=-8)
        axes.set_ylabel("latitude", fontsize=7, labelpad=-8)
    return figure


class TrajectoryRow(NamedTuple):
    """What a prior generates on one way: images `[K, H, W, 3]` at some steps, names of its start and its end."""

    start: str
    end: str
    views: NDArray


@styled
def trajectories_figure(
    reference: NDArray,
    query: NDArray,
    rows: Sequence[TrajectoryRow],
    steps: Sequence[int],
    landscape: Landscape,
    trajectories: NDArray,
    truth: NDArray,
    chosen: int,
) -> Figure:
    """(a), (b) both images `[H, W, 3]`; (c) a row of views a trajectory, at `steps`; (d) the landscape with the ways.

    `trajectories` `[N, S, 3]` (radians, longitudes unreduced), truth `[3]`, `chosen` the trajectory that is the answer.
    """
    view, gap, label, bottom = 0.58, 0.05, 0.5, 0.06
    tall = max(2.7, 0.18 + len(rows) * (view + gap) - gap)
    image = min(1.1, (tall - TITLE) / 2)
    height = TITLE + tall + bottom
    figure = Figure(figsize=(WIDTH, height))
    top = height - TITLE
    for letter, name, picture, y in (
        ("a", "reference", reference, top - image), ("b", "query", query, bottom),
    ):  # fmt: skip
        show_image(place_axes(figure, SIDE, y, image, image), picture, "")
        write(figure, SIDE, y + image, f"({letter}) {name}")

    left = SIDE + image + 0.12
    write(figure, left, top, "(c) generated on the way")
    for column, step in enumerate(steps):
        x = left + label + column * (view + gap) + view / 2
        figure.text(x / WIDTH, (top - 0.12) / height, f"step {step}", color=MUTED, fontsize=7, ha="center")
    for number, row in enumerate(rows):
        y = top - 0.18 - number * (view + gap) - view
        colour = ANSWER if number == chosen else INK
        place = (left / WIDTH, (y + view / 2) / height)
        figure.text(*place, f"from {row.start}", fontsize=7, va="bottom", color=colour)
        figure.text(*place, row.end, fontsize=7, va="top", color=colour)
        for column, picture in enumerate(row.views):
            axes = place_axes(figure, left + label + column * (view + gap), y, view, view)
            show_image(axes, picture, "")
            if number == chosen:
                axes.spines[:].set(color=ANSWER, linewidth=1.2)

    x = left + label + len(steps) * (view + gap) + 0.44
    wide = WIDTH - SIDE - x
    high = wide * 0.52
    write(figure, x, top, "(d) landscape")
    axes = place_axes(figure, x, top - high, wide, high)
    draw_map(axes, landscape, trajectories, truth, chosen)
    axes.set(xticks=[0, 90, 180, 270], yticks=[-30, 0, 30])
    axes.tick_params(pad=2)
    axes.set_xlabel("longitude", labelpad=1)
    axes.set_ylabel("latitude", labelpad=0)
    small_marks(axes)
    place_surface(figure, x - 0.2, bottom - 0.02, wide + 0.2, top - high - 0.26 - bottom, landscape, truth)
    return figure


class FailureRow(NamedTuple):
    """One pair: its images `[H, W, 3]`, the landscape and the true relative pose `[3]`; views around the object,
    `[K, H, W, 3]`, rendered from its mesh (None where there is none) and generated by the prior.
    """

    title: str
    reference: NDArray
    query: NDArray
    rendered: NDArray | None
    generated: NDArray
    landscape: Landscape
    truth: NDArray


@styled
def failures_figure(rows: Sequence[FailureRow], longitudes_degrees: Sequence[float]) -> Figure:
    """A row a pair: reference above query, views at relative longitudes, rendered above generated, the landscape."""
    image, gap, label, wide = 0.7, 0.05, 0.3, 1.72
    block = 2 * image + gap
    height = TITLE + len(rows) * (block + TITLE) + 0.3
    figure = Figure(figsize=(WIDTH, height))
    left = SIDE + image + 0.12 + label
    right = WIDTH - SIDE - wide
    view = min(image, (right - 0.55 - left + gap) / len(longitudes_degrees) - gap)
    write(figure, SIDE, height - TITLE, "(a) pair")
    write(figure, left, height - TITLE, "(b) turned around the object")
    write(figure, right, height - TITLE, "(c) landscape")
    for number, row in enumerate(rows):
        lower = height - TITLE - (number + 1) * (block + TITLE)
        figure.text(SIDE / WIDTH, (lower + block + 0.05) / height, row.title, color=MUTED, fontsize=7.5)
        for place, picture in enumerate((row.reference, row.query)):
            show_image(place_axes(figure, SIDE, lower + (1 - place) * (image + gap), image, image), picture, "")
        sources = (("mesh", row.rendered), ("prior", row.generated))
        swept = [(name, views) for name, views in sources if views is not None]
        top = lower + block / 2 + (len(swept) * (view + gap) - gap) / 2
        for line, (name, views) in enumerate(swept):
            y = top - line * (view + gap) - view
            x, middle = (left - 0.08) / WIDTH, (y + view / 2) / height
            figure.text(x, middle, name, fontsize=7.5, rotation=90, ha="right", va="center")
            for column, picture in enumerate(views):
                show_image(place_axes(figure, left + column * (view + gap), y, view, view), picture, "")
        for column, longitude in enumerate(longitudes_degrees):
            x = left + column * (view + gap) + view / 2
            figure.text(x / WIDTH, (top + 0.05) / height, f"{longitude:g}°", color=MUTED, fontsize=7, ha="center")
        axes = place_axes(figure, right, lower + 0.1, wide, block - 0.1)
        draw_map(axes, row.landscape, truth=row.truth)
        axes.set(xticks=[0, 90, 180, 270], yticks=[-30, 0, 30])
        axes.set_ylabel("latitude", labelpad=0)
        if number == len(rows) - 1:
            axes.set_xlabel("longitude", labelpad=1)
        axes.tick_params(pad=2, labelsize=7)
        small_marks(axes)
    return figure


def place_surface(
    figure: Figure, x: float, y: float, wide: float, tall: float, landscape: Landscape, truth: NDArray
) -> Axes3D:
    """A landscape as a small surface that fills a box of the figure (inches), in its own range."""
    width, height = figure.get_size_inches()
    axes = figure.add_axes((x / width, y / height, wide / width, tall / height), projection="3d")
    assert isinstance(axes, Axes3D)
    draw_surface(axes, landscape, truth)
    axes.set(xlabel="", ylabel="", zlabel="", xticks=[0, 90, 180, 270], yticks=[-30, 30])
    axes.patch.set_visible(False)
    axes.tick_params(labelsize=6, pad=-4)
    axes.locator_params(axis="z", nbins=3)
    axes.set_box_aspect((2.0, 1.2, 0.95), zoom=1.16)  # axes in 3-D leave wide margins
    small_marks(axes)
    return axes


def small_marks(axes: Axes) -> None:
    """The marks of a large map made fit for a small one."""
    for line in axes.lines:
        line.set_markersize(0.75 * line.get_markersize())
