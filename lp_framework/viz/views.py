"""Novel views around an object, in a grid of relative longitudes and latitudes beside their source."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from lp_framework.viz.style import FAINT, TRUTH, Sheet, styled

# Inches: the figure's width, margins, the room for the latitudes, and the sides of the source and of the largest view.
WIDTH, SIDE, TOP, BOTTOM, LABELS, SOURCE, LARGEST = 10.0, 0.1, 0.74, 0.42, 0.62, 1.8, 1.6
MOST_LABELS = 18  # longitudes that are written out; of more, every second, third, ...


@styled
def views_figure(
    source: NDArray,
    views: NDArray,
    latitudes_degrees: Sequence[float],
    longitudes_degrees: Sequence[float],
    title: str,
    note: str,
) -> Figure:
    """The source `[H, W, 3]` beside views `[rows, columns, h, w, 3]` (uint8), a row a latitude, a column a longitude.

    Angles are relative to the source; a view at (0, 0), its own pose, is framed.
    """
    rows, columns = views.shape[:2]
    left = SIDE + SOURCE + LABELS
    cell = min((WIDTH - left - SIDE) / columns, LARGEST)
    wide, high = cell * columns, cell * rows
    tall = max(high, SOURCE)
    sheet = Sheet(left + wide + SIDE, TOP + tall + BOTTOM)
    sheet.head(title, note)
    sheet.image(SIDE, TOP, SOURCE, source, "source")
    axes = sheet.axes(left, TOP, wide, high)
    # Data coordinates are those of cells: the centre of row r and column c is (c, r).
    axes.imshow(
        contact_sheet(views), interpolation="antialiased", extent=(-0.5, columns - 0.5, rows - 0.5, -0.5), aspect="auto"
    )
    every = -(-columns // MOST_LABELS)
    axes.set_xticks(range(0, columns, every), [f"{angle:.4g}°" for angle in longitudes_degrees[::every]])
    axes.set_yticks(range(rows), [signed(angle) for angle in latitudes_degrees])
    axes.tick_params(length=0, pad=4)
    axes.spines[:].set_visible(False)
    axes.vlines(np.arange(1, columns) - 0.5, -0.5, rows - 0.5, color=FAINT, linewidth=0.5)
    axes.hlines(np.arange(1, rows) - 0.5, -0.5, columns - 0.5, color=FAINT, linewidth=0.5)
    frames = [((-0.5, -0.5), columns, rows, FAINT, 0.8)]
    own = np.isclose(np.asarray(latitudes_degrees)[:, None], 0) & np.isclose(np.asarray(longitudes_degrees) % 360, 0)
    frames += [((column - 0.5, row - 0.5), 1, 1, TRUTH, 1.6) for row, column in np.argwhere(own)]
    for *box, colour, thick in frames:
        axes.add_patch(Rectangle(*box, fill=False, edgecolor=colour, linewidth=thick, clip_on=False, zorder=2 + thick))
    axes.set_xlabel("longitude relative to the source")
    axes.set_ylabel("latitude")
    return sheet.figure


def contact_sheet(views: NDArray) -> NDArray:
    """One image `[rows h, columns w, 3]` of views `[rows, columns, h, w, 3]`."""
    rows, columns, height, width, channels = views.shape
    return views.transpose(0, 2, 1, 3, 4).reshape(rows * height, columns * width, channels)


def signed(angle: float) -> str:
    """Degrees with their sign, in typographic minus."""
    return "0°" if angle == 0 else f"{angle:+g}°".replace("-", "\u2212")
