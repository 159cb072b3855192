"""Cameras around their object: those of photographs, with the images in place, and predictions of several methods."""

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
from matplotlib.patches import Polygon
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.distance import pdist

from lp_framework.data.photographs import on_white
from lp_framework.geometry import camera_to_world
from lp_framework.viz import style

ELEVATION, OFFSETS = 28.0, range(-60, 61, 5)  # degrees; our own viewpoint, longitudes relative to the reference
NEAR_BY = 0.34  # distance from a camera to its image, as a share of the largest radius
LARGEST = 128  # pixels per side of an image in the scene, except the one in the middle
MOST_CARDS, CARD_COLUMNS = 12, 6
TRUSTED = {"trust": style.GREEN, "doubtful": style.ORANGE, "do not trust": style.VERMILION}  # one colour per verdict

# For the figure of methods.
RED, SKY = "#D7191C", "#56B4E9"
TARGETS = (style.BLUE, style.ORANGE, style.GREEN, style.PURPLE, SKY, style.MUTED)  # one colour per target view
FRUSTUM = 0.2  # of the largest radius
# True cameras are wide and light, so that predicted ones stay visible on top of them.
TRUE: dict[str, Any] = {"linewidth": 2.4, "alpha": 0.55}
PREDICTED: dict[str, Any] = {"linewidth": 0.9}
IMAGE_COLUMNS = 3


def viewpoint(latitude: float, longitude: float) -> NDArray:
    """Axes `[3, 3]` of an orthographic projection from angles in radians: columns point right, up, and towards us."""
    return np.asarray(camera_to_world(torch.tensor([latitude, longitude, 1.0], dtype=torch.float64))[:3, :3])


def best_viewpoint(poses: NDArray) -> NDArray:
    """The viewpoint near the first of the view poses `[V, 3]` that separates the cameras best."""
    # Minimize the energy of charges: one per camera, one where its image is drawn, and four at the object.
    centres = _cameras(poses)[:, :3, 3]
    points = np.concatenate([np.zeros((4, 3)), centres, centres * (1 - NEAR_BY)])
    viewpoints = [viewpoint(math.radians(ELEVATION), poses[0, 1] + math.radians(offset)) for offset in OFFSETS]
    return min(viewpoints, key=lambda axes: np.sum(1 / (pdist(points @ axes[:, :2], "sqeuclidean") + 1e-6)).round(6))


def image_plane(camera: NDArray, distance: float, half_angle: float) -> NDArray:
    """Corners `[4, 3]` of the view of a camera `[4, 4]` at a distance: lower left, lower right, upper right, upper
    left; `half_angle` is half of its field of view (radians).
    """
    side = distance * math.tan(half_angle)
    corners = np.array([[-side, -side], [side, -side], [side, side], [-side, side]])
    return np.c_[corners, np.full(4, -distance)] @ camera[:3, :3].T + camera[:3, 3]


def _cameras(poses: NDArray) -> NDArray:
    """Camera-to-world matrices `[K, 4, 4]` of the finite view poses among `[..., 3]`."""
    return np.asarray(camera_to_world(torch.from_numpy(poses[np.isfinite(poses).all(axis=-1)])))


# Points `[K, 3]` at distance 1 from the object, at latitude 0.
ROUND, SPOKES = (
    np.stack([np.sin(longitude), np.zeros_like(longitude), np.cos(longitude)], axis=-1)
    for longitude in (np.radians(range(0, 361, 2)), np.radians(range(0, 360, 30)))
)


