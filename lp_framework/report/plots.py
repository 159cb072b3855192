"""The interactive plots of a page, as Plotly figures.

Colours are CSS variables of the page; its script fills them in for the light or dark theme. In the plots of a pair, the
trajectories are static and frames move the marks along them: the layout's `meta` lists the indices of the moving
`traces`, and `frames` holds their points at each step shown. (Plotly's own frames are traces, which are slow to build.)
A trace whose `meta` names a landscape is visible while that landscape is selected.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.interpolate import RegularGridInterpolator

from lp_framework.analysis.landscapes import Landscape
from lp_framework.analysis.pairs import ShownPair
from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS
from lp_framework.geometry import camera_to_world
from lp_framework.viz.cameras import ROUND, SPOKES, image_plane
from lp_framework.viz.curves import LOSSES, Curve, cumulative, running_mean
from lp_framework.viz.maps import RELIEF, broken_at_seam, closed

INK, MUTED, LINE, SURFACE, HALO, TRUTH, ANSWER, OTHERS, REFERENCE, GREY = (
    f"var(--{name})"
    for name in ("ink", "muted", "line", "surface", "halo", "truth", "answer", "others", "reference", "unlabelled")
)  # fmt: skip
WHITE, DARK = "#ffffff", "#3A3A3A"  # over a landscape, which is the same in both themes
FONT = {"family": "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", "size": 12, "color": INK}
AXIS = {"gridcolor": LINE, "linecolor": LINE, "zerolinecolor": LINE, "title": {"font": {"color": MUTED}}}
LAYOUT = {
    "paper_bgcolor": "rgba(0,0,0,0)", "plot_bgcolor": "rgba(0,0,0,0)", "hovermode": "closest",
    "margin": {"l": 54, "r": 16, "t": 10, "b": 44}, "xaxis": AXIS, "yaxis": AXIS,
    "scene": {"xaxis": AXIS, "yaxis": AXIS, "zaxis": AXIS, "aspectmode": "manual", "dragmode": "turntable"},
    "legend": {"orientation": "h", "x": 0, "y": 1.01, "yanchor": "bottom"},  # above the curves, so as not to hide them
    "hoverlabel": {"bgcolor": SURFACE, "bordercolor": LINE, "font": {"color": INK}},
    "uirevision": "kept",  # keep zoom and viewpoint when colours change
}  # fmt: skip
PLACE = "longitude %{x:.1f}°, latitude %{y:.1f}°"
FRAMES = 40  # per pair, at most
PIXELS = 32  # per side of an image in 3-D
GLOBE = 0.42  # radius in object sizes
OUTLINE = [0, 1, 2, 3, 0, 4, 1, 2, 4, 3]  # all edges of a frustum in one line

Points = Callable[[NDArray], NDArray]  # from poses [S, 3] to points [T, 2] of the map, or [T, 3] in 3-D
# A trace moved by the frames: its index, trajectories [_, S, 3], and the function that places them.
Moving = tuple[int, NDArray, Points]


def errors_plot(errors: Mapping[str, NDArray]) -> go.Figure:
    """Plot the share of pairs within a rotation error, from the errors `[P]` of each class (degrees, NaN if none)."""
    ticks = [0, *ROTATION_THRESHOLDS, 60, 90, 120, 180]
    across = {"tickvals": [math.sqrt(each) for each in ticks], "ticktext": [f"{each}°" for each in ticks]}
    figure = _figure(
        xaxis={"title": {"text": "rotation error (square-root scale)"}, "range": [0, math.sqrt(180)], **across},
        yaxis={"title": {"text": "share of pairs within the error"}, "range": [0, 1.01], "tickformat": ".0%"},
        showlegend=True,
    )
    for threshold in ROTATION_THRESHOLDS:
        figure.add_vline(math.sqrt(threshold), line={"color": MUTED, "width": 1, "dash": "dot"})
    for name, values in errors.items():
        error, share = cumulative(values, 180.0)
        figure.add_scatter(
            x=_numbers(np.sqrt(error)), y=_numbers(share), customdata=_numbers(error),
            name=f"{name} ({len(values)} pairs)", mode="lines",
            line={"color": f"var(--{name})", "width": 2.5, "shape": "hv"},
            hovertemplate="%{y:.1%} of pairs within %{customdata:.1f}°<extra>%{fullData.name}</extra>",
        )  # fmt: skip
    return figure


def losses_plot(losses: Mapping[str, Curve], rate: Curve | None) -> go.Figure:
    """Plot losses by their logged names (long ones pale behind a running mean) and the learning rate over steps."""
    loss = {"type": "log", "domain": [0 if rate is None else 0.32, 1], "dtick": "D2", "tickformat": "~g"}
    below = {"domain": [0, 0.22], "rangemode": "tozero", "nticks": 3, "exponentformat": "e"}
    figure = _figure(
        xaxis={"title": {"text": "training step"}, "anchor": "y" if rate is None else "y2"},
        yaxis={"title": {"text": "loss (log scale)"}, **loss},
        yaxis2={"title": {"text": "rate"}, **below},
        showlegend=True,
    )
    for (name, curve), colour in zip(losses.items(), (REFERENCE, ANSWER, GREY), strict=False):
        line = {"color": colour, "width": 2}
        if (window := len(curve.step) // 20) > 1:
            pale = {"marker": {"color": colour, "size": 3}, "opacity": 0.3, "hoverinfo": "skip", "showlegend": False}
            figure.add_scatter(**_curve(curve), mode="markers", **pale)
            curve = Curve(curve.step, running_mean(curve.value, window))
        mode = "lines" if len(curve.step) > 30 else "lines+markers"
        figure.add_scatter(**_curve(curve), name=LOSSES[name][1], mode=mode, line=line)
    if rate is not None:
        line = {"color": INK, "width": 1.5}
        figure.add_scatter(**_curve(rate), yaxis="y2", name="learning rate", mode="lines", line=line)
    return figure


def cameras_plot(poses: NDArray, images: Sequence[NDArray], field_of_view: float) -> go.Figure:
    """Plot cameras of one field of view (radians) at view poses `[V, 3]` with their images `[S, S, 4]`. The first image
    also represents the object."""
    furthest = float(poses[:, 2].max())
    figure = _space(1.1 * furthest, poses[0, 1])
    figure.add_trace(_image(_frustum(poses[0], poses[0, 2], field_of_view), images[0], 2 * PIXELS))
    colours = [REFERENCE, *[ANSWER] * (len(poses) - 1)]
    for pose, image, colour in zip(poses, images, colours, strict=True):
        frustum = _frustum(pose, furthest * (0.26 if len(poses) > 5 else 0.34), field_of_view)
        _add_camera(figure, frustum, image, colour, 4)
    text = {"text": [str(number) for number in range(len(poses))], "textposition": "top center", "textfont": FONT}
    marker = {"color": colours, "size": 5}
    return figure.add_trace(_trace(_centres(poses), mode="markers+text", marker=marker, hoverinfo="text", **text))


def pair_plots(pair: ShownPair) -> dict[str, go.Figure]:
    """The plots of a pair by kind: the map, the surface if it has landscapes, and the cameras."""
    relief = {"surface": surface_plot(pair)} if pair.landscapes else {}
    return {"map": map_plot(pair), **relief, "cameras": _pair_cameras_plot(pair)}


def frame_steps(pair: ShownPair) -> list[int]:
    """The solver steps shown in the frames of a pair, including the last one."""
    steps: list[int] = np.unique(np.linspace(0, _parts(pair)[1].shape[1] - 1, FRAMES).round().astype(int)).tolist()
    return steps


def map_plot(pair: ShownPair) -> go.Figure:
    """Plot a pair's landscapes as maps (degrees), with the trajectories of all starts."""
    ends = [pose[0] for pose in (pair.truth, _parts(pair)[1][0, -1]) if pose is not None]
    limit = max(60.0, *(abs(math.degrees(each)) + 5 for each in np.nan_to_num(ends)))
    angle = {"ticksuffix": "°", "zeroline": False}
    figure = _figure(
        xaxis={"title": {"text": "relative longitude"}, "range": [0, 360], "dtick": 60, **angle},
        yaxis={"title": {"text": "relative latitude"}, "range": [-limit, limit], "dtick": 30, **angle},
    )
    bar = {"orientation": "h", "thickness": 8, "xpad": 0, "ypad": 6, "y": 1.0, "yanchor": "bottom", "outlinewidth": 0,
           "tickfont": {"size": 10}, "nticks": 6}  # fmt: skip
    for name, landscape in pair.landscapes.items():
        figure.add_contour(
            **_relief(name, landscape), **_of(pair, name), ncontours=14, contours={"coloring": "heatmap"},
            line={"color": "rgba(255,255,255,0.35)", "width": 0.7},
            colorbar={**bar, "title": {"text": name, "side": "top", "font": {"size": 11}}},
        )  # fmt: skip
    others, halo = (DARK, WHITE) if pair.landscapes else (OTHERS, HALO)
    if pair.starts is not None:
        _add_marks(figure, _on_map(pair.starts), "start", WHITE, 8, line={"color": DARK, "width": 1.6})
    _add_trails(figure, pair, _along_map, (halo, halo), (3.2, 5))
    _add_trails(figure, pair, _along_map, (others, ANSWER), (1.4, 2.8))
    if pair.truth is not None:
        edge = {"color": "#222222", "width": 1.2}
        _add_marks(figure, _on_map(pair.truth[None]), "true pose", TRUTH, 19, symbol="star", line=edge)
    edge = {"color": WHITE, "width": 1.2}
    return _framed(figure, pair, _add_moving(figure, pair, _on_map, others, (8, 12), line=edge))


