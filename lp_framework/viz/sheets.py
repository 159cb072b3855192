"""Contact sheets of images: the objects of an evaluation, and the novel views of one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lp_framework.viz.style import CLASS_COLOURS, FAINT, INK, MUTED, TRUTH, Sheet, class_keys, shortened, styled

MOST_OBJECTS = 42
# Inches: the figure's width, margins, the room for the latitudes, and the sides of the source and of the largest view.
WIDTH, SIDE, TOP, BOTTOM, LABELS, SOURCE, LARGEST = 10.0, 0.1, 0.74, 0.42, 0.62, 1.8, 1.6
MOST_LABELS = 18  # longitudes that are written out; of more, every second, third, ...


class ObjectCard(NamedTuple):
    """An object on the contact sheet: a view `[H, W, 3]` of it, and its recall and success rate, if any, in [0, 1]."""

    name: str
    ambiguity: str
    image: NDArray
    recall: float
    success: float | None


@styled
def objects_figure(cards: Sequence[ObjectCard]) -> Figure:
    """The objects, worst recall first (then worst success rate, then by name); at most the worst `MOST_OBJECTS`."""
    ranked = sorted(cards, key=lambda card: (card.recall, card.success or 0.0, card.name))
    shown = ranked[:MOST_OBJECTS]
    columns = min(len(shown), 4 if len(shown) <= 8 else 6 if len(shown) <= 18 else 7)
    rows = math.ceil(len(shown) / columns)
    card, text, top, gap = min((8.0 - 0.1) / columns, 1.6), 0.62, 0.38, 0.12  # inches
    side = card - gap
    sheet = Sheet(8.0, top + rows * (side + text))
    fewer = f" (the {len(shown)} worst of {len(ranked)})" if len(shown) < len(ranked) else ""
    sheet.head(f"Objects, worst first{fewer}")
    for index, each in enumerate(shown):
        row, column = divmod(index, columns)
        x, y = 0.1 + column * card, top + row * (side + text)
        sheet.image(x, y, side, each.image)
        _write_card(sheet.axes(x, y + side, side, text), each, side)
    keys = class_keys([each.ambiguity for each in shown], linestyle="none", marker="s", markersize=5)
    sheet.legend(keys, 7.9, 0.08, columnspacing=1.2, handletextpad=0.2)
    return sheet.figure


def _write_card(axes: Axes, card: ObjectCard, side: float) -> None:
    """Name and class, then a bar and a number for each of the two shares; one data unit is an inch."""
    axes.set(xlim=(0, side), ylim=(0.62, 0))
    axes.axis("off")
    name = shortened(card.name.replace("_", " "), 14.5 * side)
    axes.text(0, 0.1, name, va="center", fontsize=7.5, fontweight="bold")
    axes.plot([side - 0.04], [0.1], marker="s", markersize=5, color=CLASS_COLOURS[card.ambiguity], clip_on=False)
    left, width = 0.5, side - 0.5 - 0.28
    for line, (label, share) in enumerate((("R(R)@15", card.recall), ("SR(R)@30", card.success))):
        if share is None:
            continue
        y = 0.25 + 0.14 * line
        axes.text(0, y, label, va="center", fontsize=6, color=MUTED)
        axes.barh(y, width, left=left, height=0.05, color=FAINT)
        axes.barh(y, width * share, left=left, height=0.05, color=INK)
        axes.text(side, y, f"{share:.2f}", va="center", ha="right", fontsize=6.5)


@styled
def views_figure(
    source: NDArray, views: NDArray, latitudes_degrees: Sequence[float], longitudes_degrees: Sequence[float],
    title: str, note: str,
) -> Figure:  # fmt: skip
    """The source `[H, W, 3]` beside views `[rows, columns, h, w, 3]` (uint8), a row a latitude, a column a longitude,
    relative to the source; a view at (0, 0), its own pose, is framed.
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