class Scene:
    """The ground (the plane of latitude 0 out to `radius`) and what is on it, seen from a viewpoint."""

    def __init__(self, axes: Axes, view: NDArray, radius: float) -> None:
        self.axes, self.view, self.radius = axes, view, radius
        axes.set(aspect="equal")
        axes.margins(0.08)
        axes.axis("off")
        outer, inner = (self.project(share * self.radius * ROUND) for share in (1, 0.5))
        axes.add_patch(Polygon(outer, facecolor="#F6F6F4", edgecolor=style.FAINT, linewidth=0.8, zorder=1))
        axes.add_patch(Polygon(inner, fill=False, edgecolor=style.FAINT, linewidth=0.5, zorder=1.1))
        spokes = [[(0, 0), end] for end in self.project(self.radius * SPOKES)]
        axes.add_collection(LineCollection(spokes, colors=style.FAINT, linewidths=0.4, zorder=1.1))

    def project(self, points: NDArray) -> NDArray:
        """Project points `[..., 3]` to `[..., 2]` (right, up; scene units)."""
        return points @ self.view[:, :2]

    def nearness(self, points: NDArray) -> NDArray:
        """How close points `[..., 3]` are to us, `[...]`, in units of the radius."""
        return points @ self.view[:, 2] / self.radius

    def image(self, image: Image.Image, plane: NDArray, order: float) -> None:
        """Draw an image in its plane (see `image_plane`); nothing if it is seen edge-on."""
        corners = self.project(plane)
        right, up = corners[1] - corners[0], corners[3] - corners[0]
        if abs(right[0] * up[1] - right[1] * up[0]) < 1e-3 * (right @ right + up @ up):
            return
        placed = Affine2D.from_values(*right, *up, *corners[0]) + self.axes.transData
        self.axes.imshow(image, extent=(0, 1, 0, 1), transform=placed, interpolation="bilinear", zorder=order)

    def frustum(self, centre: NDArray, plane: NDArray, **line: Any) -> None:
        """Draw the edges of a camera's frustum, from its centre to its image plane."""
        apex, corners = self.project(centre), self.project(plane)
        edges = [np.stack([apex, corner]) for corner in corners] + [np.concatenate([corners, corners[:1]])]
        self.axes.add_collection(LineCollection(edges, capstyle="round", joinstyle="round", **line))


def shrunk(image: Image.Image) -> Image.Image:
    """The image with at most `LARGEST` pixels per side; colours are weighted by opacity."""
    small = image.copy()
    small.thumbnail((LARGEST, LARGEST))
    return small


@style.styled
def cameras_figure(
    poses: NDArray, images: Sequence[Image.Image], numbers: Sequence[int], titles: Sequence[str],
    field_of_view_degrees: float, verdicts: Sequence[str] = (),
) -> Figure:  # fmt: skip
    """Draw cameras at view poses `[V, 3]` around the object, each with an image (RGBA), number and title. Below are the
    first `MOST_CARDS` images with their poses and `verdicts` (keys of `TRUSTED`, or empty). The first image is the
    reference and also represents the object.
    """
    verdicts = verdicts or [""] * len(images)
    cameras, half_angle, furthest = _cameras(poses), math.radians(field_of_view_degrees) / 2, float(poses[:, 2].max())
    distance = furthest * (NEAR_BY if len(poses) <= 5 else 0.8 * NEAR_BY)
    colours = [style.BLUE, *(TRUSTED.get(verdict, style.VERMILION) for verdict in verdicts[1:])]
    cards = min(len(images), MOST_CARDS)
    rows = math.ceil(cards / CARD_COLUMNS)
    more = f"; below, {cards} of {len(images)} images" if len(images) > cards else ""
    figure, body = style.page(
        8.0, 5.0 + 1.9 * rows, "Cameras around the object", f"{numbers[0]} is the reference{more}"
    )
    upper, lower = style.stacked(body, 4.5, 1.9 * rows)
    scene = Scene(upper.subplots(), best_viewpoint(poses), furthest)
    for place, (x, y) in enumerate(scene.project(1.09 * furthest * SPOKES[::3])):
        scene.axes.text(x, y, f"{90 * place}°", color=style.MUTED, fontsize=7, ha="center", va="center", zorder=2)
    scene.image(images[0], image_plane(cameras[0], float(poses[0, 2]), half_angle), order=100.0)  # inside the object
    for camera, image, number, colour in zip(cameras, images, numbers, colours, strict=True):
        _draw_camera(scene, camera[:3, 3], image_plane(camera, distance, half_angle), shrunk(image), colour)
        x, y = scene.project(camera[:3, 3])
        scene.axes.text(x, y, str(number), zorder=200.0, **_badge(colour))

    for index, axes in enumerate(style.panels(lower, cards, math.ceil(cards / rows))):
        colour = colours[index]
        style.show_image(axes, on_white(images[index]), style.shortened(titles[index], 14), color=colour)
        axes.text(0.07, 0.93, str(numbers[index]), transform=axes.transAxes, **_badge(colour))
        latitude, longitude = (round(math.degrees(angle), 1) + 0.0 for angle in poses[index, :2])  # + 0.0: no minus 0
        pose = f"latitude {latitude:.1f}°\nlongitude {longitude:.1f}°\nradius {poses[index, 2]:.2f}"
        axes.set_xlabel(pose.replace("-", "\N{MINUS SIGN}"), fontsize=7, loc="left")
        look: dict[str, Any] = {"fontsize": 6, "fontweight": "bold", "color": colour, "ha": "right", "va": "bottom"}
        axes.text(0.98, 0.02, verdicts[index], transform=axes.transAxes, **look)
    return figure


