"""A reader of COLMAP's text models, from their description alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray


class ColmapImage(NamedTuple):
    name: str
    rotation: NDArray  # world to camera
    translation: NDArray
    camera: int


def read_colmap(model: dict[str, str]) -> tuple[dict[int, list[str]], list[ColmapImage]]:
    """Cameras and images of a text model, as https://colmap.github.io/format.html says."""
    cameras = {
        int(line.split()[0]): line.split()[1:]
        for line in model["cameras.txt"].splitlines()
        if line and not line.startswith("#")
    }
    lines = [line for line in model["images.txt"].splitlines() if not line.startswith("#")]
    images = []
    for first, points in zip(lines[::2], lines[1::2], strict=True):
        assert points == ""
        number, *pose, camera, name = first.split()
        assert int(number) == len(images) + 1
        w, x, y, z, *translation = map(float, pose)
        rotation = np.array(
            [
                [1 - 2 * y * y - 2 * z * z, 2 * x * y - 2 * z * w, 2 * z * x + 2 * y * w],
                [2 * x * y + 2 * z * w, 1 - 2 * x * x - 2 * z * z, 2 * y * z - 2 * x * w],
                [2 * z * x - 2 * y * w, 2 * y * z + 2 * x * w, 1 - 2 * x * x - 2 * y * y],
            ]
        )
        assert w * w + x * x + y * y + z * z == pytest.approx(1, abs=1e-10) and w >= 0
        images.append(ColmapImage(name, rotation, np.array(translation), int(camera)))
    return cameras, images
