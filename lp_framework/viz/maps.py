"""Maps of relative latitude and longitude: energies, scores, and the ways that a solver took over them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from lp_framework.analysis.landscapes import FLAT, Landscape, LandscapeMinimum, PoseMap, Ways
from lp_framework.analysis.shown import ShownPair
from lp_framework.viz.style import ANSWER, DENSITY, FAINT, INK, MAGNITUDE, MUTED, OTHERS, TRUTH, Sheet, degrees, styled

SEAM = 0.5  # degrees; what is nearer to the seam is drawn on both sides of it
# From dark valleys to light heights, evenly in lightness, so that grey and any kind of colour vision see the same.
RELIEF = "cividis"
LEVELS = 9  # contour lines
ALONG = "longitude of the query relative to the reference"


def _mark(marker: str, size: float, face: str, edge: str, width: float, **others: Any) -> dict[str, Any]:
    style = {"markersize": size, "markerfacecolor": face, "markeredgecolor": edge, "markeredgewidth": width}
    return {"linestyle": "none", "marker": marker, **style, **others}


TRUTH_MARK = _mark("*", 14, TRUTH, INK, 0.8)
CHOSEN_MARK = _mark("D", 5, ANSWER, "white", 0.8)
END_MARK = _mark("o", 4, OTHERS, "white", 0.6)
START_MARK = _mark("o", 4.5, "white", OTHERS, 1.0)
MINIMUM_MARK = _mark("+", 9, INK, "white", 1.3, path_effects=[withStroke(linewidth=2.5, foreground=INK)])


# ---------------------------------------------------------------- one map


def draw_map(
    axes: Axes,
    content: PoseMap,
    truth: NDArray | None = None,
    limit: float = 60.0,
    greatest: float | None = None,
    small: bool = False,
) -> ScalarMappable | None:
    """Draw a map and the true relative pose `[3]`; returns what a colour bar of its relief or its arrows needs.

    Latitudes within `limit` degrees, or those of the relief, whose local minima are marked. The longest arrow stands
    for a score of length `greatest`, None: for the arrows' own scale. A `small` map has fewer ticks and smaller marks.
    """
    axes.set_title(content.title, pad=3)
    axes.spines[:].set(color=FAINT)
    degrees(axes, "x", 60)
    degrees(axes, "y", 30)
    low, high, drawn = -limit, limit, None
    if content.density is not None:  # light below arrows
        _draw_ground(axes, content.density, RELIEF if content.arrows is None else DENSITY, Normalize(0, 1))
    if content.relief is not None:
        drawn = _draw_ground(axes, content.relief, RELIEF)
        low, high = (math.degrees(content.relief.latitude[end].item()) for end in (0, -1))
        for minimum in marked_minima(content.relief):
            place = math.degrees(minimum.longitude), math.degrees(minimum.latitude)
            axes.plot(*place, zorder=2, **MINIMUM_MARK)
    if content.arrows is not None:
        scale = greatest if greatest is not None else content.arrows.scale or content.arrows.longest() or 1.0
        if scale > 0:
            latitude, longitude, score, _ = content.arrows
            drawn = axes.quiver(
                longitude, latitude, score[..., 1], score[..., 0], content.arrows.lengths(),
                cmap=MAGNITUDE, norm=Normalize(0, scale), angles="xy", scale_units="xy",
                scale=scale * len(longitude) / (1.15 * 360),  # the longest is about as long as columns are apart
                pivot="mid", units="inches", width=0.0125, headwidth=4, headlength=4.5, headaxislength=4,
                minlength=0.5, zorder=1,
            )  # fmt: skip
    if content.ways is not None:
        _draw_ways(axes, content.ways, max(-low, high))
    if truth is not None:
        _points(axes, truth[None], max(-low, high), **TRUTH_MARK, zorder=7)
    axes.set(xlim=(0, 360), ylim=(low, high))
    if small:
        axes.set(xticks=[0, 90, 180, 270], yticks=[-30, 0, 30])
        axes.tick_params(pad=2)
        small_marks(axes)
    return drawn


def _draw_ground(
    axes: Axes, landscape: Landscape, colours: str | Colormap, norm: Normalize | None = None
) -> ScalarMappable:
    """The energies as colours with contour lines."""
    latitude, longitude, energy = closed(landscape)
    place = longitude, latitude, energy
    levels = LEVELS if norm is None else np.linspace(0.1, 0.9, LEVELS)
    if np.nanmax(energy) > np.nanmin(energy):
        axes.contour(*place, levels=levels, colors="white", linewidths=0.4, alpha=0.55, zorder=0.5)
    return axes.pcolormesh(*place, cmap=colours, norm=norm, shading="gouraud", zorder=0)


def _draw_ways(axes: Axes, ways: Ways, limit: float) -> None:
    for number, path in enumerate(() if ways.paths is None else np.rad2deg(ways.paths)):
        latitude, longitude = broken_at_seam(path[:, 0], path[:, 1])
        answer = number == ways.chosen
        width = 1.5 if answer else 0.8
        axes.plot(
            longitude, latitude, color=ANSWER if answer else OTHERS, linewidth=width, solid_joinstyle="round",
            path_effects=[withStroke(linewidth=width + 1.0, foreground="white")],
            zorder=4 if answer else 3,
        )  # fmt: skip
    if ways.starts is not None:
        _points(axes, ways.starts, limit, **START_MARK, zorder=5)
    _points(axes, ways.ends, limit, **END_MARK, zorder=5)
    if ways.chosen is not None:
        _points(axes, ways.ends[[ways.chosen]], limit, **CHOSEN_MARK, zorder=8)


def _points(axes: Axes, poses: NDArray, limit: float, **mark: Any) -> None:
    latitude, longitude = np.rad2deg(poses[:, 0]), np.rad2deg(poses[:, 1]) % 360
    # What lies on the seam is on both edges of the map, and none of its mark is cut off there.
    for shift in (0.0, 360.0, -360.0):
        shown = (np.abs(latitude) <= limit) & (np.abs(longitude + shift - 180) <= 180 + SEAM)
        axes.plot(longitude[shown] + shift, latitude[shown], clip_on=False, **mark)


def broken_at_seam(latitude: NDArray, longitude: NDArray) -> tuple[NDArray, NDArray]:
    """A path `[S]`, `[S]` (degrees) as a line on the map 0..360: (latitude, longitude), both `[S + 3 K]`.

    Each of the K times that the path crosses the seam the line runs up to one edge of the map, breaks (NaN), and goes
    on from the other edge. From one point to the next the path takes the shorter way around.

    >>> broken_at_seam(np.array([0.0, 4.0]), np.array([350.0, 370.0]))
    (array([ 0.,  2., nan,  2.,  4.]), array([350., 360.,  nan,   0.,  10.]))
    """
    latitude, unreduced = np.asarray(latitude, float), np.unwrap(np.asarray(longitude, float), period=360.0)
    lap = np.floor(unreduced / 360.0)
    last = np.flatnonzero(lap[1:] != lap[:-1])  # the points before a crossing
    seam, eastward = 360.0 * np.maximum(lap[last], lap[last + 1]), lap[last + 1] > lap[last]
    share = (seam - unreduced[last]) / (unreduced[last + 1] - unreduced[last])
    crossing = latitude[last] + share * (latitude[last + 1] - latitude[last])
    gap, edge = np.full_like(crossing, math.nan), np.where(eastward, 360.0, 0.0)
    places = np.repeat(last + 1, 3)
    return (
        np.insert(latitude, places, np.stack([crossing, gap, crossing], axis=1).ravel()),
        np.insert(unreduced - 360.0 * lap, places, np.stack([edge, gap, 360.0 - edge], axis=1).ravel()),
    )


def closed(landscape: Landscape) -> tuple[NDArray, NDArray, NDArray]:
    """Latitudes `[A]` and longitudes `[O + 1]` in degrees, and energies `[A, O + 1]`: 360 degrees is 0 again."""
    energy = landscape.energy.double().cpu().numpy()
    latitude, longitude = (np.rad2deg(each.double().cpu().numpy()) for each in landscape[:2])
    return latitude, np.append(longitude, 360.0), np.concatenate([energy, energy[:, :1]], axis=1)


def marked_minima(landscape: Landscape) -> list[LandscapeMinimum]:
    """The minima that are marked: none on a plateau, where any place along the longitude would do."""
    return landscape.minima() if landscape.flatness() < FLAT else []


def small_marks(axes: Axes) -> None:
    """The marks of a large map made fit for a small one."""
    for line in axes.lines:
        line.set_markersize(0.75 * line.get_markersize())


def keys(maps: Sequence[PoseMap], truth: NDArray | None) -> list[Line2D]:
    """The key's entries, for what is drawn."""
    ways = [each.ways for each in maps if each.ways is not None]
    entries: list[tuple[bool, str, dict[str, Any]]] = [
        (truth is not None, "true pose", TRUTH_MARK),
        (any(each.chosen is not None for each in ways), "answer", CHOSEN_MARK),
        (any(len(each.ends) > (each.chosen is not None) for each in ways), "end", END_MARK),
        (any(each.starts is not None and len(each.starts) > 0 for each in ways), "start", START_MARK),
        (any(each.relief and marked_minima(each.relief) for each in maps), "local minimum", MINIMUM_MARK),
    ]
    return [Line2D([], [], label=label, **mark) for shown, label, mark in entries if shown]


