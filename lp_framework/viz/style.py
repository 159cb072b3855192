"""The common style of all figures: type, lines, colours, axes in degrees, and saving."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import MultipleLocator, StrMethodFormatter
from numpy.typing import NDArray
from PIL.Image import Image

from lp_framework.atomic import written

# Okabe and Ito's palette, safe for the common kinds of colour blindness.
BLUE, ORANGE, PURPLE, GREEN, VERMILION = "#0072B2", "#E69F00", "#CC79A7", "#009E73", "#D55E00"
INK, MUTED, FAINT = "#222222", "#6B6B6B", "#D4D4D4"
ASIDE: Any = {"color": MUTED, "fontsize": 7.5}

CLASS_COLOURS = {"unique": BLUE, "twofold": ORANGE, "continuous": PURPLE, "unlabelled": MUTED}
TRUTH, ANSWER, OTHERS = "#FFC20A", VERMILION, "#3A3A3A"
MAGNITUDE = LinearSegmentedColormap.from_list("magnitude", ["#C9DDEC", "#7FB2D9", "#3F86BE", "#0B4A86", "#062B57"])
DENSITY = LinearSegmentedColormap.from_list("density", ["#FFFFFF", "#E9E4DA", "#CFC4AE"])

SETTINGS = matplotlib.rc_params_from_file(Path(__file__).with_name("look.mplstyle"), use_default_template=False)

# Decorates a plotting function: its figure has the common style, whatever the caller's settings.
styled = matplotlib.rc_context(SETTINGS)


def save_figure(figure: Figure, path: Path) -> list[Path]:
    """Write `path`.png (200 dpi) and `path`.pdf (vectors), each atomically; returns both paths."""
    path.parent.mkdir(parents=True, exist_ok=True)
    files = []
    engine = figure.get_layout_engine()
    for suffix in ("png", "pdf"):
        file = path.with_name(f"{path.name}.{suffix}")
        # Without a date, the same figure gives the same file.
        metadata = {"CreationDate": None} if suffix == "pdf" else None
        with written(file) as partial, matplotlib.rc_context(SETTINGS):
            figure.savefig(partial, format=suffix, dpi=200, metadata=metadata)
        files.append(file)
        figure.set_layout_engine("none")  # the other file has the same layout, which takes as long as drawing
    figure.set_layout_engine(engine)
    return files


def page(width: float, height: float, title: str, note: str = "") -> tuple[Figure, SubFigure]:
    """A figure (size in inches) with a title and a note below it, and the rest of it for panels."""
    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, fontweight="bold")
    (body,) = stacked(figure, 1)
    if note:
        body.suptitle(note, x=0.01, ha="left", color=MUTED, fontsize=8)
    return figure, body


def beside(part: Figure | SubFigure, *widths: float) -> list[SubFigure]:
    """Split a figure side by side, with relative `widths`."""
    return list(part.subfigures(1, len(widths), squeeze=False, width_ratios=widths)[0])


def stacked(part: Figure | SubFigure, *heights: float) -> list[SubFigure]:
    """Split a figure from top to bottom, with relative `heights`."""
    return list(part.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0])


def panels(part: SubFigure, count: int, columns: int) -> list[Axes]:
    """Add `count` axes, in rows of at most `columns`."""
    grid = part.add_gridspec(-(-count // columns), min(count, columns))
    return [part.add_subplot(grid[divmod(number, columns)]) for number in range(count)]


def show_image(axes: Axes, image: NDArray | Image, title: str = "", **frame: Any) -> None:
    """Show an image `[H, W, 3]` (uint8, or floats in [0, 1]) in a thin frame, with a title above it."""
    axes.imshow(image, interpolation="antialiased")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set(**{"color": FAINT, "linewidth": 0.8, **frame})
    axes.set_title(title, pad=3)


def class_keys(classes: Sequence[str]) -> list[Line2D]:
    """Legend entries for the ambiguity classes in `classes`."""
    return [Line2D([], [], color=colour, label=name) for name, colour in CLASS_COLOURS.items() if name in classes]


def degrees(axis: Axis, step: float) -> None:
    """Put ticks every `step` degrees on an axis, labelled with a degree sign."""
    axis.set_major_locator(MultipleLocator(step))
    axis.set_major_formatter(StrMethodFormatter("{x:g}°"))


def open_frame(axes: Axes) -> None:
    """Keep only the left and bottom edge, and add a faint grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color=FAINT, linewidth=0.4)


def letter(number: int, title: str) -> str:
    """The title of a panel with its letter: (a), (b), ..."""
    return f"({chr(ord('a') + number)}) {title}"


def shortened(name: str, room: float) -> str:
    """Truncate a name to at most `room` characters."""
    return name if len(name) <= int(room) else name[: int(room) - 1] + "…"
