"""Maps over relative latitude and longitude, and surfaces: energies, scores, and the trajectories of a solver.

For one pair with its images, and for the paper's figures of several pairs.
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

SEAM = 0.5  # degrees; points closer to the seam are drawn on both sides of it
# Dark minima to light maxima, with even lightness, so that it works in grey and for any kind of colour vision.
RELIEF = "cividis"
LEVELS = 9  # contour lines

WIDTH = 7.0  # of the paper's figures, inches
COLUMNS = 3  # of surfaces


def _mark(marker: str, size: float, face: str, edge: str, width: float, **others: Any) -> dict[str, Any]:
    look = {"markersize": size, "markerfacecolor": face, "markeredgecolor": edge, "markeredgewidth": width}
    return {"linestyle": "none", "marker": marker, **look, **others}


TRUTH_MARK = _mark("*", 14, style.TRUTH, style.INK, 0.8)
CHOSEN_MARK = _mark("D", 5, style.ANSWER, "white", 0.8)
END_MARK = _mark("o", 4, style.OTHERS, "white", 0.6)
START_MARK = _mark("o", 4.5, "white", style.OTHERS, 1.0)
MINIMUM_MARK = _mark("+", 9, style.INK, "white", 1.3, path_effects=[withStroke(linewidth=2.5, foreground=style.INK)])


def draw_map(axes: Axes, content: PoseMap, truth: NDArray | None = None, limit: float = 60.0) -> ScalarMappable | None:
    """Draw a map and the true relative pose `[3]`. Latitudes are those of the relief, or within `limit` degrees.
    Returns what a colour bar of the relief or the arrows needs.
    """
    axes.set_title(content.title, pad=3)
    axes.spines[:].set(color=style.FAINT)
    style.degrees(axes.xaxis, 60)
    style.degrees(axes.yaxis, 30)
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
            scale=scale * len(longitude) / (1.15 * 360),  # the longest arrow is about as long as a column is wide
            pivot="mid", units="inches", width=0.0125, headwidth=4, headlength=4.5, headaxislength=4,
            minlength=0.5, zorder=1,
        )  # fmt: skip
    if content.solved is not None:
        _draw_trajectories(axes, content.solved, max(-low, high))
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


def _draw_trajectories(axes: Axes, solved: ShownPair, limit: float) -> None:
    for number, path in enumerate(() if solved.trajectories is None else np.rad2deg(solved.trajectories)):
        latitude, longitude = broken_at_seam(path[:, 0], path[:, 1])
        answer = number == solved.chosen
        width, colour = (1.5, style.ANSWER) if answer else (0.8, style.OTHERS)
        halo = [withStroke(linewidth=width + 1.0, foreground="white")]
        look: dict[str, Any] = {"color": colour, "linewidth": width, "path_effects": halo, "zorder": 3 + answer}
        axes.plot(longitude, latitude, solid_joinstyle="round", **look)
    if solved.starts is not None:
        _points(axes, solved.starts, limit, **START_MARK, zorder=5)
    _points(axes, solved.ends, limit, **END_MARK, zorder=5)
    if solved.chosen is not None:
        _points(axes, solved.ends[[solved.chosen]], limit, **CHOSEN_MARK, zorder=8)


def _points(axes: Axes, poses: NDArray, limit: float, **mark: Any) -> None:
    latitude, longitude = np.rad2deg(poses[:, 0]), np.rad2deg(poses[:, 1]) % 360
    # Points on the seam appear on both edges of the map, and their marks are not clipped.
    for shift in (0.0, 360.0, -360.0):
        shown = (np.abs(latitude) <= limit) & (np.abs(longitude + shift - 180) <= 180 + SEAM)
        if shown.any():  # an empty unclipped line would break the layout
            axes.plot(longitude[shown] + shift, latitude[shown], clip_on=False, **mark)


def broken_at_seam(latitude: NDArray, longitude: NDArray) -> tuple[NDArray, NDArray]:
    """Convert a path `[S]`, `[S]` (degrees) to a line on the map 0..360: (latitude, longitude), both `[S + 3 K]`.

    At each of K crossings of the seam, the line runs to one edge of the map, breaks (NaN), and continues from the
    other edge. Consecutive points are joined the shorter way around.

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
    """Latitudes `[A]`, longitudes `[O + 1]` (degrees) and energies `[A, O + 1]`, with longitude 0 repeated at 360."""
    energy = landscape.energy.double().cpu().numpy()
    latitude, longitude = (np.rad2deg(each.double().cpu().numpy()) for each in landscape[:2])
    return latitude, np.append(longitude, 360.0), np.concatenate([energy, energy[:, :1]], axis=1)


