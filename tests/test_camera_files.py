"""Cameras for other programs, read back by readers written from those programs' descriptions of their files."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from colmap_reader import ColmapImage, read_colmap
from numpy.typing import NDArray
from PIL import Image
from view_folders import FIELD_OF_VIEW, draw_view, random_poses

from lp_framework.data.views import colmap_model, nerf_transforms, read_views
from lp_framework.geometry import camera_to_world

DEGREES = 49.1
POSES = torch.from_numpy(
    np.concatenate(
        [
            random_poses(12, "camera files"),
            # The reference as it is by default, half a turn, the poles, beyond a pole.
            [[0, 0, 1.4], [0, math.pi, 1.4], [math.pi / 2, 1, 1], [-math.pi / 2, 2, 1], [2.5, 0.3, 0.7]],
        ]
    )
)
NAMES = [f"{index:03d}.png" for index in range(len(POSES))]


def test_colmap_has_the_same_cameras():
    cameras, images = read_colmap(colmap_model(NAMES, POSES, 256, DEGREES))
    assert [image.name for image in images] == NAMES and {image.camera for image in images} == set(cameras) == {1}
    for image, ours in zip(images, camera_to_world(POSES).numpy(), strict=True):
        np.testing.assert_allclose(-image.rotation.T @ image.translation, ours[:3, 3], atol=1e-9)  # the centre
        right, down, forward = image.rotation  # the camera's axes in the world
        np.testing.assert_allclose(np.stack([right, -down, -forward], axis=1), ours[:3, :3], atol=1e-9)


def test_colmap_sees_the_object_in_the_middle_upright_and_as_large_as_it_should():
    cameras, images = read_colmap(colmap_model(NAMES[:12], POSES[:12], 256, DEGREES))
    kind, *numbers = cameras[1]
    width, height, fx, fy, cx, cy = map(float, numbers)
    assert (kind, width, height) == ("PINHOLE", 256, 256)
    assert 2 * math.degrees(math.atan(width / 2 / fx)) == pytest.approx(DEGREES)

    def seen(image: ColmapImage, point: NDArray) -> NDArray:
        x, y, z = image.rotation @ point + image.translation
        assert z > 0  # in front
        return np.array([fx * x / z + cx, fy * y / z + cy])

    for image, (_, longitude, radius) in zip(images, POSES.tolist(), strict=False):
        np.testing.assert_allclose(seen(image, np.zeros(3)), [128, 128], atol=1e-8)
        assert seen(image, np.array([0, 0.1, 0]))[1] < 128  # +Y is up
        sideways = np.array([math.cos(longitude), 0, -math.sin(longitude)])
        u, _ = seen(image, 0.5 * sideways)
        assert u - 128 == pytest.approx(fx * 0.5 / radius)


def test_colmap_has_no_points():
    lines = colmap_model(NAMES, POSES, 256, DEGREES)["points3D.txt"].splitlines()
    assert all(line.startswith("#") for line in lines)


def test_transforms_are_read_back_as_views(tmp_path: Path):
    count = 12
    split = tmp_path / "cup" / "test"
    (split / "rgb").mkdir(parents=True)
    for name, pose in zip(NAMES[:count], POSES.numpy(), strict=False):
        Image.fromarray(draw_view(pose, 16)).save(split / "rgb" / name)
    content = nerf_transforms(NAMES[:count], POSES[:count], DEGREES)
    (split / "transform.json").write_text(json.dumps(content))
    views = read_views(tmp_path, "cup", "test")
    torch.testing.assert_close(views.poses, POSES[:count], rtol=0, atol=1e-9)
    assert views.field_of_view == pytest.approx(FIELD_OF_VIEW)
    assert [file.name for file in views.files] == NAMES[:count]


def test_latlon_is_that_of_ifusion():
    """Its latitude counts downwards: see `geometry.to_ifusion`."""
    (frame,) = nerf_transforms(["a.png"], torch.tensor([[math.radians(30), math.radians(-90), 1.5]]), DEGREES)["frames"]
    assert frame["latlon"] == pytest.approx([-30, 270, 1.5], abs=1e-4)
