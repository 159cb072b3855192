"""Novel views around an object, in a grid of relative longitudes and latitudes beside their source."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure
from numpy.typing import NDArray

from lp_framework.viz.style import TRUTH, Sheet, styled

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
    for row, latitude in enumerate(latitudes_degrees):
        y = TOP + row * cell
        sheet.text(left - 0.06, y + cell / 2, signed(latitude), ha="right", va="center")
        for column, longitude in enumerate(longitudes_degrees):
            own = math.isclose(latitude, 0) and math.isclose(longitude % 360, 0)
            frame: Any = {"color": TRUTH, "linewidth": 1.6} if own else {"linewidth": 0.5}
            sheet.image(left + column * cell, y, cell, views[row, column], **frame).set_zorder(1 + own)
    for column in range(0, columns, -(-columns // MOST_LABELS)):
        x = left + (column + 0.5) * cell
        sheet.text(x, TOP + high + 0.06, f"{longitudes_degrees[column]:.4g}°", ha="center", va="top")
    sheet.text(left + wide / 2, TOP + high + 0.22, "longitude relative to the source", ha="center", va="top")
    sheet.text(left - 0.52, TOP + high / 2, "latitude", rotation=90, ha="center", va="center")
    return sheet.figure


def signed(angle: float) -> str:
    """Degrees with their sign, in typographic minus."""
    return "0°" if angle == 0 else f"{angle:+g}°".replace("-", "\u2212")