def surface_plot(pair: ShownPair) -> go.Figure:
    """Plot a pair's landscapes as surfaces, with the trajectories of all starts; a pole marks the truth."""
    angle = {"ticksuffix": "°", "showspikes": False}
    axes = {
        "xaxis": {"title": {"text": "longitude"}, "range": [0, 360], "dtick": 90, **angle},
        "yaxis": {"title": {"text": "latitude"}, "dtick": 30, **angle},
        "zaxis": {"title": {"text": ""}, "nticks": 4, "showspikes": False},
    }
    figure = _scene((1.7, 1, 0.65), (-0.5, -1.65, 2.1), -0.15, **axes)
    moving: list[Moving] = []
    for name, landscape in pair.landscapes.items():
        only = _of(pair, name)
        light = {"ambient": 0.75, "diffuse": 0.5, "specular": 0.05}
        figure.add_surface(**_relief(name, landscape), **only, showscale=False, lighting=light)
        place, along = _raised(landscape, _on_map), _raised(landscape, _along_map)
        if pair.truth is not None:
            pole = np.repeat(place(pair.truth[None]), 2, axis=0)
            pole[1, 2] = np.nanmax(landscape.energy)
            figure.add_trace(_line(pole, TRUTH, 5, **only))
            _add_marks(figure, pole[1:], "true pose", TRUTH, 8, symbol="diamond", **only)
        _add_trails(figure, pair, along, (WHITE, ANSWER), (3, 8), **only)
        moving += _add_moving(figure, pair, place, DARK, (5, 7), line={"color": WHITE, "width": 1}, **only)
    return _framed(figure, pair, moving)