def marked_minima(landscape: Landscape) -> list[LandscapeMinimum]:
    """The minima to mark: none on a plateau, where all longitudes are equally good."""
    return landscape.minima() if landscape.flatness() < FLAT else []


def minima_in_words(landscape: Landscape) -> str:
    """The number of minima in words, or "plateau"."""
    count = len(landscape.minima())
    return "plateau" if landscape.flatness() >= FLAT else f"{count} minim{'um' if count == 1 else 'a'}"


def small_marks(axes: Axes) -> None:
    """Shrink the marks of a large map for a small one."""
    for line in axes.lines:
        line.set_markersize(0.75 * line.get_markersize())


def keys(maps: Sequence[PoseMap], truth: NDArray | None) -> list[Line2D]:
    """Legend entries for what is drawn."""
    solved = [each.solved for each in maps if each.solved is not None]
    entries: list[tuple[bool, str, dict[str, Any]]] = [
        (truth is not None, "true pose", TRUTH_MARK),
        (any(each.chosen is not None for each in solved), "answer", CHOSEN_MARK),
        (any(len(each.ends) > (each.chosen is not None) for each in solved), "end", END_MARK),
        (any(each.starts is not None and len(each.starts) > 0 for each in solved), "start", START_MARK),
        (any(each.relief and marked_minima(each.relief) for each in maps), "local minimum", MINIMUM_MARK),
    ]
    return [Line2D([], [], label=label, **mark) for shown, label, mark in entries if shown]