def _draw_camera(scene: Scene, centre: NDArray, plane: NDArray, image: Image.Image, colour: str) -> None:
    order = 100.0 + 10 * float(scene.nearness(centre))
    height, sight = (scene.project(np.stack([centre, end])).T for end in (centre * [1, 0, 1], 0 * centre))
    scene.axes.plot(*height, color=style.MUTED, linewidth=0.7, marker="o", markersize=2, markevery=[1], zorder=3)
    scene.axes.plot(*sight, color=colour, linewidth=0.7, linestyle=(0, (2, 3)), zorder=3)
    corners = scene.project(plane)
    scene.axes.add_patch(Polygon(corners, facecolor="white", edgecolor="none", alpha=0.65, zorder=order))
    scene.image(image, plane, order + 0.1)
    scene.frustum(centre, plane, colors=colour, linewidths=[0.7] * 4 + [1.0], zorder=order + 0.2)


def _badge(colour: str) -> dict[str, Any]:
    disk = {"boxstyle": "circle,pad=0.25", "facecolor": colour, "edgecolor": "white", "linewidth": 0.8}
    return {"color": "white", "fontsize": 6.5, "fontweight": "bold", "ha": "center", "va": "center", "bbox": disk}


class CameraScene(NamedTuple):
    """One object: images (RGBA), view poses `[V, 3]` and fields of view `[V]` (radians), the reference first; per
    method, the view poses `[V - 1, N, 3]` predicted for the others from N starts, and a short summary of their quality.
    """

    title: str
    images: Sequence[Image.Image]
    poses: NDArray
    field_of_view: NDArray
    predicted: Sequence[NDArray]
    words: Sequence[str]


@style.styled
def camera_methods_figure(objects: Sequence[CameraScene], methods: Sequence[str]) -> Figure:
    """One row per object: its images, the reference framed in red, and one scene per method; true cameras are bold."""
    figure = Figure(figsize=(7.0, 0.3 + 1.7 * len(objects)), layout="constrained")
    parts = style.stacked(figure, *[1] * len(objects))
    for row, (each, part) in enumerate(zip(objects, parts, strict=True)):
        left, *panels = style.beside(part, 2.0, *[4.8 / len(methods)] * len(methods))
        left.suptitle(style.letter(0, each.title) if row == 0 else each.title, x=0.02, ha="left", fontsize=8.5)
        places = style.panels(left, len(each.images), IMAGE_COLUMNS)
        for index, (axes, image) in enumerate(zip(places, each.images, strict=True)):
            style.show_image(axes, on_white(image), color=colour_of(index), linewidth=1.4)
        for number, (panel, poses, word) in enumerate(zip(panels, each.predicted, each.words, strict=True)):
            scene = Scene(panel.subplots(), best_viewpoint(each.poses), float(each.poses[:, 2].max()))
            _draw_method(scene, each, poses)
            scene.axes.set_title(style.letter(number + 1, methods[number]) if row == 0 else "")
            scene.axes.set_title(word, loc="right", **style.ASIDE)
    keys = [
        Line2D([], [], color=RED, label="reference", **TRUE),
        Line2D([], [], color=style.INK, label="true cameras, one colour per view", **TRUE),
        Line2D([], [], color=style.INK, label="predicted, one per start", **PREDICTED),
    ]
    figure.legend(handles=keys, loc="outside lower right", ncols=len(keys))
    return figure


def _draw_method(scene: Scene, content: CameraScene, predicted: NDArray) -> None:
    cameras, half_angles = _cameras(content.poses), content.field_of_view / 2
    middle = image_plane(cameras[0], float(content.poses[0, 2]), half_angles[0])
    scene.image(shrunk(content.images[0]), middle, order=10.0)
    drawn = [("true", index, camera, TRUE) for index, camera in enumerate(cameras)]
    drawn += [("predicted", index, camera, PREDICTED) for index, poses in enumerate(predicted, 1)
              for camera in _cameras(poses)]  # fmt: skip
    for kind, index, camera, line in drawn:
        plane = image_plane(camera, FRUSTUM * scene.radius, half_angles[index])
        order = 20.0 + float(scene.nearness(camera[:3, 3])) if kind == "true" else 30.0
        scene.frustum(camera[:3, 3], plane, color=colour_of(index), zorder=order, gid=kind, **line)


def colour_of(index: int) -> str:
    """The colour of a view: red for the reference, a different one for each other view."""
    return TARGETS[(index - 1) % len(TARGETS)] if index else RED