def add_trajectory(
    figure: go.Figure, path: NDArray, name: str, colour: str, landscape: Landscape | None = None
) -> None:
    """Add a trajectory `[S, 3]`, with a mark at its end, to a map or to the surface of a landscape."""
    along, on_map = (
        (_along_map, _on_map) if landscape is None else (_raised(landscape, f) for f in (_along_map, _on_map))
    )
    figure.add_trace(_line(along(path), colour, 3 if landscape is None else 7))
    _add_marks(figure, on_map(path[-1:]), name, colour, 12 if landscape is None else 7, symbol="diamond")


def add_targets(figure: go.Figure, landscape: Landscape) -> None:
    """Add an invisible 2-degree grid to a map; its points report clicks."""
    latitude, longitude, energy = closed(landscape)
    fine = np.arange(latitude[0], latitude[-1] + 1e-6, 2.0), np.arange(0.0, 360.0, 2.0)
    values = RegularGridInterpolator((latitude, longitude), energy)(
        np.stack(np.meshgrid(*fine, indexing="ij"), axis=-1)
    )
    figure.add_heatmap(
        x=_numbers(fine[1]), y=_numbers(fine[0]), z=_numbers(values), opacity=0, showscale=False,
        hovertemplate=f"{PLACE}: %{{z:.4g}}<extra></extra>",
    )  # fmt: skip


