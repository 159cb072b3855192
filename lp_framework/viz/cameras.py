"""Cameras around their object: those of some photographs, with the images in place, and those that methods predict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from lp_framework.geometry import camera_to_world
from lp_framework.viz.style import (
    ASIDE,
    BLUE,
    FAINT,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PURPLE,
    VERMILION,
    Sheet,
    key,
    letter,
    shortened,
    styled,
)

ELEVATION, OFFSETS = 28.0, range(-60, 61, 5)  # degrees; from where we look, the second relative to the reference
NEAR_BY = 0.34  # how far from a camera its image is drawn, as a share of the largest radius
OBJECT_CHARGE = 4.0  # how much the object keeps cameras off in the picture
LARGEST = 128  # pixels a side of an image in the scene, but for the one in the middle
SIDE = 0.1  # inches: the margin

# ---------------------------------------------------------------- the scene


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
    centres = _cameras(poses)[:, :3, 3]
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


def _cameras(poses: NDArray) -> NDArray:
    """Camera-to-world matrices `[K, 4, 4]` of those view poses `[..., 3]` that are finite."""
    cameras: NDArray = camera_to_world(torch.from_numpy(poses[np.isfinite(poses).all(axis=-1)])).numpy()
    return cameras


def _box(view: Viewpoint, points: NDArray, furthest: float, ground: float) -> tuple[NDArray, NDArray]:
    """Lower left and upper right of what shows points `[K, 3]` and the ground, as wide as `ground` of `furthest`."""
    seen = view.project(np.concatenate([points, _ring(ground * furthest)]))
    return seen.min(axis=0) - 0.06 * furthest, seen.max(axis=0) + 0.06 * furthest


def _ring(radius: float) -> NDArray:
    """A circle `[181, 3]` around the object, at latitude 0."""
    return radius * _directions(np.linspace(0, 2 * math.pi, 181))


def _directions(longitude: NDArray) -> NDArray:
    """Unit vectors `[K, 3]` at latitude 0."""
    return np.stack([np.sin(longitude), np.zeros_like(longitude), np.cos(longitude)], axis=-1)


def _draw_ground(axes: Axes, view: Viewpoint, radius: float) -> None:
    """The plane of latitude 0, with a line every 30 degrees of longitude."""
    axes.add_patch(Polygon(view.project(_ring(radius)), facecolor="#F6F6F4", edgecolor=FAINT, linewidth=0.8, zorder=1))
    axes.add_patch(Polygon(view.project(_ring(radius / 2)), fill=False, edgecolor=FAINT, linewidth=0.5, zorder=1.1))
    ends = view.project(radius * _directions(np.radians(np.arange(0, 360, 30))))
    axes.add_collection(LineCollection([[(0, 0), end] for end in ends], colors=FAINT, linewidths=0.4, zorder=1.1))


def _draw_image(axes: Axes, image: NDArray, corners: NDArray, order: float) -> None:
    """An image in a parallelogram `[4, 2]` (as `image_plane`); nothing where that is seen edge-on."""
    right, up = corners[1] - corners[0], corners[3] - corners[0]
    if abs(right[0] * up[1] - right[1] * up[0]) < 1e-3 * (right @ right + up @ up):
        return
    placed = Affine2D.from_values(*right, *up, *corners[0])
    axes.imshow(image, extent=(0, 1, 0, 1), transform=placed + axes.transData, interpolation="bilinear", zorder=order)


def _draw_frustum(axes: Axes, apex: NDArray, corners: NDArray, **style: Any) -> None:
    """The edges of a camera's pyramid, from its centre `[2]` to the corners `[4, 2]` of its image."""
    edges = [np.stack([apex, corner]) for corner in corners] + [np.concatenate([corners, corners[:1]])]
    axes.add_collection(LineCollection(edges, capstyle="round", joinstyle="round", **style))