@style.styled
def pair_figure(
    pair: ShownPair, maps: Sequence[PoseMap], title: str, note: str, views: Sequence[NDArray] = ()
) -> Figure:
    """Both images of a pair beside maps in one scale, and below them the prior's `views` at the ends, `[H, W, 3]`
    each: the paper's Figure 2.
    """
    limit = _limit(pair.truth, maps)
    rows, high = -(-len(views) // 5), len(maps) * (0.4 + 5.0 * limit / 180) + 0.5
    below = 0.3 + 1.2 * rows if rows else 0.0
    figure, body = style.page(8.0, 0.8 + max(4.0, high + below), title, note)
    left, right = style.beside(body, 1.9, 6.1)
    for axes, name in zip(left.subplots(2, 1), ("reference", "query"), strict=True):
        style.show_image(axes, getattr(pair, name).image, name)
    upper, *lower = style.stacked(right, high, below) if rows else [right]
    panels = upper.subplots(len(maps), 1, sharex=True, squeeze=False)[:, 0]
    for axes, each in zip(panels, maps, strict=True):
        drawn = draw_map(axes, each, pair.truth, limit)
        axes.set_ylabel("latitude")
    axes.set_xlabel("longitude of the query relative to the reference")
    if drawn is not None:
        bar = upper.colorbar(drawn, ax=panels, aspect=30, pad=0.02)
        bar.set_label("denoising error" if each.arrows is None else "score magnitude (1/rad)")
        bar.outline.set_visible(False)
    marks = keys(maps, pair.truth)
    figure.legend(handles=marks, loc="outside lower right", ncols=len(marks), handletextpad=0.3, columnspacing=1.3)
    for part in lower:
        part.suptitle("Views generated at the final poses, labelled by start longitude", x=0.05, ha="left", fontsize=8)
        shown = zip(style.panels(part, len(views), 5), views, ends_in_words(pair), strict=True)
        for number, (axes, image, words) in enumerate(shown):
            frame: Any = {"color": style.ANSWER, "linewidth": 1.6} if number == pair.chosen else {}
            style.show_image(axes, image, ": ".join(filter(None, words)), **frame)
    return figure


@style.styled
def surface_figure(landscape: Landscape, truth: NDArray | None = None, title: str = "") -> Figure:
    """The landscape as a surface above its own map; the true relative pose `[3]` (radians) is marked on both."""
    figure = Figure(figsize=(4.8, 3.6))
    figure.suptitle(title, x=0.02, ha="left", fontsize=10, fontweight="bold")
    _draw_surface(figure.add_axes((-0.02, -0.03, 0.98, 1.05), projection="3d"), landscape, truth)
    return figure


def small_surface(axes: Axes3D, landscape: Landscape, truth: NDArray | None) -> None:
    """Draw a landscape as a small surface, scaled to its own range."""
    _draw_surface(axes, landscape, truth)
    axes.set(xlabel="", ylabel="", zlabel="", xticks=[0, 90, 180, 270], yticks=[-30, 30])
    axes.patch.set_visible(False)
    axes.tick_params(labelsize=6, pad=-4)
    axes.locator_params(axis="z", nbins=3)
    axes.set_box_aspect((2.0, 1.2, 0.95), zoom=1.2)  # 3-D axes leave wide margins
    axes.set_in_layout(False)
    small_marks(axes)


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
        axes.plot(*([each, each] for each in place), [floor, low + relief], color=style.INK, linewidth=0.8, zorder=10)
        axes.plot(*([each] for each in place), [floor], zorder=11, **TRUTH_MARK)
    axes.view_init(elev=32, azim=-62)
    axes.set_box_aspect((2.0, 1.15, 0.95), zoom=1.04)
    axes.tick_params(pad=-2)
    axes.set_xlabel("relative longitude", labelpad=-2)
    axes.set_ylabel("relative latitude", labelpad=-2)
    axes.set_zlabel("denoising error", labelpad=-2)
    axes.xaxis.set_major_locator(MultipleLocator(60))
    # No ticks at the ends: the corner shows the label of 360 degrees.
    axes.set_yticks([each for each in range(-150, 180, 30) if latitude[0] + 1 < each < latitude[-1] + 1])
    axes.set_zticks([each for each in MaxNLocator(4).tick_values(low, high) if low <= each <= high])
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        if axis is not axes.zaxis:
            axis.set_major_formatter(StrMethodFormatter("{x:g}°"))
        axis.pane.set_visible(False)
        axis._axinfo["grid"].update(color=style.FAINT, linewidth=0.4)


def ends_in_words(pair: ShownPair) -> list[tuple[str, str]]:
    """For every end of a pair, the longitude of its start and the rotation error; empty if unknown."""
    starts = ["" if longitude is None else f"{longitude:.0f}°" for longitude in pair.start_longitudes()]
    errors = ["" if np.isnan(error) else f"{error:.0f}° off" for error in pair.rotation_errors]
    return list(zip(starts, errors, strict=True))


def _limit(truth: NDArray | None, maps: Sequence[PoseMap]) -> float:
    """The landscape's greatest latitude (degrees); without one, at least 60 and enough to show truth and answers."""
    if (relief := maps[0].relief) is not None:
        return math.degrees(relief.latitude.abs().max().item())
    solved = [each.solved for each in maps if each.solved is not None and each.solved.chosen is not None]
    shown = [each.ends[each.chosen] for each in solved] + ([] if truth is None else [truth])
    furthest = max((abs(math.degrees(pose[0])) for pose in shown if math.isfinite(pose[0])), default=0.0)
    return min(180.0, max(60.0, 15.0 * math.ceil((furthest + 2) / 15)))


@style.styled
def surfaces_figure(pairs: Sequence[ShownPair]) -> Figure:
    """One column per pair: reference and query above the surface of the prior's energy, scaled to its own range."""
    rows = -(-len(pairs) // COLUMNS)
    figure = Figure(figsize=(WIDTH, 3.0 * rows), layout="constrained")
    places = figure.subfigures(rows, COLUMNS, squeeze=False).flat
    for number, (part, pair) in enumerate(zip(places, pairs, strict=False)):
        panels = part.subplot_mosaic([["reference", "query"], ["surface", "surface"]], height_ratios=[1, 1.7],
                                     per_subplot_kw={"surface": {"projection": "3d"}})  # fmt: skip
        style.show_image(panels["reference"], pair.reference.image, style.letter(number, pair.title))
        style.show_image(panels["query"], pair.query.image)
        panels["query"].set_title(minima_in_words(pair.prior_energy), loc="right", **style.ASIDE)
        small_surface(panels["surface"], pair.prior_energy, pair.truth)
        panels["surface"].set_xlabel("longitude", fontsize=7, labelpad=-8)
        panels["surface"].set_ylabel("latitude", fontsize=7, labelpad=-8)
    return figure


@style.styled
def trajectories_figure(pair: ShownPair, views: NDArray, steps: Sequence[int]) -> Figure:
    """(a), (b) both images; (c) `views` `[N, K, H, W, 3]` at `steps`, one row per trajectory; (d) the landscape."""
    figure = Figure(figsize=(WIDTH, max(3.0, 0.4 + 0.65 * len(views))), layout="constrained")
    left, middle, right = style.beside(figure, 1.2, 0.6 + 0.62 * len(steps), 2.5)
    _draw_pair(left.subplots(2, 1), pair)
    middle.suptitle("(c) generated along the trajectories", x=0.02, ha="left", fontsize=8.5)
    grid = middle.subplots(*views.shape[:2], squeeze=False)
    for number, (row, words) in enumerate(zip(grid, ends_in_words(pair), strict=True)):
        answer = number == pair.chosen
        frame: Any = {"color": style.ANSWER, "linewidth": 1.2} if answer else {}
        for axes, image, step in zip(row, views[number], steps, strict=True):
            style.show_image(axes, image, **frame)
            if number == 0:
                axes.set_title(f"step {step}", loc="center", **style.ASIDE)
        start, off = words
        row[0].set_ylabel(f"from {start}\n{off}", fontsize=7, rotation=0, ha="right", va="center",
                          color=style.ANSWER if answer else style.INK)  # fmt: skip
    above, below = style.stacked(right, 1, 1.1)
    _small_map(above.subplots(), PoseMap("(d) landscape", relief=pair.prior_energy, solved=pair), pair.truth)
    small_surface(below.subplots(subplot_kw={"projection": "3d"}), pair.prior_energy, pair.truth)
    return figure


class FailureRow(NamedTuple):
    """A pair and views `[K, H, W, 3]` around the object: from its mesh (None without one), and from the prior."""

    pair: ShownPair
    rendered: NDArray | None
    generated: NDArray


@style.styled
def failures_figure(rows: Sequence[FailureRow]) -> Figure:
    """One row per pair: reference above query, views all around (rendered above generated), the landscape."""
    figure = Figure(figsize=(WIDTH, 0.3 + 1.75 * len(rows)), layout="constrained")
    count = len(rows[0].generated)
    parts = style.stacked(figure, *[1] * len(rows))
    for number, (part, (pair, *swept)) in enumerate(zip(parts, rows, strict=True)):
        left, middle, right = style.beside(part, 1.0, 0.3 + 0.55 * count, 2.2)
        _draw_pair(left.subplots(2, 1), pair, [pair.title, ""])
        lines = {name: views for name, views in zip(("mesh", "prior"), swept, strict=True) if views is not None}
        grid = middle.subplots(len(lines), count, squeeze=False)
        for row, (name, views) in zip(grid, lines.items(), strict=True):
            row[0].set_ylabel(name, fontsize=7.5)
            for axes, image in zip(row, views, strict=True):
                style.show_image(axes, image)
        for axes, place in zip(grid[0], range(count), strict=True):
            axes.set_title(f"{360 * place / count:g}°", loc="center", **style.ASIDE)
        _small_map(right.subplots(), PoseMap(relief=pair.prior_energy), pair.truth, last=number == len(rows) - 1)
        if number == 0:
            titles = ("(a) pair", "(b) views around the object", "(c) landscape")
            for each, title in zip((left, middle, right), titles, strict=True):
                each.suptitle(title, x=0.02, ha="left", fontsize=8.5)
    return figure


@style.styled
def toy_figure(pair: ShownPair, densities: Mapping[str, Landscape]) -> Figure:
    """(a) reference and query, then the pair's four maps and exp(-E) of two energies by title, in two rows."""
    figure = Figure(figsize=(WIDTH, 3.1), layout="constrained")
    left, right = style.beside(figure, 4.6, 2.2)
    panels = left.subplot_mosaic("abc\nqde", width_ratios=[1.1, 1.5, 1.5])
    _draw_pair([panels["a"], panels["q"]], pair, ["(a) reference", "query"])
    for place, content in zip("bcde", pair.maps, strict=True):
        titled = content._replace(title=f"({place}) {content.title}")
        _small_map(panels[place], titled, pair.truth, first=place in "bd", last=place in "de")
    surfaces = right.subplots(2, 1, subplot_kw={"projection": "3d"})
    for axes, place, (title, density) in zip(surfaces, "fg", densities.items(), strict=True):
        axes.set_title(f"({place}) {title}", y=0.95)
        small_surface(axes, density, pair.truth)
    return figure


@style.styled
def comparison_figure(pairs: Sequence[ShownPair], titles: Sequence[str]) -> Figure:
    """One row per pair: reference above query, and its maps with small titles; `titles` head the columns."""
    figure = Figure(figsize=(WIDTH, 0.4 + 1.45 * len(pairs)), layout="constrained")
    names = [[f"reference {row}", f"query {row}"] for row in range(len(pairs))]
    mosaic: list[Any] = [[name, *(f"map {row} {column}" for column in range(len(titles)))]
              for row, both in enumerate(names) for name in both]  # fmt: skip
    panels = figure.subplot_mosaic(mosaic, width_ratios=[0.5, *[1.7] * len(titles)])
    for row, (pair, both) in enumerate(zip(pairs, names, strict=True)):
        _draw_pair([panels[name] for name in both], pair, [style.letter(0, pair.title) if row == 0 else pair.title, ""])
        for column, content in enumerate(pair.maps):
            axes, last = panels[f"map {row} {column}"], row == len(pairs) - 1
            title = style.letter(column + 1, titles[column]) if row == 0 else ""
            _small_map(axes, content._replace(title=title), pair.truth, first=column == 0, last=last)
            axes.set_title(content.title, loc="right", **style.ASIDE)
    return figure


def _draw_pair(panels: Sequence[Axes], pair: ShownPair, titles: Sequence[str] = ("(a) reference", "(b) query")) -> None:
    for axes, view, title in zip(panels, (pair.reference, pair.query), titles, strict=True):
        style.show_image(axes, view.image, title)


def _small_map(axes: Axes, content: PoseMap, truth: NDArray | None, first: bool = True, last: bool = True) -> None:
    """Draw a small map, with axis labels if it is the first in its row or in the last row."""
    draw_map(axes, content, truth)
    axes.set(xticks=[0, 90, 180, 270], yticks=[-30, 0, 30])
    axes.tick_params(pad=2, labelleft=first, labelbottom=last)
    small_marks(axes)
    axes.set_ylabel("latitude" if first else "", labelpad=0)
    axes.set_xlabel("longitude" if last else "", labelpad=1)
