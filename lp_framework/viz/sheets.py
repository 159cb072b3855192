"""Contact sheets of images: the objects of an evaluation, and novel views of one object."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from matplotlib.figure import Figure
from numpy.typing import NDArray

from lp_framework.viz import style

MOST_OBJECTS = 42
LARGEST = 1.6  # inches per side of a view
MOST_LABELS = 18  # longitudes with labels; of more, only every second, third, ...


class ObjectCard(NamedTuple):
    """An object on the contact sheet: one view `[H, W, 3]`, and its recall and success rate in [0, 1], if any."""

    name: str
    ambiguity: str
    image: NDArray
    recall: float
    success: float | None


@style.styled
def objects_figure(cards: Sequence[ObjectCard]) -> Figure:
    """The objects, worst recall first (then worst success rate, then by name); at most the worst `MOST_OBJECTS`."""
    ranked = sorted(cards, key=lambda card: (card.recall, card.success or 0.0, card.name))
    shown = ranked[:MOST_OBJECTS]
    columns = min(len(shown), 4 if len(shown) <= 8 else 6 if len(shown) <= 18 else 7)
    rows, side = math.ceil(len(shown) / columns), min(8.0 / columns, LARGEST)
    fewer = f" (the {len(shown)} worst of {len(ranked)})" if len(shown) < len(ranked) else ""
    figure, body = style.page(8.0, 0.6 + rows * (side + 0.45), f"Objects, worst first{fewer}")
    for axes, each in zip(style.panels(body, len(shown), columns), shown, strict=True):
        name = style.shortened(each.name.replace("_", " "), 14.5 * side)
        style.show_image(axes, each.image, name, color=style.CLASS_COLOURS[each.ambiguity], linewidth=1.6)
        success = "" if each.success is None else f"\nSR(R)@30 {each.success:.2f}"
        axes.set_xlabel(f"R(R)@15 {each.recall:.2f}{success}", fontsize=7, loc="left")
    keys = style.class_keys([each.ambiguity for each in shown])
    figure.legend(handles=keys, loc="outside lower right", ncols=len(keys))
    return figure


@style.styled
def views_figure(
    source: NDArray, views: NDArray, latitudes_degrees: Sequence[float], longitudes_degrees: Sequence[float],
    title: str, note: str,
) -> Figure:  # fmt: skip
    """The source `[H, W, 3]` beside views `[rows, columns, h, w, 3]` (uint8). Rows are latitudes and columns are
    longitudes, relative to the source; a view at (0, 0), the source's own pose, is framed.
    """
    rows, columns = views.shape[:2]
    side = min(7.3 / columns, LARGEST)
    figure, body = style.page(2.6 + side * columns, 1.2 + max(1.9, side * rows), title, note)
    figure.set_layout_engine("constrained", w_pad=0.02, h_pad=0.02, wspace=0, hspace=0)
    left, right = style.beside(body, 2.0, 0.6 + side * columns)
    style.show_image(left.subplots(), source, "source")
    grid = right.subplots(rows, columns, squeeze=False)
    for row, latitude in zip(range(rows), latitudes_degrees, strict=True):
        grid[row, 0].set_ylabel(signed(latitude), rotation=0, ha="right", va="center")
        for column, longitude in zip(range(columns), longitudes_degrees, strict=True):
            own = math.isclose(latitude, 0) and math.isclose(longitude % 360, 0)
            frame: Any = {"color": style.TRUTH, "linewidth": 1.6} if own else {"linewidth": 0.5}
            style.show_image(grid[row, column], views[row, column], **frame)
            grid[row, column].set_zorder(1 + own)
    for column in range(0, columns, -(-columns // MOST_LABELS)):
        grid[-1, column].set_xlabel(f"{longitudes_degrees[column]:.4g}°")
    right.supxlabel("longitude relative to the source", fontsize=8)
    right.supylabel("latitude", fontsize=8)
    return figure


def signed(angle: float) -> str:
    """Degrees with their sign, using a typographic minus."""
    return "0°" if angle == 0 else f"{angle:+g}°".replace("-", "\u2212")
