"""The figure of the cameras: positions of what is drawn, as points and arrays."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from matplotlib.image import AxesImage, imread
from numpy.typing import NDArray
from PIL import Image
from view_folders import draw_view, random_poses

from lp_framework.geometry import camera_to_world, view_pose
from lp_framework.viz import cameras
from lp_framework.viz.cameras import (
    ELEVATION,
    LARGEST,
    MOST_CARDS,
    OFFSETS,
    Scene,
    best_viewpoint,
    cameras_figure,
    image_plane,
    shrunk,
    viewpoint,
)
from lp_framework.viz.style import save_figure

HALF = math.radians(49.1) / 2


def figure_of(poses: NDArray) -> Figure:
    images = [Image.fromarray(draw_view(pose, 32)) for pose in poses]
    count = len(poses)
    return cameras_figure(poses, images, range(count), [f"{index}.png" for index in range(count)], 49.1)


def test_the_projection_is_parallel_with_up_upwards():
    view = Scene(Figure().subplots(), viewpoint(0.4, 0.7), 1.0)
    towards = camera_to_world(torch.tensor([0.4, 0.7, 1.0], dtype=torch.float64))[:3, 3].numpy()
    np.testing.assert_allclose(view.project(towards), 0, atol=1e-12)
    assert view.nearness(towards) == pytest.approx(1) and view.nearness(-towards) == pytest.approx(-1)
    x, y = view.project(np.array([0.0, 1.0, 0.0]))
    assert x == pytest.approx(0) and y == pytest.approx(math.cos(0.4))
    right = np.array([math.cos(0.7), 0, -math.sin(0.7)])
    np.testing.assert_allclose(view.project(right), [1, 0], atol=1e-12)


def test_an_image_plane_is_what_the_camera_sees_there():
    camera = camera_to_world(torch.tensor([0.3, 2.0, 1.5], dtype=torch.float64)).numpy()
    corners = image_plane(camera, 1.5, HALF)
    np.testing.assert_allclose(corners.mean(axis=0), 0, atol=1e-12)  # at the radius it goes through the object's centre
    inside = (corners - camera[:3, 3]) @ camera[:3, :3]  # in the camera's own axes: right, up, backward
    np.testing.assert_allclose(inside[:, 2], -1.5)
    angles = np.arctan2(inside[:, :2], 1.5)
    np.testing.assert_allclose(angles, HALF * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))


def test_the_viewpoint_keeps_cameras_apart():
    # From straight behind the first, the second would be hidden by it.
    behind = viewpoint(math.radians(ELEVATION), 1.0)
    first = torch.tensor([math.radians(10), 1.0, 1.4], dtype=torch.float64)
    camera = torch.eye(4, dtype=torch.float64)
    camera[:3, 3] = camera_to_world(first)[:3, 3] - 2 * torch.from_numpy(behind[:, 2])
    poses = torch.stack([first, view_pose(camera)]).numpy()
    centres = camera_to_world(torch.from_numpy(poses))[:, :3, 3].numpy()

    def apart(view: NDArray) -> float:
        return float(np.linalg.norm(np.diff(centres @ view[:, :2], axis=0)))

    best = best_viewpoint(poses)
    assert apart(behind) < 1e-9 and apart(best) > 0.5
    towards = best[:, 2]
    offset = math.degrees(math.atan2(towards[0], towards[2]) - 1.0)
    assert min(OFFSETS) - 1e-6 <= offset <= max(OFFSETS) + 1e-6
    assert math.degrees(math.asin(towards[1])) == pytest.approx(ELEVATION)


def test_images_lie_in_their_planes():
    poses = np.array([[0.2, 0.0, 1.4], [-0.3, 2.0, 1.5], [0.5, 4.0, 1.2]])
    figure = figure_of(poses)
    figure.draw_without_rendering()
    scene = figure.axes[0]
    view = best_viewpoint(poses)
    matrices = camera_to_world(torch.from_numpy(poses)).numpy()
    planes = [image_plane(matrices[0], 1.4, HALF), *(image_plane(matrix, 0.34 * 1.5, HALF) for matrix in matrices)]
    assert len(scene.images) == len(planes)
    for image, plane in zip(scene.images, planes, strict=True):
        to_data = image.get_transform() - scene.transData
        corners = to_data.transform(np.array([[0, 0], [1, 0], [1, 1], [0, 1]]))
        np.testing.assert_allclose(corners, plane @ view[:, :2], atol=1e-9)
        assert image.get_extent() == [0, 1, 0, 1] and image.origin == "upper"  # its top row at the plane's top
    limits = np.array([scene.get_xlim(), scene.get_ylim()]).T
    drawn = np.concatenate([*planes, matrices[:, :3, 3]]) @ view[:, :2]
    assert (drawn > limits[0]).all() and (drawn < limits[1]).all()
    assert scene.get_aspect() == 1


def test_nearer_cameras_hide_farther_ones():
    poses = np.array([[0.0, 0.0, 1.4], [0.0, math.pi, 1.4]])
    scene = figure_of(poses).axes[0]
    middle, near, far = (image.get_zorder() for image in scene.images)
    assert far < middle < near


def test_verdicts_are_written_and_colour_their_cameras():
    poses = np.array([[0.0, 0.0, 1.4], [0.0, 1.0, 1.4], [0.0, 2.0, 1.4]])
    images = [Image.fromarray(draw_view(pose, 32)) for pose in poses]
    figure = cameras_figure(poses, images, range(3), ["a", "b", "c"], 49.1, ["", "trust", "do not trust"])
    colours = {text.get_text(): text.get_color() for axes in figure.axes[1:] for text in axes.texts}
    assert colours["trust"] == cameras.TRUSTED["trust"] != colours["do not trust"] == cameras.TRUSTED["do not trust"]


def test_an_image_seen_edge_on_is_not_drawn(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cameras, "best_viewpoint", lambda poses: viewpoint(0.0, math.pi / 2))
    poses = np.array([[0.0, 0.0, 1.4], [0.0, 1.0, 1.4]])
    figure = figure_of(poses)
    (image,) = figure.axes[0].images  # the second camera's; the first's, and the cut-out, are lines from here
    np.testing.assert_array_equal(image.get_array(), draw_view(poses[1], 32))
    figure.canvas.draw()


def test_small_images_keep_colours_and_opacity():
    image = np.zeros((4 * LARGEST, 4 * LARGEST, 4), dtype=np.uint8)
    image[::2, ::2] = [200, 100, 50, 255]  # every fourth pixel, the others transparent black
    small = np.asarray(shrunk(Image.fromarray(image)))
    assert small.shape == (LARGEST, LARGEST, 4)
    inside = small[1:-1, 1:-1].astype(int)  # on the border a filter has fewer pixels
    assert np.abs(inside - [200, 100, 50, 64]).max() <= 2
    whole = draw_view(np.array([0.1, 0.2, 1.4]), 16)
    np.testing.assert_array_equal(np.asarray(shrunk(Image.fromarray(whole))), whole)


@pytest.mark.parametrize("count", [1, 2, 8, 15])
def test_every_camera_is_numbered_and_has_a_card(count: int, tmp_path: Path):
    poses = random_poses(count, "cards")
    figure = figure_of(poses)
    scene, *cards = figure.axes
    shown = min(count, MOST_CARDS)
    assert len(cards) == shown
    numbers = [text.get_text() for text in scene.texts if not text.get_text().endswith("°")]
    assert sorted(numbers, key=int) == [str(index) for index in range(count)]
    assert all(isinstance(card.images[0], AxesImage) for card in cards)
    for index, card in enumerate(cards):
        latitude, longitude, radius = np.rad2deg(poses[index, 0]), np.rad2deg(poses[index, 1]), poses[index, 2]
        sign = "\N{MINUS SIGN}" if latitude < 0 else ""
        assert (card.texts[0].get_text(), card.get_title("left")) == (str(index), f"{index}.png")
        pose = f"latitude {sign}{abs(latitude):.1f}°\nlongitude {longitude:.1f}°\nradius {radius:.2f}"
        assert card.get_xlabel() == pose
    note = figure.subfigs[0].get_suptitle()
    assert note == "0 is the reference" + ("; below, 12 of 15 images" if count == 15 else "")
    boxes = [axes.get_position() for axes in figure.axes]
    assert all(box.x0 >= -1e-9 and box.x1 <= 1 + 1e-9 and box.y0 >= -1e-9 and box.y1 <= 1 + 1e-9 for box in boxes)
    if count == 2:
        png, pdf = save_figure(figure, tmp_path / "cameras")
        assert imread(png).shape[1] == 1600 and imread(png)[..., :3].std() > 0.02
        assert pdf.read_bytes().startswith(b"%PDF")
