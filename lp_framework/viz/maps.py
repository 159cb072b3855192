"""Maps of relative latitude and longitude, and in 3-D: energies, scores, and the ways that a solver took over them.

Of one pair with its images, and the paper's figures of several.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator, MultipleLocator, StrMethodFormatter
from mpl_toolkits.mplot3d import Axes3D  # type: ignore[import-untyped]
from numpy.typing import NDArray

from lp_framework.analysis.landscapes import FLAT, Landscape, LandscapeMinimum
from lp_framework.analysis.pairs import PoseMap, ShownPair
from lp_framework.viz import style
from lp_framework.viz.style import ANSWER, ASIDE, FAINT, INK, OTHERS, TRUTH, Sheet, degrees, letter, styled

SEAM = 0.5  # degrees; what is nearer to the seam is drawn on both sides of it
# From dark valleys to light heights, evenly in lightness, so that grey and any kind of colour vision see the same.
RELIEF = "cividis"
LEVELS = 9  # contour lines

# Of the page of a pair, in inches: its width, margins, and the room between images and maps for labels; the maps'
# colour bar; the maps' labels and their key; between maps; a line above an image; sides of images.
PAGE_WIDTH, MARGIN, TOP, PAGE_LABELS, BAR = 8.0, 0.1, 0.74, 0.62, 0.78
BELOW, BETWEEN, CAPTION = 0.66, 0.38, 0.2
IMAGE, LARGEST_VIEW = 1.72, 1.2

# Of the paper's figures, in inches: width and margin, room for a title, gaps; maps, and the room for their labels.
WIDTH, SIDE, TITLE, GAP = 7.0, 0.06, 0.24, 0.05
TALL, WIDE, LABELS, BOTTOM = 1.16, 1.55, 0.46, 0.4
COLUMNS = 3  # of surfaces
SMALL = {**ASIDE, "fontsize": 7.0}


def _mark(marker: str, size: float, face: str, edge: str, width: float, **others: Any) -> dict[str, Any]:
    look = {"markersize": size, "markerfacecolor": face, "markeredgecolor": edge, "markeredgewidth": width}
    return {"linestyle": "none", "marker": marker, **look, **others}


TRUTH_MARK = _mark("*", 14, TRUTH, INK, 0.8)
CHOSEN_MARK = _mark("D", 5, ANSWER, "white", 0.8)
END_MARK = _mark("o", 4, OTHERS, "white", 0.6)
START_MARK = _mark("o", 4.5, "white", OTHERS, 1.0)
MINIMUM_MARK = _mark("+", 9, INK, "white", 1.3, path_effects=[withStroke(linewidth=2.5, foreground=INK)])


def draw_map(axes: Axes, content: PoseMap, truth: NDArray | None = None, limit: float = 60.0) -> ScalarMappable | None:
    """Draw a map, latitudes within `limit` degrees or those of the relief, and the true relative pose `[3]`; returns
    what a colour bar of its relief or its arrows needs.
    """
    axes.set_title(content.title, pad=3)
    axes.spines[:].set(color=FAINT)
    degrees(axes, "x", 60)
    degrees(axes, "y", 30)
    low, high, drawn = -limit, limit, None
    if content.density is not None:  # light below arrows
        _draw_ground(axes, content.density, RELIEF if content.arrows is None else style.DENSITY, Normalize(0, 1))
    if content.relief is not None:
        drawn = _draw_ground(axes, content.relief, RELIEF)
        low, high = (math.degrees(content.relief.latitude[end].item()) for end in (0, -1))
        for minimum in marked_minima(content.relief):
            place = math.degrees(minimum.longitude), math.degrees(minimum.latitude)
            axes.plot(*place, zorder=2, **MINIMUM_MARK)
    if content.arrows is not None:
        scale = content.arrows.scale or content.arrows.longest() or 1.0
        latitude, longitude, score, _ = content.arrows
        drawn = axes.quiver(
            longitude, latitude, score[..., 1], score[..., 0], content.arrows.lengths(),
            cmap=style.MAGNITUDE, norm=Normalize(0, scale), angles="xy", scale_units="xy",
            scale=scale * len(longitude) / (1.15 * 360),  # the longest is about as long as columns are apart
            pivot="mid", units="inches", width=0.0125, headwidth=4, headlength=4.5, headaxislength=4,
            minlength=0.5, zorder=1,
        )  # fmt: skip
    if content.ways is not None:
        _draw_ways(axes, content.ways, max(-low, high))
    if truth is not None:
        _points(axes, truth[None], max(-low, high), **TRUTH_MARK, zorder=7)
    axes.set(xlim=(0, 360), ylim=(low, high))
    return drawn


def _draw_ground(
    axes: Axes, landscape: Landscape, colours: str | Colormap, norm: Normalize | None = None
) -> ScalarMappable:
    latitude, longitude, energy = closed(landscape)
    place = longitude, latitude, energy
    levels = LEVELS if norm is None else np.linspace(0.1, 0.9, LEVELS)
    if np.nanmax(energy) > np.nanmin(energy):
        axes.contour(*place, levels=levels, colors="white", linewidths=0.4, alpha=0.55, zorder=0.5)
    return axes.pcolormesh(*place, cmap=colours, norm=norm, shading="gouraud", zorder=0)


def _draw_ways(axes: Axes, ways: ShownPair, limit: float) -> None:
    for number, path in enumerate(() if ways.trajectories is None else np.rad2deg(ways.trajectories)):
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


def minima_in_words(landscape: Landscape) -> str:
    """How many minima there are, or that it is a plateau."""
    count = len(landscape.minima())
    return "plateau" if landscape.flatness() >= FLAT else f"{count} minim{'um' if count == 1 else 'a'}"


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


@styled
def pair_figure(
    pair: ShownPair, maps: Sequence[PoseMap], title: str, note: str, views: Sequence[NDArray] = ()
) -> Figure:
    """Both images of a pair beside maps in one scale, and below these `views`, `[H, W, 3]` each, which the prior
    generates at the ends: the paper's Figure 2.
    """
    limit = _limit(pair.truth, maps)
    left = MARGIN + IMAGE + PAGE_LABELS
    wide = PAGE_WIDTH - left - BAR
    high = wide * limit / 180
    tall = len(maps) * (high + BETWEEN) - BETWEEN
    columns = max(1, min(len(views), 5))
    view = min(LARGEST_VIEW, (wide - 0.1 * (columns - 1)) / columns)
    below = tall + BELOW + bool(views) * CAPTION + -(-len(views) // columns) * (view + CAPTION)
    content = max(2 * IMAGE + CAPTION, below)
    sheet = Sheet(PAGE_WIDTH, TOP + content + MARGIN)
    sheet.head(title, note)
    sheet.image(MARGIN, TOP, IMAGE, pair.reference.image, "reference")
    top = TOP + (content - below) / 2
    lower = top + high + BETWEEN if len(maps) > 1 else TOP + content - IMAGE
    sheet.image(MARGIN, lower, IMAGE, pair.query.image, "query")
    for row, each in enumerate(maps):
        axes = sheet.axes(left, top + row * (high + BETWEEN), wide, high)
        drawn = draw_map(axes, each, pair.truth, limit)
        axes.tick_params(labelbottom=row == len(maps) - 1)
        axes.set_ylabel("latitude")
    axes.set_xlabel("longitude of the query relative to the reference")
    if drawn is not None:
        bar = sheet.axes(left + wide + 0.12, top, 0.1, tall)
        label = "denoising error" if each.arrows is None else "score magnitude (1/rad)"
        sheet.figure.colorbar(drawn, cax=bar).set_label(label)
        bar.locator_params(axis="y", nbins=6)
        bar.spines[:].set_visible(False)
    sheet.legend(keys(maps, pair.truth), left + wide, top + tall + 0.42)
    top += tall + BELOW + CAPTION
    if views:
        sheet.above(left, top, "Generated at the ends of the trajectories, by their starts", fontsize=8)
    for number, (image, caption) in enumerate(zip(views, captions(pair), strict=bool(views))):
        row, column = divmod(number, columns)
        x, y = left + column * (wide - view) / max(1, columns - 1), top + row * (view + CAPTION) + CAPTION
        frame: Any = {"color": ANSWER, "linewidth": 1.6} if number == pair.chosen else {}
        sheet.image(x, y, view, image, caption, **frame)
    return sheet.figure


@styled
def surface_figure(landscape: Landscape, truth: NDArray | None = None, title: str = "") -> Figure:
    """The landscape in 3-D over its own map; the true relative pose `[3]` (radians) is marked on both."""
    sheet = Sheet(4.8, 3.6)
    _draw_surface(sheet.axes(-0.096, -0.072, 4.704, 3.78, projection="3d"), landscape, truth)
    sheet.head(title)
    return sheet.figure


def small_surface(
    sheet: Sheet, x: float, y: float, wide: float, tall: float, landscape: Landscape, truth: NDArray | None
) -> Axes3D:
    """A landscape as a small surface that fills a box of the sheet, in its own range."""
    axes: Axes3D = sheet.axes(x, y, wide, tall, projection="3d")
    _draw_surface(axes, landscape, truth)
    axes.set(xlabel="", ylabel="", zlabel="", xticks=[0, 90, 180, 270], yticks=[-30, 30])
    axes.patch.set_visible(False)
    axes.tick_params(labelsize=6, pad=-4)
    axes.locator_params(axis="z", nbins=3)
    axes.set_box_aspect((2.0, 1.2, 0.95), zoom=1.16)  # axes in 3-D leave wide margins
    small_marks(axes)
    return axes


def _draw_surface(axes: Axes3D, landscape: Landscape, truth: NDArray | None) -> None:
    latitude, longitude, energy = closed(landscape)
    low, high = float(np.nanmin(energy)), float(np.nanmax(energy))
    relief = (high - low) or 1.0
    floor = low - 0.45 * relief
    x, y = np.meshgrid(longitude, latitude)
    axes.plot_surface(
        x, y, energy, cmap=RELIEF, vmin=low, vmax=low + relief, rstride=1, cstride=1, edgecolor="white",
        linewidth=0.15, antialiased=True, shade=False,
    )  # fmt: skip
    levels = np.linspace(low, low + relief, 2 * LEVELS)
    axes.contourf(x, y, energy, levels=levels, zdir="z", offset=floor, cmap=RELIEF)
    axes.set(xlim=(0, 360), ylim=(latitude[0], latitude[-1]), zlim=(floor, low + relief))
    if truth is not None:
        place = math.degrees(truth[1]) % 360, math.degrees(truth[0])
        axes.plot(*([each, each] for each in place), [floor, low + relief], color=INK, linewidth=0.8, zorder=10)
        axes.plot(*([each] for each in place), [floor], zorder=11, **TRUTH_MARK)
    axes.view_init(elev=32, azim=-62)
    axes.set_box_aspect((2.0, 1.15, 0.95), zoom=1.04)
    axes.tick_params(pad=-2)
    axes.set_xlabel("relative longitude", labelpad=-2)
    axes.set_ylabel("relative latitude", labelpad=-2)
    axes.set_zlabel("denoising error", labelpad=-2)
    axes.xaxis.set_major_locator(MultipleLocator(60))
    # The corner belongs to 360 degrees.
    axes.set_yticks([each for each in range(-150, 180, 30) if latitude[0] + 1 < each < latitude[-1] + 1])
    axes.set_zticks([each for each in MaxNLocator(4).tick_values(low, high) if low <= each <= high])
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        if axis is not axes.zaxis:
            axis.set_major_formatter(StrMethodFormatter("{x:g}°"))
        axis.pane.set_visible(False)
        axis._axinfo["grid"].update(color=FAINT, linewidth=0.4)


def captions(pair: ShownPair) -> list[str]:
    """For every end of a pair the longitude of its start, and how far off it is, as far as they are known."""
    return [": ".join(filter(None, each)) for each in ends_in_words(pair)]


def ends_in_words(pair: ShownPair) -> list[tuple[str, str]]:
    """For every end of a pair the longitude of its start, and the rotation error, or empty where not known."""
    starts = ["" if longitude is None else f"{longitude:.0f}°" for longitude in pair.start_longitudes()]
    errors = ["" if np.isnan(error) else f"{error:.0f}° off" for error in pair.rotation_errors]
    return list(zip(starts, errors, strict=True))


def _limit(truth: NDArray | None, maps: Sequence[PoseMap]) -> float:
    """The greatest latitude (degrees) of the landscape, or of 60 and up one that shows the truth and every answer."""
    if (relief := maps[0].relief) is not None:
        return math.degrees(relief.latitude.abs().max().item())
    solved = [each.ways for each in maps if each.ways is not None and each.ways.chosen is not None]
    shown = [each.ends[each.chosen] for each in solved] + ([] if truth is None else [truth])
    furthest = max((abs(math.degrees(pose[0])) for pose in shown if math.isfinite(pose[0])), default=0.0)
    return min(180.0, max(60.0, 15.0 * math.ceil((furthest + 2) / 15)))


@styled
def surfaces_figure(pairs: Sequence[ShownPair]) -> Figure:
    """A column a pair: reference and query above the surface of the prior's energy, whose height is its own range."""
    columns = min(COLUMNS, len(pairs))
    wide, image, tall = (WIDTH - 2 * SIDE) / columns, 0.96, 1.72
    sheet = Sheet(WIDTH, -(-len(pairs) // columns) * (TITLE + image + tall))
    for number, pair in enumerate(pairs):
        row, column = divmod(number, columns)
        x, y = SIDE + column * wide, row * (TITLE + image + tall) + TITLE
        sheet.above(x, y, letter(number, pair.title))
        for place, view in enumerate((pair.reference, pair.query)):
            sheet.image(x + place * (image + GAP), y, image, view.image)
        sheet.above(x + 2 * image + GAP, y, minima_in_words(pair.prior_energy), ha="right", **ASIDE)
        axes = small_surface(sheet, x - 0.06, y + image + 0.02, wide + 0.04, tall - 0.1, pair.prior_energy, pair.truth)
        axes.set_xlabel("longitude", fontsize=7, labelpad=-8)
        axes.set_ylabel("latitude", fontsize=7, labelpad=-8)
    return sheet.figure


@styled
def trajectories_figure(pair: ShownPair, views: NDArray, steps: Sequence[int]) -> Figure:
    """(a), (b) both images; (c) a row a trajectory, of `views` `[N, K, H, W, 3]` at `steps`; (d) the landscape."""
    view, label, bottom = 0.58, 0.6, 0.06
    tall = max(2.7, 0.18 + len(views) * (view + GAP) - GAP)
    image = min(1.1, (tall - TITLE) / 2)
    sheet = Sheet(WIDTH, TITLE + tall + bottom)
    for number, (name, each) in enumerate((("reference", pair.reference), ("query", pair.query))):
        y = TITLE + number * (tall - image)
        sheet.image(SIDE, y, image, each.image)
        sheet.above(SIDE, y, letter(number, name))
    left = SIDE + image + 0.12
    sheet.above(left, TITLE, "(c) generated on the way")
    for column, step in enumerate(steps):
        sheet.text(left + label + column * (view + GAP) + view / 2, TITLE + 0.12, f"step {step}", ha="center", **SMALL)
    for number, (row, (start, off)) in enumerate(zip(views, ends_in_words(pair), strict=True)):
        y = TITLE + 0.18 + number * (view + GAP)
        answer = number == pair.chosen
        look: Any = {"fontsize": 7, "color": ANSWER if answer else INK}
        sheet.text(left, y + view / 2, f"from {start}", va="bottom", **look)
        sheet.text(left, y + view / 2, off, va="top", **look)
        for column, picture in enumerate(row):
            frame: Any = {"color": ANSWER, "linewidth": 1.2} if answer else {}
            sheet.image(left + label + column * (view + GAP), y, view, picture, **frame)
    x = left + label + len(steps) * (view + GAP) + 0.44
    wide = WIDTH - SIDE - x
    high = wide * 0.52
    sheet.above(x, TITLE, "(d) landscape")
    _place_map(sheet, (x, TITLE, wide, high), PoseMap(relief=pair.prior_energy, ways=pair), pair.truth)
    lower = TITLE + high + 0.26
    small_surface(sheet, x - 0.2, lower, wide + 0.2, sheet.height - lower + 0.02, pair.prior_energy, pair.truth)
    return sheet.figure


class FailureRow(NamedTuple):
    """A pair and views `[K, H, W, 3]` around the object: from its mesh (None without one), and from the prior."""

    pair: ShownPair
    rendered: NDArray | None
    generated: NDArray


@styled
def failures_figure(rows: Sequence[FailureRow]) -> Figure:
    """A row a pair: reference above query, views evenly around, rendered above generated, the landscape."""
    longitudes = [360 * place / len(rows[0].generated) for place in range(len(rows[0].generated))]
    image, wide = 0.7, 1.72
    block = 2 * image + GAP
    sheet = Sheet(WIDTH, TITLE + len(rows) * (block + TITLE) + 0.3)
    left, right = SIDE + image + 0.42, WIDTH - SIDE - wide
    view = min(image, (right - 0.55 - left + GAP) / len(longitudes) - GAP)
    for x, title in ((SIDE, "(a) pair"), (left, "(b) turned around the object"), (right, "(c) landscape")):
        sheet.above(x, TITLE, title)
    for number, (pair, *swept) in enumerate(rows):
        upper = 2 * TITLE + number * (block + TITLE)
        sheet.above(SIDE, upper, pair.title, **ASIDE)
        for place, each in enumerate((pair.reference, pair.query)):
            sheet.image(SIDE, upper + place * (image + GAP), image, each.image)
        lines = [(name, views) for name, views in zip(("mesh", "prior"), swept, strict=True) if views is not None]
        top = upper + block / 2 - (len(lines) * (view + GAP) - GAP) / 2
        for line, (name, views) in enumerate(lines):
            y = top + line * (view + GAP)
            sheet.text(left - 0.08, y + view / 2, name, fontsize=7.5, rotation=90, ha="right", va="center")
            for column, picture in enumerate(views):
                sheet.image(left + column * (view + GAP), y, view, picture)
        for column, longitude in enumerate(longitudes):
            sheet.above(left + column * (view + GAP) + view / 2, top, f"{longitude:g}°", ha="center", **SMALL)
        box, last = (right, upper, wide, block - 0.1), number == len(rows) - 1
        _place_map(sheet, box, PoseMap(relief=pair.prior_energy), pair.truth, last=last)
    return sheet.figure


@styled
def toy_figure(pair: ShownPair, densities: Mapping[str, Landscape]) -> Figure:
    """(a) reference and query, then the pair's four maps and exp(-E) of two energies by title, in two rows."""
    sheet = Sheet(WIDTH, 2 * (TITLE + TALL) + BOTTOM)
    left = SIDE + TALL + LABELS
    right = left + 2 * (WIDE + 0.12)
    for row, (view, name) in enumerate(((pair.reference, "(a) reference"), (pair.query, "query"))):
        y = TITLE + row * (TITLE + TALL)
        sheet.image(SIDE, y, TALL, view.image)
        sheet.above(SIDE, y, name)
    for number, content in enumerate(pair.maps):
        row, column = divmod(number, 2)
        x, y = left + column * (WIDE + 0.12), TITLE + row * (TITLE + TALL)
        sheet.above(x, y, letter(number + 1, content.title))
        _place_map(sheet, (x, y, WIDE, TALL), content, pair.truth, first=column == 0, last=row == 1)
    for row, (title, density) in enumerate(densities.items()):
        y = TITLE + row * (TITLE + TALL)
        sheet.above(right, y, letter(len(pair.maps) + 1 + row, title))
        small_surface(sheet, right - 0.12, y - 0.1, WIDTH - right + 0.06, TALL + 0.15, density, pair.truth)
    return sheet.figure


@styled
def comparison_figure(pairs: Sequence[ShownPair], titles: Sequence[str]) -> Figure:
    """A row a pair: reference above query, and its maps, their own titles small; `titles` are those of the columns."""
    gap = 0.2
    side = (TALL - GAP) / 2
    left = SIDE + side + LABELS + 0.08
    wide = (WIDTH - SIDE - left - 2 * gap) / 3
    sheet = Sheet(WIDTH, TITLE + len(pairs) * (TITLE + TALL) + BOTTOM)
    sheet.above(SIDE, TITLE, "(a) pair")
    for column, title in enumerate(titles):
        sheet.above(left + column * (wide + gap), TITLE, letter(column + 1, title))
    for number, pair in enumerate(pairs):
        y = 2 * TITLE + number * (TITLE + TALL)
        sheet.above(SIDE, y, pair.title, **ASIDE)
        for place, view in enumerate((pair.reference, pair.query)):
            sheet.image(SIDE, y + place * (side + GAP), side, view.image)
        for column, content in enumerate(pair.maps):
            x, last = left + column * (wide + gap), number == len(pairs) - 1
            sheet.above(x + wide, y, content.title, ha="right", **ASIDE)
            _place_map(sheet, (x, y, wide, TALL), content, pair.truth, first=column == 0, last=last)
    return sheet.figure


def _place_map(
    sheet: Sheet, box: Sequence[float], content: PoseMap, truth: NDArray | None, first: bool = True, last: bool = True
) -> None:
    """A small map without its title, labelled where it is the first of its row and in the last one."""
    axes = sheet.axes(*box)
    draw_map(axes, content._replace(title=""), truth)
    axes.set(xticks=[0, 90, 180, 270], yticks=[-30, 0, 30])
    axes.tick_params(pad=2, labelleft=first, labelbottom=last)
    small_marks(axes)
    axes.set_ylabel("latitude" if first else "", labelpad=0)
    axes.set_xlabel("longitude" if last else "", labelpad=1)
