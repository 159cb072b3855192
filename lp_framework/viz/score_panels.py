"""Score fields and densities of one pair beside its views: the paper's Toy Example and Score against Energy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter
from numpy.typing import NDArray

from lp_framework.evaluation.landscape import Landscape
from lp_framework.viz.fields import TRUTH_MARK, Grid, draw_arrows, longest
from lp_framework.viz.landscape import RELIEF, closed
from lp_framework.viz.landscape_panels import place_surface
from lp_framework.viz.style import FAINT, MUTED, place_axes, show_image, styled, write

STAR = {**TRUTH_MARK, "markersize": 9.0}

# Inches of the toy example: the figure's width and margin, images, maps, surfaces, rooms for words, gaps.
WIDTH, SIDE, TALL, WIDE, TITLE, LABELS, BOTTOM, GAP = 7.0, 0.06, 1.16, 1.55, 0.24, 0.46, 0.4, 0.12


class FieldPanel(NamedTuple):
    """Arrows of one field; `scale` is the score that the longest arrow stands for, None: its own greatest."""

    title: str
    grid: Grid
    scale: float | None = None


class DensityPanel(NamedTuple):
    """exp(-E) over relative latitude and longitude, as the `energy` of a landscape."""

    title: str
    density: Landscape


@styled
def toy_figure(
    reference: NDArray, query: NDArray, truth: NDArray, fields: Sequence[FieldPanel], densities: Sequence[DensityPanel]
) -> Figure:
    """(a) reference and query `[H, W, 3]`, then four fields and two densities, in two rows; truth `[3]` is starred."""
    height = 2 * (TITLE + TALL) + BOTTOM
    figure = Figure(figsize=(WIDTH, height))
    left = SIDE + TALL + LABELS
    right = left + 2 * (WIDE + GAP)
    for row, (image, name) in enumerate(((reference, "(a) reference"), (query, "query"))):
        y = height - (row + 1) * (TITLE + TALL)
        show_image(place_axes(figure, SIDE, y, TALL, TALL), image, "")
        write(figure, SIDE, y + TALL, name)
    for number, panel in enumerate(fields):
        row, column = divmod(number, 2)
        x, y = left + column * (WIDE + GAP), height - (row + 1) * (TITLE + TALL)
        write(figure, x, y + TALL, f"({'bcde'[number]}) {panel.title}")
        axes = place_axes(figure, x, y, WIDE, TALL)
        draw_field(axes, panel, truth)
        axes.tick_params(labelleft=column == 0, labelbottom=row == 1)
        if column == 0:
            axes.set_ylabel("latitude", labelpad=0)
        if row == 1:
            axes.set_xlabel("longitude", labelpad=1)
    for row, density in enumerate(densities):
        y = height - (row + 1) * (TITLE + TALL)
        write(figure, right, y + TALL, f"({'fg'[row]}) {density.title}")
        place_surface(figure, right - 0.12, y - 0.05, WIDTH - right + 0.06, TALL + 0.15, density.density, truth)
    return figure


class ComparisonRow(NamedTuple):
    """One pair: images `[H, W, 3]`, the true relative pose `[3]`, exp(-E) of the energy model, and both models' fields
    with a word on each.
    """

    title: str
    reference: NDArray
    query: NDArray
    truth: NDArray
    density: Landscape
    energy: FieldPanel
    score: FieldPanel


@styled
def comparison_figure(rows: Sequence[ComparisonRow]) -> Figure:
    """A row a pair: reference above query, exp(-E) of the energy model, its score field, the score model's field."""
    gap, between = 0.2, 0.05
    side = (TALL - between) / 2
    left = SIDE + side + LABELS + 0.08
    wide = (WIDTH - SIDE - left - 2 * gap) / 3
    height = TITLE + len(rows) * (TITLE + TALL) + BOTTOM
    figure = Figure(figsize=(WIDTH, height))
    for number, row in enumerate(rows):
        y = height - TITLE - (number + 1) * (TITLE + TALL)
        last = number == len(rows) - 1
        figure.text(SIDE / WIDTH, (y + TALL + 0.05) / height, row.title, color=MUTED, fontsize=7.5)
        for place, image in enumerate((row.reference, row.query)):
            show_image(place_axes(figure, SIDE, y + (1 - place) * (side + between), side, side), image, "")
        for column, panel in enumerate((None, row.energy, row.score)):
            x = left + column * (wide + gap)
            axes = place_axes(figure, x, y, wide, TALL)
            if panel is None:
                _draw_density(axes, row.density)
                _dress(axes, row.truth)
                axes.set_ylabel("latitude", labelpad=0)
            else:
                draw_field(axes, panel, row.truth)
                figure.text((x + wide) / WIDTH, (y + TALL + 0.05) / height, panel.title, color=MUTED, fontsize=7.5,
                            ha="right")  # fmt: skip
            axes.tick_params(labelleft=column == 0, labelbottom=last)
            if last:
                axes.set_xlabel("longitude", labelpad=1)
    titles = ("(b) energy model, exp(\u2212E)", "(c) energy model, \u2212\u2207E", "(d) score model")
    write(figure, SIDE, height - TITLE, "(a) pair")
    for column, title in enumerate(titles):
        write(figure, left + column * (wide + gap), height - TITLE, title)
    return figure


def draw_field(axes: Axes, panel: FieldPanel, truth: NDArray) -> None:
    """The arrows of a field over the whole turn, and a star at the true relative pose `[3]`."""
    grid = panel.grid
    edge = (grid.latitude[-1] - grid.latitude[0]) / (len(grid.latitude) - 1) / 2  # from a cell's centre
    axes.set(xlim=(0, 360), ylim=(grid.latitude[0] - edge, grid.latitude[-1] + edge))
    draw_arrows(axes, grid, panel.scale or longest(grid) or 1.0)
    _dress(axes, truth)


def _draw_density(axes: Axes, density: Landscape) -> None:
    """exp(-E) from above, with contour lines."""
    latitude, longitude, values = closed(density)
    around = longitude, latitude, values
    axes.pcolormesh(*around, cmap=RELIEF, vmin=0, vmax=1, shading="gouraud", zorder=0)
    axes.contour(*around, levels=np.linspace(0.1, 0.9, 9), colors="white", linewidths=0.4, alpha=0.55, zorder=0.5)
    axes.set(xlim=(0, 360), ylim=(latitude[0], latitude[-1]))


def _dress(axes: Axes, truth: NDArray) -> None:
    """Few ticks, a faint frame, and a star at the true relative pose `[3]`."""
    axes.set_xticks([90, 180, 270])
    axes.set_yticks([-30, 0, 30])
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(StrMethodFormatter("{x:g}°"))
    axes.spines[:].set(color=FAINT)
    axes.tick_params(pad=2)
    axes.plot(math.degrees(truth[1]) % 360, math.degrees(truth[0]), linestyle="none", zorder=7, **STAR)