def _pair_cameras_plot(pair: ShownPair) -> go.Figure:
    """Plot the cameras of a pair with their images around a globe showing the landscapes, and the trajectories."""
    reference = pair.reference.pose
    distance = 0.32 * reference[2]
    query = None if pair.truth is None else reference + pair.truth
    figure = _space(1.1 * max(reference[2], 0.0 if query is None else query[2]), reference[1])
    look: dict[str, Any] = {"lighting": {"ambient": 0.9, "diffuse": 0.3, "specular": 0}, "hoverinfo": "skip"}
    if pair.landscapes:  # the plain core covers the poles
        core = np.linspace(-math.pi / 2, math.pi / 2, 13), np.linspace(0, 2 * math.pi, 31)
        figure.add_mesh3d(**_ball(*core, GLOBE - 0.02), color=LINE, **look)
    for name, landscape in pair.landscapes.items():
        latitude, longitude, energy = closed(landscape)
        ball = _ball(np.radians(latitude) + reference[0], np.radians(longitude) + reference[1], GLOBE)
        shade = {"intensity": _objects(_numbers(energy.ravel())), "colorscale": RELIEF, "showscale": False}
        figure.add_mesh3d(**ball, **shade, **_of(pair, name), **look)
    angles = pair.reference.field_of_view, pair.query.field_of_view
    _add_camera(figure, _frustum(reference, distance, angles[0]), pair.reference.image, REFERENCE, 5)
    if query is not None:
        _add_camera(figure, _frustum(query, distance, angles[1]), pair.query.image, TRUTH, 5)

    def centres(poses: NDArray) -> NDArray:
        return _centres(reference + poses)

    def outline(poses: NDArray) -> NDArray:
        return _frustum(reference + poses[0], distance, angles[1])[OUTLINE]

    _, answer = _parts(pair)
    _add_trails(figure, pair, centres, (OTHERS, ANSWER), (2, 5))
    moving = _add_moving(figure, pair, centres, OTHERS, (4, 6))
    figure.add_trace(_line(outline(answer[:, -1]), ANSWER, 5))
    return _framed(figure, pair, [*moving, (len(figure.data) - 1, answer, outline)])


def _parts(pair: ShownPair) -> tuple[NDArray, NDArray]:
    """Trajectories `[_, S, 3]` of the other starts, and of the answer; just the ends if the solver keeps none."""
    paths = pair.ends[:, None] if pair.trajectories is None else pair.trajectories
    if not len(paths):  # no start reached a pose
        paths = np.full((1, 1, 3), np.nan)
    chosen = pair.chosen or 0  # saved pairs have one
    return np.delete(paths, chosen, axis=0), paths[[chosen]]


def _of(pair: ShownPair, landscape: str) -> dict[str, Any]:
    return {"meta": landscape, "visible": landscape == next(iter(pair.landscapes))}


def _relief(name: str, landscape: Landscape) -> dict[str, Any]:
    latitude, longitude, energy = closed(landscape)
    hover = f"{PLACE}: %{{z:.4g}}<extra>{name}</extra>"
    values = {"x": _numbers(longitude), "y": _numbers(latitude), "z": _numbers(energy)}
    return {**values, "colorscale": RELIEF, "hovertemplate": hover}


def _add_trails(
    figure: go.Figure, pair: ShownPair, along: Points, colours: Sequence[str], widths: Sequence[float], **more: Any
) -> None:
    for paths, colour, width in zip(_parts(pair), colours, widths, strict=True):
        known = [path[np.isfinite(path).all(axis=-1)] for path in paths]
        points = [np.pad(along(path), ((0, 1), (0, 0)), constant_values=np.nan) for path in known if len(path)]
        if points:
            figure.add_trace(_line(np.concatenate(points), colour, width, **more))


def _add_moving(
    figure: go.Figure, pair: ShownPair, place: Points, others: str, sizes: Sequence[float], **more: Any
) -> list[Moving]:
    moving: list[Moving] = []
    kinds = (("another start", others, "circle"), ("answer", ANSWER, "diamond"))
    for paths, (name, colour, symbol), size in zip(_parts(pair), kinds, sizes, strict=True):
        moving.append((len(figure.data), paths, place))
        _add_marks(figure, place(paths[:, -1]), name, colour, size, symbol=symbol, **more)
    return moving


