"""The cameras of some photographs around their object, with the photographs in place."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from lp_framework.geometry import camera_to_world
from lp_framework.viz.style import BLUE, FAINT, MUTED, VERMILION, place_axes, show_image, styled

ELEVATION, OFFSETS = 28.0, range(-60, 61, 5)  # degrees; from where we look, the second relative to the reference
MOST_CARDS, COLUMNS = 12, 6
NEAR_BY = 0.34  # how far from a camera its image is drawn, as a share of the largest radius
OBJECT_CHARGE = 4.0  # how much the object keeps cameras off in the picture
LARGEST = 128  # pixels a side of an image in the scene, but for the one in the middle

# Inches: the figure's width and margin, the title, the tallest scene, the text below an image, gaps between images.
WIDTH, SIDE, TOP, TALLEST, TEXT, GAP = 8.0, 0.1, 0.3, 4.6, 0.66, 0.12


class Viewpoint:
    """A parallel projection of the scene, from far away at a latitude and longitude (radians)."""

    def __init__(self, latitude: float, longitude: float) -> None:
        pose = torch.tensor([latitude, longitude, 1.0], dtype=torch.float64)
        self.axes = camera_to_world(pose)[:3, :3].numpy()  # columns: right, up, towards us

    def project(self, points: NDArray) -> NDArray:
        """Where points `[..., 3]` appear, `[..., 2]` (right, up; scene units)."""
        return points @ self.axes[:, :2]

    def nearness(self, points: NDArray) -> NDArray:
        """How near points `[..., 3]` are to us, `[...]`."""
        return points @ self.axes[:, 2]


def best_viewpoint(poses: NDArray) -> Viewpoint:
    """The viewpoint near the first of the view poses `[V, 3]` from which the cameras appear furthest apart.

    That is where charges, one at each camera, one where its image is drawn, and a larger one at the object, would have
    least energy.
    """
    centres = camera_to_world(torch.from_numpy(poses))[:, :3, 3].numpy()
    points = np.concatenate([np.zeros((1, 3)), centres, centres * (1 - NEAR_BY)])
    charges = np.array([OBJECT_CHARGE] + [1.0] * (len(points) - 1))

    def energy(viewpoint: Viewpoint) -> float:
        seen = viewpoint.project(points)
        squares = np.square(seen[:, None] - seen).sum(axis=-1) + 1e-6
        np.fill_diagonal(squares, np.inf)
        return round(float((charges[:, None] * charges / squares).sum()), 6)

    elevation = math.radians(ELEVATION)
    viewpoints = [Viewpoint(elevation, poses[0, 1] + math.radians(offset)) for offset in OFFSETS]
    return min(viewpoints, key=energy)


def image_plane(camera: NDArray, distance: float, half_angle: float) -> NDArray:
    """Corners `[4, 3]` of what a camera `[4, 4]` sees at a distance: lower left, lower right, upper right, upper left.

    `half_angle` is half of its field of view (radians).
    """
    side = distance * math.tan(half_angle)
    corners = np.array(
        [[-side, -side, -distance], [side, -side, -distance], [side, side, -distance], [-side, side, -distance]]
    )
    return corners @ camera[:3, :3].T + camera[:3, 3]


@styled
def cameras_figure(
    poses: NDArray,
    images: Sequence[NDArray],
    numbers: Sequence[int],
    titles: Sequence[str],
    field_of_view_degrees: float,
) -> Figure:
    """Cameras at view poses `[V, 3]` around the object, each with an image `[S, S, 4]` (RGBA, uint8), number and title.

    The first is the reference; its image also stands for the object, as a cut-out in the middle. Below the scene are
    the images (the first `MOST_CARDS`) with their poses.
    """
    cameras = camera_to_world(torch.from_numpy(poses)).numpy()
    half_angle = math.radians(field_of_view_degrees) / 2
    furthest = float(poses[:, 2].max())
    view = best_viewpoint(poses)
    middle = image_plane(cameras[0], float(poses[0, 2]), half_angle)  # through the object's centre
    distance = furthest * (NEAR_BY if len(poses) <= 5 else 0.8 * NEAR_BY)
    planes = [image_plane(camera, distance, half_angle) for camera in cameras]

    seen = view.project(np.concatenate([middle, *planes, cameras[:, :3, 3], ring(1.14 * furthest)]))
    low, high = seen.min(axis=0) - 0.06 * furthest, seen.max(axis=0) + 0.06 * furthest
    tall = min(TALLEST, WIDTH * (high[1] - low[1]) / (high[0] - low[0]))
    cards = min(len(images), MOST_CARDS)
    side = (WIDTH - 2 * SIDE - GAP * (COLUMNS - 1)) / COLUMNS
    rows = math.ceil(cards / COLUMNS)
    columns = math.ceil(cards / rows)
    height = TOP + tall + rows * (side + TEXT)

    figure = Figure(figsize=(WIDTH, height))
    figure.text(SIDE / WIDTH, 1 - 0.1 / height, "Cameras around the object", fontsize=10, fontweight="bold", va="top")
    note = f"{numbers[0]} is the reference" + (
        f"; below, {cards} of {len(images)} images" if len(images) > cards else ""
    )
    figure.text(1 - SIDE / WIDTH, 1 - 0.12 / height, note, color=MUTED, fontsize=7.5, va="top", ha="right")
    scene = figure.add_axes((0.0, 1 - (TOP + tall) / height, 1.0, tall / height))
    draw_ground(scene, view, furthest)
    _label_ground(scene, view, furthest)
    draw_image(scene, images[0], view.project(middle), order=100.0)
    for index, (camera, plane) in enumerate(zip(cameras, planes, strict=True)):
        centre = camera[:3, 3]
        order = 100.0 + 10 * float(view.nearness(centre)) / furthest
        _draw_camera(scene, view, centre, plane, shrunk(images[index]), order, _colour(index))
        _write_number(scene, view.project(centre), numbers[index], 200.0, _colour(index))
    scene.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    scene.axis("off")

    for index in range(cards):
        row, column = divmod(index, columns)
        left = (WIDTH - columns * (side + GAP) + GAP) / 2 + column * (side + GAP)
        lower = height - TOP - tall - side - row * (side + TEXT)
        axes = place_axes(figure, left, lower, side, side)
        show_image(axes, _on_white(images[index]), "")
        axes.spines[:].set(color=_colour(index), linewidth=1.0)
        below = place_axes(figure, left, lower - TEXT, side, TEXT)
        below.set(xlim=(0, side), ylim=(TEXT, 0))  # one data unit is an inch
        below.axis("off")
        _write_number(below, np.array([0.08, 0.1]), numbers[index], 3.0, _colour(index))
        _write_card(below, side, titles[index], poses[index])
    return figure


def _colour(index: int) -> str:
    return BLUE if index == 0 else VERMILION


def _on_white(image: NDArray) -> NDArray:
    alpha = image[..., 3:] / 255
    return np.rint(image[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)


def ring(radius: float) -> NDArray:
    """A circle `[181, 3]` around the object, at latitude 0."""
    turn = np.linspace(0, 2 * math.pi, 181)
    return radius * np.stack([np.sin(turn), np.zeros_like(turn), np.cos(turn)], axis=-1)


def draw_ground(axes: Axes, view: Viewpoint, radius: float) -> None:
    """The plane of latitude 0, with a line every 30 degrees of longitude."""
    axes.add_patch(Polygon(view.project(ring(radius)), facecolor="#F6F6F4", edgecolor=FAINT, linewidth=0.8, zorder=1))
    axes.add_patch(Polygon(view.project(ring(radius / 2)), fill=False, edgecolor=FAINT, linewidth=0.5, zorder=1.1))
    spokes = []
    for degrees in range(0, 360, 30):
        angle = math.radians(degrees)
        direction = np.array([math.sin(angle), 0.0, math.cos(angle)])
        spokes.append(view.project(np.stack([0 * direction, radius * direction])))
    axes.add_collection(LineCollection(spokes, colors=FAINT, linewidths=0.4, zorder=1.1))


def _label_ground(axes: Axes, view: Viewpoint, radius: float) -> None:
    for degrees in range(0, 360, 90):
        angle = math.radians(degrees)
        x, y = view.project(1.09 * radius * np.array([math.sin(angle), 0.0, math.cos(angle)]))
        axes.text(x, y, f"{degrees}°", color=MUTED, fontsize=7, ha="center", va="center", zorder=2)


def _draw_camera(
    axes: Axes, view: Viewpoint, centre: NDArray, plane: NDArray, image: NDArray, order: float, colour: str
) -> None:
    """A pyramid from the camera's centre to its image, its line of sight, and its height above the ground."""
    foot = centre * [1, 0, 1]
    apex, corners = view.project(centre), view.project(plane)
    height, sight = (np.stack([apex, view.project(end)], axis=1) for end in (foot, 0 * centre))
    axes.plot(*height, color=MUTED, linewidth=0.7, marker="o", markersize=2, markevery=[1], zorder=3)
    axes.plot(*sight, color=colour, linewidth=0.7, linestyle=(0, (2, 3)), zorder=3)
    axes.add_patch(Polygon(corners, facecolor="white", edgecolor="none", alpha=0.65, zorder=order))
    draw_image(axes, image, corners, order + 0.1)
    axes.add_patch(Polygon(corners, fill=False, edgecolor=colour, linewidth=1.0, joinstyle="round", zorder=order + 0.2))
    edges = [np.stack([apex, corner]) for corner in corners]
    axes.add_collection(LineCollection(edges, colors=colour, linewidths=0.7, zorder=order + 0.2))


