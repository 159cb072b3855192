"""The energy around objects, small multiples."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D

from lp_framework.viz.style import CLASS_COLOURS, MUTED, TRUTH, degrees, open_frame, styled

COLUMNS = 4


@styled
def azimuth_figure(objects: Sequence[Mapping[str, Any]]) -> Figure:
    """A panel an object; the truth is marked, and the share of pairs whose least energy is within 15 degrees of it.

    Each has `object` (name), `ambiguity`, that share as `within`, and its mean `energy` over `degrees` from the truth.
    """
    rows, columns = math.ceil(len(objects) / COLUMNS), min(COLUMNS, len(objects))
    layout = ConstrainedLayoutEngine(wspace=0.04, hspace=0.06)
    figure = Figure(figsize=(2.1 * columns, 1.5 * rows + 0.2), layout=layout)
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for axes, each in zip(grid.flat, objects, strict=False):
        open_frame(axes)
        axes.axvline(0, color=TRUTH, linewidth=2.5, alpha=0.8, zorder=1)
        # The circle is closed: what is at -180 is at 180 as well.
        place = [*each["degrees"], each["degrees"][0] + 360]
        above = np.array([*each["energy"], each["energy"][0]]) - min(each["energy"])
        axes.plot(place, above, color=CLASS_COLOURS[each["ambiguity"]], zorder=3)
        axes.set_title(f"{each['object'].replace('_', ' ')}, {each['within']:.0%}")
        axes.set_xlim(-180, 180)
        degrees(axes, "x", 90)
        axes.locator_params(axis="y", nbins=4)
    for axes in list(grid.flat)[len(objects) :]:
        axes.remove()
    figure.supxlabel("longitude from the truth; in the title: share of pairs whose least energy is within 15°", size=8)
    figure.supylabel("denoising error above its least", size=8)
    present = [name for name in CLASS_COLOURS if name in {each["ambiguity"] for each in objects}]
    keys = [Line2D([], [], color=CLASS_COLOURS[name], label=name) for name in present]
    figure.legend(handles=keys, loc="outside upper center", ncols=len(keys), labelcolor=MUTED)
    return figure