def _framed(figure: go.Figure, pair: ShownPair, moving: Sequence[Moving]) -> go.Figure:
    frames = [[_xyz(place(paths[:, step])) for _, paths, place in moving] for step in frame_steps(pair)]
    return figure.update_layout(meta={"traces": [trace for trace, *_ in moving], "frames": frames})


def _on_map(poses: NDArray) -> NDArray:
    """Map relative poses `[S, 3]` to longitude and latitude `[S, 2]`, degrees."""
    return np.stack([np.degrees(poses[:, 1]) % 360, np.degrees(poses[:, 0])], axis=-1)


def _along_map(path: NDArray) -> NDArray:
    """A path `[S, 3]` on the map, with a gap (NaN) at each crossing of the seam."""
    latitude, longitude = broken_at_seam(np.degrees(path[:, 0]), np.degrees(path[:, 1]))
    return np.stack([longitude, latitude], axis=-1)


def _raised(landscape: Landscape, place: Points) -> Points:
    """Extend `place` by the landscape's height, slightly raised."""
    latitude, longitude, energy = closed(landscape)
    height = RegularGridInterpolator((latitude, longitude), energy, bounds_error=False)
    lift = 0.03 * (np.nanmax(energy) - np.nanmin(energy) or 1.0)

    def raised(poses: NDArray) -> NDArray:
        points = place(poses)
        inside = np.stack([points[:, 1].clip(latitude[0], latitude[-1]), points[:, 0]], axis=-1)
        return np.column_stack([points, height(inside) + lift])

    return raised


def _space(radius: float, longitude: float) -> go.Figure:
    """The ground with its longitudes, for cameras up to `radius` away, seen from above a longitude."""
    x, y, _ = 1.9 * _standing(np.array([math.sin(longitude + 0.6), 0.0, math.cos(longitude + 0.6)]))
    sides = {"xaxis": 1.3, "yaxis": 1.3, "zaxis": 1.1}
    axes = {name: {"visible": False, "range": [-most * radius, most * radius]} for name, most in sides.items()}
    figure = _scene((2, 2, 1.7), (x, y, 1), -0.05, **axes)
    spokes, gap = _standing(radius * SPOKES), np.full(3, np.nan)
    parts = [point for spoke in spokes for point in (0.35 * spoke, spoke, gap)]
    figure.add_trace(_line(np.stack([*_standing(radius * ROUND), gap, *parts]), LINE, 2))
    text = {"text": ["0°", "90°", "180°", "270°"], "textfont": {"color": MUTED, "size": 11}}
    return figure.add_trace(_trace(1.12 * spokes[::3], mode="text", hoverinfo="skip", **text))


def _standing(points: NDArray) -> NDArray:
    """Convert points `[..., 3]` to Plotly's axes, where +Z is up instead of +Y."""
    return points[..., [0, 2, 1]] * [1, -1, 1]


def _centres(poses: NDArray) -> NDArray:
    return _standing(camera_to_world(torch.from_numpy(poses))[:, :3, 3].numpy())


def _frustum(pose: NDArray, distance: float, field_of_view: float) -> NDArray:
    """Corners of a camera's view at a distance, ordered as in `image_plane`, and its centre: `[5, 3]`."""
    camera = camera_to_world(torch.from_numpy(pose)).numpy()
    plane = image_plane(camera, distance, field_of_view / 2)
    return _standing(np.vstack([plane, camera[:3, 3]]))


def _add_camera(figure: go.Figure, frustum: NDArray, image: NDArray, colour: str, width: float) -> None:
    figure.add_traces([_image(frustum, image), _line(frustum[OUTLINE], colour, width)])


def _image(frustum: NDArray, image: NDArray, side: int = PIXELS) -> go.Mesh3d:
    """An image `[S, S, 3 or 4]` without its white background, on the image plane of a camera."""
    pixels = np.asarray(Image.fromarray(image).convert("RGBA").resize((side, side))).reshape(-1, 4)
    shown = (pixels[:, 3] >= 128) & (pixels[:, :3].min(axis=1) <= 246)
    lower_left, lower_right, _, upper_left, _ = frustum
    share = np.linspace(0, 1, side + 1)[:, None]
    points = upper_left + share[:, None] * (lower_left - upper_left) + share * (lower_right - lower_left)
    colours = [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue, _ in pixels[shown]]
    light = {"ambient": 1, "diffuse": 0, "specular": 0, "fresnel": 0}
    return go.Mesh3d(**_mesh(points, shown), facecolor=_objects(colours * 2), hoverinfo="skip", lighting=light)