def draw_image(axes: Axes, image: NDArray, corners: NDArray, order: float) -> None:
    """An image in a parallelogram `[4, 2]` (as `image_plane`); nothing where that is seen edge-on."""
    right, up = corners[1] - corners[0], corners[3] - corners[0]
    if abs(right[0] * up[1] - right[1] * up[0]) < 1e-3 * (right @ right + up @ up):
        return
    placed = Affine2D.from_values(*right, *up, *corners[0])
    axes.imshow(image, extent=(0, 1, 0, 1), transform=placed + axes.transData, interpolation="bilinear", zorder=order)


def shrunk(image: NDArray) -> NDArray:
    """The image `[S, S, 4]` with about `LARGEST` pixels a side, or as it is; colours are weighted by opacity."""
    step = max(1, len(image) // LARGEST)
    size = len(image) // step
    cells = image[: size * step, : size * step].astype(float).reshape(size, step, size, step, 4)
    alpha = cells[..., 3:]
    opacity = alpha.sum(axis=(1, 3))
    colours = (cells[..., :3] * alpha).sum(axis=(1, 3)) / np.maximum(opacity, 1)
    return np.rint(np.concatenate([colours, opacity / step**2], axis=-1)).astype(np.uint8)


def _write_number(axes: Axes, place: NDArray, number: int, order: float, colour: str) -> None:
    axes.annotate(
        str(number), tuple(place), color="white", fontsize=6.5, fontweight="bold", ha="center", va="center",
        zorder=order, annotation_clip=False,
        bbox={"boxstyle": "circle,pad=0.25", "facecolor": colour, "edgecolor": "white", "linewidth": 0.8},
    )  # fmt: skip


def _write_card(axes: Axes, side: float, title: str, pose: NDArray) -> None:
    """Name and pose below an image of `side` inches."""
    room = int(14 * side) - 3  # about as many letters fit
    title = title if len(title) <= room else title[: room - 1] + "…"
    axes.text(0.2, 0.1, title, fontsize=7.5, fontweight="bold", va="center_baseline")
    latitude, longitude = (round(math.degrees(angle), 1) + 0.0 for angle in pose[:2])  # + 0.0: no minus zero
    lines = (f"latitude {latitude:.1f}°", f"longitude {longitude:.1f}°", f"radius {pose[2]:.2f}")
    for line, text in enumerate(lines):
        axes.text(0, 0.25 + 0.125 * line, text.replace("-", "\N{MINUS SIGN}"), fontsize=7, va="center_baseline")