# ---------------------------------------------------------------- pages

# Inches: the page's width, margins, and the room between images and maps for labels; the map's colour bar.
WIDTH, SIDE, TOP, LABELS, BAR = 8.0, 0.1, 0.74, 0.62, 0.78
BELOW, BETWEEN, CAPTION = 0.66, 0.3, 0.2  # a map's labels and its key; between maps; a line above an image
IMAGE, LARGEST_VIEW = 1.72, 1.2  # sides


def _place_map(
    sheet: Sheet, x: float, y: float, wide: float, content: PoseMap, truth: NDArray | None, limit: float
) -> None:
    """A landscape's map in its box, with labels, colour bar and key around it."""
    tall = wide * limit / 180
    axes = sheet.axes(x, y, wide, tall)
    relief = draw_map(axes, content, truth, limit)
    axes.set_xlabel(ALONG)
    axes.set_ylabel("latitude")
    _place_bar(sheet, relief, x + wide, y, tall, "denoising error")
    sheet.legend(keys([content], truth), x + wide, y + tall + 0.42)


def _place_bar(sheet: Sheet, drawn: ScalarMappable | None, x: float, y: float, tall: float, label: str) -> None:
    """The colour bar to the right of a map."""
    assert drawn is not None
    axes = sheet.axes(x + 0.12, y, 0.1, tall)
    sheet.figure.colorbar(drawn, cax=axes).set_label(label)
    axes.locator_params(axis="y", nbins=6)
    axes.spines[:].set_visible(False)