def _ball(latitude: NDArray, longitude: NDArray, radius: float) -> dict[str, Any]:
    """The mesh of a part of a sphere, over latitudes `[A]` and longitudes `[O]`; draws faster than a surface."""
    up, east = np.meshgrid(latitude.clip(-math.pi / 2, math.pi / 2), longitude, indexing="ij")
    points = _centres(np.stack([up, east, np.full_like(up, radius)], axis=-1).reshape(-1, 3))
    return _mesh(points.reshape(*up.shape, 3), np.ones((len(latitude) - 1) * (len(longitude) - 1), dtype=bool))


def _mesh(points: NDArray, shown: NDArray) -> dict[str, Any]:
    """Two triangles for each `shown` cell `[R * C]` of a grid of points `[R + 1, C + 1, 3]`."""
    rows, columns = points.shape[0] - 1, points.shape[1] - 1
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()[shown]
    below = corner + columns + 1
    corners = {"i": (corner, corner + 1), "j": (below, below), "k": (corner + 1, below + 1)}
    values = {**_xyz(points.reshape(-1, 3)), **{name: np.concatenate(both).tolist() for name, both in corners.items()}}
    return {name: _objects(each) for name, each in values.items()}


def _objects(values: list[Any]) -> NDArray[np.object_]:
    """As an array, which Plotly takes as a whole; lists it checks value by value, and arrays of numbers it packs."""
    return np.array(values, dtype=object)


def _figure(**layout: Any) -> go.Figure:
    return go.Figure(layout={"template": {"layout": LAYOUT}, "showlegend": False, "font": FONT, **layout})


def _scene(aspect: Sequence[float], eye: Sequence[float], below: float, **axes: Any) -> go.Figure:
    """A 3-D figure with axis lengths `aspect` and a camera that looks `below` the middle."""
    camera = {"eye": dict(zip("xyz", eye, strict=True)), "center": {"x": 0, "y": 0, "z": below}}
    scene = {**axes, "aspectratio": dict(zip("xyz", aspect, strict=True)), "camera": camera}
    return _figure(margin=dict.fromkeys("lrtb", 0), scene=scene)


def _line(points: NDArray, colour: str, width: float, **more: Any) -> go.Scatter | go.Scatter3d:
    return _trace(points, mode="lines", line={"color": colour, "width": width}, hoverinfo="skip", **more)


def _add_marks(
    figure: go.Figure, points: NDArray, name: str, colour: str, size: float, symbol: str = "circle",
    line: Mapping[str, Any] | None = None, **more: Any,
) -> None:  # fmt: skip
    on_map = {"hovertemplate": f"{PLACE}<extra>{name}</extra>", "cliponaxis": False}
    more |= on_map if points.shape[1] == 2 else {"hoverinfo": "skip"}
    marker = {"color": colour, "size": size, "symbol": symbol, "line": line}
    figure.add_trace(_trace(points, mode="markers", marker=marker, **more))


def _trace(points: NDArray, **more: Any) -> go.Scatter | go.Scatter3d:
    """A trace of points `[T, 2]` on the map, or `[T, 3]` in 3-D."""
    return (go.Scatter if points.shape[1] == 2 else go.Scatter3d)(**_xyz(points), **more)


def _xyz(points: NDArray) -> dict[str, list[float]]:
    return {name: _numbers(values) for name, values in zip("xyz", points.T, strict=False)}


def _curve(curve: Curve) -> dict[str, list[float]]:
    return {"x": curve.step.tolist(), "y": curve.value.tolist()}


def _numbers(values: NDArray) -> Any:
    """Lists, rounded to five digits of the largest value."""
    largest = np.abs(np.nan_to_num(values, posinf=0, neginf=0)).max(initial=0)
    return np.round(values, 4 - math.floor(math.log10(largest or 1))).tolist()
