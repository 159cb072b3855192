"""The energy around objects, small multiples."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from lp_framework.viz.style import CLASS_COLOURS, MUTED, TRUTH, degrees, open_frame, styled

COLUMNS = 4


class AzimuthPanel(NamedTuple):
    """One object: mean energies over degrees from the truth, and the share of pairs whose least is there."""

    title: str
    ambiguity: str
    degrees: Sequence[float]
    energy: Sequence[float]
    within: float


@styled
def azimuth_figure(panels: Sequence[AzimuthPanel]) -> Figure:
    """A panel an object; the truth is marked, and the share of pairs whose least energy is within 15 degrees of it."""
    rows = math.ceil(len(panels) / COLUMNS)
    columns = min(COLUMNS, len(panels))
    layout = ConstrainedLayoutEngine(wspace=0.04, hspace=0.06)
    figure = Figure(figsize=(2.1 * columns, 1.5 * rows + 0.2), layout=layout)
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for axes, panel in zip(grid.flat, panels, strict=False):
        open_frame(axes)
        axes.axvline(0, color=TRUTH, linewidth=2.5, alpha=0.8, zorder=1)
        above = [energy - min(panel.energy) for energy in panel.energy]
        # The circle is closed: what is at -180 is at 180 as well.
        colour = CLASS_COLOURS[panel.ambiguity]
        axes.plot([*panel.degrees, panel.degrees[0] + 360], [*above, above[0]], color=colour, zorder=3)
        axes.set_title(f"{panel.title.replace('_', ' ')}, {panel.within:.0%}")
        axes.set_xlim(-180, 180)
        degrees(axes, "x", 90)
        axes.locator_params(axis="y", nbins=4)
    for axes in list(grid.flat)[len(panels) :]:
        axes.remove()
    figure.supxlabel("longitude from the truth; in the title: share of pairs whose least energy is within 15°", size=8)
    figure.supylabel("denoising error above its least", size=8)
    keys = sorted({panel.ambiguity for panel in panels}, key=list(CLASS_COLOURS).index)
    handles = [figure.axes[0].plot([], [], color=CLASS_COLOURS[key], label=key)[0] for key in keys]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(keys), labelcolor=MUTED)
    return figure