def shrunk(image: NDArray) -> NDArray:
    """The image `[S, S, 4]` with about `LARGEST` pixels a side, or as it is; colours are weighted by opacity."""
    step = max(1, len(image) // LARGEST)
    size = len(image) // step
    cells = image[: size * step, : size * step].astype(float).reshape(size, step, size, step, 4)
    alpha = cells[..., 3:]
    opacity = alpha.sum(axis=(1, 3))
    colours = (cells[..., :3] * alpha).sum(axis=(1, 3)) / np.maximum(opacity, 1)
    return np.rint(np.concatenate([colours, opacity / step**2], axis=-1)).astype(np.uint8)


# ---------------------------------------------------------------- the cameras of photographs

MOST_CARDS, CARD_COLUMNS = 12, 6
# Inches: the figure's width, the title, the tallest scene, the text below an image, gaps between images.
WIDTH, TOP, TALLEST, TEXT, GAP = 8.0, 0.3, 4.6, 0.66, 0.12


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
    cameras, view, half_angle = _cameras(poses), best_viewpoint(poses), math.radians(field_of_view_degrees) / 2
    furthest = float(poses[:, 2].max())
    middle = image_plane(cameras[0], float(poses[0, 2]), half_angle)  # through the object's centre
    distance = furthest * (NEAR_BY if len(poses) <= 5 else 0.8 * NEAR_BY)
    planes = [image_plane(camera, distance, half_angle) for camera in cameras]
    low, high = _box(view, np.concatenate([middle, *planes, cameras[:, :3, 3]]), furthest, ground=1.14)
    tall = min(TALLEST, WIDTH * (high[1] - low[1]) / (high[0] - low[0]))
    cards = min(len(images), MOST_CARDS)
    side = (WIDTH - 2 * SIDE - GAP * (CARD_COLUMNS - 1)) / CARD_COLUMNS
    rows = math.ceil(cards / CARD_COLUMNS)
    columns = math.ceil(cards / rows)

    sheet = Sheet(WIDTH, TOP + tall + rows * (side + TEXT))
    sheet.head("Cameras around the object")
    more = f"; below, {cards} of {len(images)} images" if len(images) > cards else ""
    sheet.text(WIDTH - SIDE, 0.12, f"{numbers[0]} is the reference{more}", va="top", ha="right", **ASIDE)
    scene = sheet.axes(0, TOP, WIDTH, tall)
    _draw_ground(scene, view, furthest)
    for degrees, place in zip(range(0, 360, 90), _directions(np.radians(np.arange(0, 360, 90))), strict=True):
        x, y = view.project(1.09 * furthest * place)
        scene.text(x, y, f"{degrees}°", color=MUTED, fontsize=7, ha="center", va="center", zorder=2)
    _draw_image(scene, images[0], view.project(middle), order=100.0)
    for index, (camera, plane) in enumerate(zip(cameras, planes, strict=True)):
        order = 100.0 + 10 * float(view.nearness(camera[:3, 3])) / furthest
        _draw_camera(scene, view, camera[:3, 3], plane, shrunk(images[index]), order, _colour(index))
        _write_number(scene, view.project(camera[:3, 3]), numbers[index], 200.0, _colour(index))
    scene.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    scene.axis("off")

    for index in range(cards):
        row, column = divmod(index, columns)
        x = (WIDTH - columns * (side + GAP) + GAP) / 2 + column * (side + GAP)
        y = TOP + tall + row * (side + TEXT)
        sheet.image(x, y, side, _on_white(images[index]), color=_colour(index), linewidth=1.0)
        below = sheet.axes(x, y + side, side, TEXT)
        below.set(xlim=(0, side), ylim=(TEXT, 0))  # one data unit is an inch
        below.axis("off")
        _write_number(below, np.array([0.08, 0.1]), numbers[index], 3.0, _colour(index))
        _write_card(below, shortened(titles[index], 14 * side - 3), poses[index])
    return sheet.figure


def _colour(index: int) -> str:
    return BLUE if index == 0 else VERMILION


def _on_white(image: NDArray) -> NDArray:
    alpha = image[..., 3:] / 255
    return np.rint(image[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)


def _draw_camera(
    axes: Axes, view: Viewpoint, centre: NDArray, plane: NDArray, image: NDArray, order: float, colour: str
) -> None:
    """A pyramid from the camera's centre to its image, its line of sight, and its height above the ground."""
    apex, corners = view.project(centre), view.project(plane)
    height, sight = (np.stack([apex, view.project(end)], axis=1) for end in (centre * [1, 0, 1], 0 * centre))
    axes.plot(*height, color=MUTED, linewidth=0.7, marker="o", markersize=2, markevery=[1], zorder=3)
    axes.plot(*sight, color=colour, linewidth=0.7, linestyle=(0, (2, 3)), zorder=3)
    axes.add_patch(Polygon(corners, facecolor="white", edgecolor="none", alpha=0.65, zorder=order))
    _draw_image(axes, image, corners, order + 0.1)
    _draw_frustum(axes, apex, corners, colors=colour, linewidths=[0.7] * 4 + [1.0], zorder=order + 0.2)


def _write_number(axes: Axes, place: NDArray, number: int, order: float, colour: str) -> None:
    axes.annotate(
        str(number), tuple(place), color="white", fontsize=6.5, fontweight="bold", ha="center", va="center",
        zorder=order, annotation_clip=False,
        bbox={"boxstyle": "circle,pad=0.25", "facecolor": colour, "edgecolor": "white", "linewidth": 0.8},
    )  # fmt: skip


def _write_card(axes: Axes, title: str, pose: NDArray) -> None:
    """Name and pose below an image."""
    axes.text(0.2, 0.1, title, fontsize=7.5, fontweight="bold", va="center_baseline")
    latitude, longitude = (round(math.degrees(angle), 1) + 0.0 for angle in pose[:2])  # + 0.0: no minus zero
    lines = (f"latitude {latitude:.1f}°", f"longitude {longitude:.1f}°", f"radius {pose[2]:.2f}")
    for line, text in enumerate(lines):
        axes.text(0, 0.25 + 0.125 * line, text.replace("-", "\N{MINUS SIGN}"), fontsize=7, va="center_baseline")


# ---------------------------------------------------------------- the cameras that methods predict

RED, SKY = "#D7191C", "#56B4E9"
TARGETS = (BLUE, ORANGE, GREEN, PURPLE, SKY, MUTED)  # a colour a target view
FRUSTUM = 0.2  # of the largest radius
# True cameras are wide and light, so that a predicted one on them can be seen.
TRUE: dict[str, Any] = {"linewidth": 2.4, "alpha": 0.55}
PREDICTED: dict[str, Any] = {"linewidth": 0.9}
# Inches: the figure's width, the column of images, room for titles and for the key, gaps.
METHODS_WIDTH, IMAGES, TITLE, KEY, BETWEEN = 7.0, 2.0, 0.22, 0.26, 0.05
IMAGE_COLUMNS = 3
IMAGE = (IMAGES - BETWEEN * (IMAGE_COLUMNS - 1)) / IMAGE_COLUMNS


class CameraScene(NamedTuple):
    """One object: images `[V, H, W, 3]` (uint8) and view poses `[V, 3]`, of which the first is the reference's; its
    cut-out `[S, S, 4]` (RGBA, uint8); and of each method the predicted view poses `[V - 1, N, 3]` of the others from N
    starts, with a word on how good they are.
    """

    title: str
    images: NDArray
    poses: NDArray
    cutout: NDArray
    predicted: Sequence[NDArray]
    words: Sequence[str]


@styled
def camera_methods_figure(scenes: Sequence[CameraScene], methods: Sequence[str], field_of_view: float) -> Figure:
    """A row an object: its images, the reference framed in red, and a scene a method. `field_of_view` in radians.

    The true cameras are bold, the predicted ones thin.
    """
    wide = (METHODS_WIDTH - 2 * SIDE - IMAGES - 0.08 * len(methods)) / len(methods)
    rows = []
    for scene in scenes:
        view, lines = best_viewpoint(scene.poses), math.ceil(len(scene.images) / IMAGE_COLUMNS)
        centres = _cameras(np.concatenate([scene.poses, *(each.reshape(-1, 3) for each in scene.predicted)]))[:, :3, 3]
        low, high = _box(view, centres, float(scene.poses[:, 2].max()), ground=1.12)
        images = lines * IMAGE + (lines - 1) * BETWEEN
        rows.append((scene, view, low, high, images, max(wide * (high[1] - low[1]) / (high[0] - low[0]), images)))
    sheet = Sheet(METHODS_WIDTH, KEY + sum(tall + TITLE + 0.08 for *_, tall in rows))
    top = TITLE
    for row, (scene, view, low, high, images, tall) in enumerate(rows):
        sheet.above(SIDE, top, f"(a) {scene.title}" if row == 0 else scene.title)
        for index, image in enumerate(scene.images):
            line, column = divmod(index, IMAGE_COLUMNS)
            x, y = SIDE + column * (IMAGE + BETWEEN), top + (tall - images) / 2 + line * (IMAGE + BETWEEN)
            sheet.image(x, y, IMAGE, image, color=colour_of(index), linewidth=1.4)
        for number, (poses, word) in enumerate(zip(scene.predicted, scene.words, strict=True)):
            x = SIDE + IMAGES + 0.08 + number * (wide + 0.08)
            axes = sheet.axes(x, top, wide, tall)
            _draw_scene(axes, scene, poses, view, field_of_view / 2)
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
            axes.axis("off")
            if row == 0:
                sheet.above(x, top, letter(number + 1, methods[number]))
            sheet.above(x + wide, top, word, ha="right", **ASIDE)
        top += tall + TITLE + 0.08
    keys = [
        key("reference", color=RED, linestyle="-", **TRUE),
        key("true cameras, a colour a view", color=INK, linestyle="-", **TRUE),
        key("predicted, one for each start", color=INK, linestyle="-", **PREDICTED),
    ]
    sheet.legend(keys, METHODS_WIDTH - SIDE, sheet.height - 0.18, columnspacing=1.6, handlelength=1.8)
    return sheet.figure


def _draw_scene(axes: Axes, scene: CameraScene, predicted: NDArray, view: Viewpoint, half_angle: float) -> None:
    furthest, cameras = float(scene.poses[:, 2].max()), _cameras(scene.poses)
    _draw_ground(axes, view, furthest)
    middle = image_plane(cameras[0], float(scene.poses[0, 2]), half_angle)
    _draw_image(axes, shrunk(scene.cutout), view.project(middle), order=10.0)

    def draw(camera: NDArray, kind: str, index: int, order: float, **style: Any) -> None:
        corners = view.project(image_plane(camera, FRUSTUM * furthest, half_angle))
        _draw_frustum(
            axes, view.project(camera[:3, 3]), corners, color=colour_of(index), zorder=order, gid=kind, **style
        )

    for index, camera in enumerate(cameras):
        draw(camera, "true" if index else "reference", index, 20.0 + float(view.nearness(camera[:3, 3])), **TRUE)
    for index, poses in enumerate(predicted):
        for camera in _cameras(poses):
            draw(camera, "predicted", index + 1, 30.0, **PREDICTED)


def colour_of(index: int) -> str:
    """The colour of a view: red for the reference, one of its own for each other."""
    return TARGETS[(index - 1) % len(TARGETS)] if index else RED
