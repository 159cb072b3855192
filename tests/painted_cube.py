"""Photographs of a painted cube by any pinhole camera, drawn by casting one ray per pixel; for tests of converted data.

The cube has side 1, centred at the origin; a point of its surface has the colour 128 + 200 * (x, y, z). So each pixel
of a photograph, wherever it ends up, tells the point of the object that it shows.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

SIDES = (1.0, 0.6, 0.4)  # a box in truth, so that no two of its axes can be confused


def photograph(
    camera: Tensor, intrinsics: Tensor, size: tuple[int, int]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """RGB `[H, W, 3]` (grey background) and mask `[H, W]` of the box seen by a camera `[4, 4]` (camera to world, OpenGL
    axes) with intrinsics `[3, 3]` in pixels, the image's corner at (0, 0)."""
    width, height = size
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(intrinsics.numpy()).T * [1, -1, -1]
    matrix = camera.numpy()
    points, inside = hits(matrix[:3, 3], rays @ matrix[:3, :3].T)
    colours = np.where(inside[..., None], paint(points), 90.0)
    return colours.clip(0, 255).astype(np.uint8), (255 * inside).astype(np.uint8)


def hits(origin: NDArray[np.float64], rays: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Where rays `[..., 3]` from `origin` `[3]` meet the box, and whether they do."""
    half = np.array(SIDES) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(-half - origin) / rays, (half - origin) / rays])
    near, far = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    return origin + near[..., None] * rays, (near < far) & (near > 0)


def paint(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return 128 + 200 * points


def check_view(pixels: NDArray[np.uint8], camera: Tensor, field_of_view: float) -> float:
    """Share of a square view `[S, S, 4]` that differs from the box in front of a camera: pixels where just one of them
    shows the object, or whose colours are more than 12 apart, among those that either shows."""
    size = len(pixels)
    focal = size / 2 / np.tan(field_of_view / 2)
    intrinsics = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], dtype=torch.float64)
    colours, mask = photograph(camera, intrinsics, (size, size))
    shown, expected = pixels[..., 3] >= 128, mask >= 128
    apart = np.abs(pixels[..., :3].astype(int) - colours).max(axis=-1) > 12
    wrong = (shown != expected) | (apart & shown & expected)
    return float(wrong.sum() / (shown | expected).sum())