@styled
def map_figure(landscape: Landscape, ways: Ways | None = None, truth: NDArray | None = None, title: str = "") -> Figure:
    """A landscape from above, with the ways of a solver and the true relative pose `[3]` (radians)."""
    wide, limit, above = 4.6, _limit(landscape), CAPTION if title else SIDE
    sheet = Sheet(LABELS + wide + BAR, above + wide * limit / 180 + BELOW)
    _place_map(sheet, LABELS, above, wide, PoseMap(title, relief=landscape, ways=ways), truth, limit)
    return sheet.figure


@styled
def pair_figure(pair: ShownPair, views: Sequence[NDArray], title: str, note: str, heading: str = "") -> Figure:
    """The paper's Figure 2: both images, the prior's landscape under the solver's ways, and below it `views`.

    These, `[H, W, 3]` each, are what the prior generates at the ends; `heading` is the map's.
    """
    limit = _limit(pair.prior_energy)
    left = SIDE + IMAGE + LABELS
    wide = WIDTH - left - BAR
    columns = max(1, min(len(views), 5))
    view = min(LARGEST_VIEW, (wide - 0.1 * (columns - 1)) / columns)
    rows = -(-len(views) // columns)
    below = wide * limit / 180 + BELOW + bool(views) * CAPTION + rows * (view + CAPTION)
    content = max(2 * IMAGE + CAPTION, below)
    sheet = Sheet(WIDTH, TOP + content + SIDE)
    sheet.head(title, note)
    sheet.image(SIDE, TOP, IMAGE, pair.reference.image, "reference")
    sheet.image(SIDE, TOP + content - IMAGE, IMAGE, pair.query.image, "query")
    _place_map(sheet, left, TOP, wide, PoseMap(heading, relief=pair.prior_energy, ways=pair.ways), pair.truth, limit)
    top = TOP + content - rows * (view + CAPTION)
    if views:
        sheet.above(left, top, "Generated at the ends of the trajectories, by their starts", fontsize=8)
    for number, (image, caption) in enumerate(zip(views, captions(pair), strict=True)):
        row, column = divmod(number, columns)
        x, y = left + column * (wide - view) / max(1, columns - 1), top + row * (view + CAPTION) + CAPTION
        frame: Any = {"color": ANSWER, "linewidth": 1.6} if number == pair.chosen else {}
        sheet.image(x, y, view, image, caption, **frame)
    return sheet.figure


@styled
def field_figure(pair: ShownPair, title: str, note: str) -> Figure:
    """Both images of a pair beside its maps, one below the other, with the true relative pose."""
    maps, truth = pair.maps, pair.truth
    assert truth is not None
    limit = _latitude_limit(truth, maps)
    columns = 1 if len(maps) > 1 else 2  # of images
    greatest = max((each.arrows.longest() for each in maps if each.arrows is not None), default=0.0)
    right = BAR if greatest > 0 else 2 * SIDE
    # Images are as high as the maps, whose scale is the same along both axes.
    wide = (WIDTH - SIDE - 0.1 * (columns - 1) - LABELS - right) / (1 + columns * limit / 180)
    high = wide * limit / 180
    tall = len(maps) * high + (len(maps) - 1) * BETWEEN
    sheet = Sheet(WIDTH, TOP + tall + BELOW)
    sheet.head(title, note)
    for index, (view, name) in enumerate(((pair.reference, "reference"), (pair.query, "query"))):
        column, row = (0, index) if columns == 1 else (index, 0)
        sheet.image(SIDE + column * (high + 0.1), TOP + row * (high + BETWEEN), high, view.image, name)
    x = WIDTH - right - wide
    for row, content in enumerate(maps):
        axes = sheet.axes(x, TOP + row * (high + BETWEEN), wide, high)
        if row == 0 and content.arrows is not None:
            radius = f"{truth[2]:+.2f}".replace("-", "\u2212")
            axes.set_title(f"at the true relative radius, {radius}", loc="right", color=MUTED, pad=3)
        drawn = draw_map(axes, content, truth, limit, greatest)
        axes.tick_params(labelbottom=row == len(maps) - 1)
        axes.set_ylabel("latitude")
    axes.set_xlabel(ALONG)
    if greatest > 0:
        _place_bar(sheet, drawn, WIDTH - right, TOP, tall, "score magnitude (1/rad)")
    sheet.legend(keys(maps, truth), WIDTH - right, TOP + tall + 0.42)
    return sheet.figure


def captions(pair: ShownPair) -> list[str]:
    """For every end of a pair the longitude of its start, and how far off it is, as far as they are known."""
    return [": ".join(filter(None, each)) for each in zip(start_names(pair), errors_in_words(pair), strict=True)]


def start_names(pair: ShownPair) -> list[str]:
    """The longitude of every start, reduced and rounded to a degree."""
    if pair.starts is None:
        return [""] * len(pair.ends)
    return [f"{longitude:.0f}°" for longitude in np.rad2deg(pair.starts[:, 1]) % 360]


def errors_in_words(pair: ShownPair) -> list[str]:
    """The rotation error of every end."""
    return ["" if np.isnan(error) else f"{error:.0f}° off" for error in pair.rotation_errors]


def _limit(landscape: Landscape) -> float:
    """The greatest latitude, degrees."""
    return math.degrees(landscape.latitude.abs().max().item())


def _latitude_limit(truth: NDArray, maps: Sequence[PoseMap]) -> float:
    """60 degrees, or the multiple of 15 above it that shows the truth and every answer (at most 180)."""
    ways = [each.ways for each in maps if each.ways is not None and each.ways.chosen is not None]
    shown = [truth, *(each.ends[each.chosen] for each in ways)]
    furthest = max((abs(math.degrees(pose[0])) for pose in shown if math.isfinite(pose[0])), default=0.0)
    return min(180.0, max(60.0, 15.0 * math.ceil((furthest + 2) / 15)))
