"""Methods beside each other, by the cameras that they find: the true ones bold, the predicted ones thin."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from lp_framework.geometry import camera_to_world
from lp_framework.viz.cameras import Viewpoint, best_viewpoint, draw_ground, draw_image, image_plane, ring, shrunk
from lp_framework.viz.style import BLUE, GREEN, INK, MUTED, ORANGE, PURPLE, place_axes, show_image, styled, write

RED, SKY = "#D7191C", "#56B4E9"
TARGETS = (BLUE, ORANGE, GREEN, PURPLE, SKY, MUTED)  # a colour a target view
FRUSTUM = 0.2  # of the largest radius
TRUE, PREDICTED = 2.4, 0.9  # widths of lines, points

# Inches: the figure's width and margin, the column of images, room for titles and for the key, gaps.
WIDTH, SIDE, IMAGES, TOP, KEY, GAP = 7.0, 0.06, 2.0, 0.22, 0.26, 0.08
COLUMNS, BETWEEN = 3, 0.05
SIDE_OF_IMAGE = (IMAGES - BETWEEN * (COLUMNS - 1)) / COLUMNS


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
    """A row an object: its images, the reference framed in red, and a scene a method. `field_of_view` in radians."""
    wide = (WIDTH - 2 * SIDE - IMAGES - GAP * len(methods)) / len(methods)
    views = [best_viewpoint(scene.poses) for scene in scenes]
    boxes = [_box(scene, view) for scene, view in zip(scenes, views, strict=True)]
    heights = [max(wide * (high[1] - low[1]) / (high[0] - low[0]), _images_height(scene)) for scene, (low, high) in
               zip(scenes, boxes, strict=True)]  # fmt: skip
    height = KEY + sum(heights) + (TOP + GAP) * len(scenes)
    figure = Figure(figsize=(WIDTH, height))
    top = height
    for row, (scene, view, (low, high), tall) in enumerate(zip(scenes, views, boxes, heights, strict=True)):
        top -= TOP
        write(figure, SIDE, top, f"(a) {scene.title}" if row == 0 else scene.title)
        _draw_images(figure, scene, top, tall)
        for number, (poses, word) in enumerate(zip(scene.predicted, scene.words, strict=True)):
            x = SIDE + IMAGES + GAP + number * (wide + GAP)
            axes = place_axes(figure, x, top - tall, wide, tall)
            _draw_scene(axes, scene, poses, view, field_of_view)
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
            axes.axis("off")
            if row == 0:
                write(figure, x, top, f"({chr(ord('b') + number)}) {methods[number]}")
            figure.text((x + wide) / WIDTH, (top + 0.05) / height, word, color=MUTED, fontsize=7.5, ha="right")
        top -= tall + GAP
    figure.legend(
        handles=_keys(), loc="lower right", bbox_to_anchor=(1 - SIDE / WIDTH, 0.04 / height), ncols=3,
        columnspacing=1.6, borderaxespad=0.0, borderpad=0.0, handlelength=1.8,
    )  # fmt: skip
    return figure


def _images_height(scene: CameraScene) -> float:
    rows = math.ceil(len(scene.images) / COLUMNS)
    return rows * SIDE_OF_IMAGE + (rows - 1) * BETWEEN


def _draw_images(figure: Figure, scene: CameraScene, top: float, room: float) -> None:
    """The reference and the others, in the middle of a room of so many inches."""
    below = top - (room - _images_height(scene)) / 2
    for index, image in enumerate(scene.images):
        row, column = divmod(index, COLUMNS)
        x = SIDE + column * (SIDE_OF_IMAGE + BETWEEN)
        y = below - (row + 1) * SIDE_OF_IMAGE - row * BETWEEN
        axes = place_axes(figure, x, y, SIDE_OF_IMAGE, SIDE_OF_IMAGE)
        show_image(axes, image, "")
        axes.spines[:].set(color=colour_of(index), linewidth=1.4)


def _draw_scene(axes: Axes, scene: CameraScene, predicted: NDArray, view: Viewpoint, field_of_view: float) -> None:
    furthest = float(scene.poses[:, 2].max())
    draw_ground(axes, view, furthest)
    cameras = camera_to_world(torch.from_numpy(scene.poses)).numpy()
    middle = image_plane(cameras[0], float(scene.poses[0, 2]), field_of_view / 2)
    draw_image(axes, shrunk(scene.cutout), view.project(middle), order=10.0)
    for index, camera in enumerate(cameras):
        kind = "true" if index else "reference"
        _draw_frustum(axes, view, camera, furthest, field_of_view, colour_of(index), kind)
    for index, poses in enumerate(predicted):
        for camera in camera_to_world(torch.from_numpy(poses[np.isfinite(poses).all(axis=-1)])).numpy():
            _draw_frustum(axes, view, camera, furthest, field_of_view, colour_of(index + 1), "predicted")


def _draw_frustum(
    axes: Axes, view: Viewpoint, camera: NDArray, furthest: float, field_of_view: float, colour: str, kind: str
) -> None:
    """The edges of a camera's pyramid; a true one is wide and light, so that a predicted one on it can be seen."""
    corners = view.project(image_plane(camera, FRUSTUM * furthest, field_of_view / 2))
    apex = view.project(camera[:3, 3])
    edges = [np.stack([apex, corner]) for corner in corners] + [np.concatenate([corners, corners[:1]])]
    predicted = kind == "predicted"
    lines = LineCollection(
        edges, colors=colour, linewidths=PREDICTED if predicted else TRUE, alpha=None if predicted else 0.55,
        capstyle="round", joinstyle="round", zorder=30.0 if predicted else 20.0 + float(view.nearness(camera[:3, 3])),
    )  # fmt: skip
    lines.set_gid(kind)
    axes.add_collection(lines)


def colour_of(index: int) -> str:
    """The colour of a view: red for the reference, one of its own for each other."""
    return TARGETS[(index - 1) % len(TARGETS)] if index else RED


def _box(scene: CameraScene, view: Viewpoint) -> tuple[NDArray, NDArray]:
    """Lower left and upper right of what the scenes of an object show."""
    furthest = float(scene.poses[:, 2].max())
    poses = np.concatenate([scene.poses, *(each.reshape(-1, 3) for each in scene.predicted)])
    centres = camera_to_world(torch.from_numpy(poses[np.isfinite(poses).all(axis=-1)]))[:, :3, 3].numpy()
    seen = view.project(np.concatenate([centres, ring(1.12 * furthest)]))
    return seen.min(axis=0) - 0.06 * furthest, seen.max(axis=0) + 0.06 * furthest


def _keys() -> list[Line2D]:
    true: dict[str, Any] = {"linewidth": TRUE, "alpha": 0.55}
    return [
        Line2D([], [], color=RED, label="reference", **true),
        Line2D([], [], color=INK, label="true cameras, a colour a view", **true),
        Line2D([], [], color=INK, linewidth=PREDICTED, label="predicted, one for each start"),
    ]
