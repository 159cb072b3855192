"""Cameras shifted until outlines match: against truth, and where outlines determine nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from lp_framework.data.outlines import CORNERS, LARGEST, convex_outline, match_outlines
from lp_framework.geometry import camera_to_world

POINTS = np.random.default_rng(0).normal(size=(200, 3)) * [0.15, 0.25, 0.1]


def cameras_of(*degrees: tuple[float, float]) -> NDArray[np.float64]:
    poses = torch.tensor([[math.radians(each) for each in place] + [2.0] for place in degrees], dtype=torch.float64)
    return camera_to_world(poses).numpy()


def outlines(cameras: NDArray[np.float64]) -> NDArray[np.float64]:
    rays = []
    for camera in cameras:
        seen = (POINTS - camera[:3, 3]) @ camera[:3, :3]
        seen = seen / -seen[:, 2:]
        hull = ConvexHull(seen[:, :2]).vertices
        rays.append(seen[hull[np.linspace(0, len(hull) - 1, CORNERS).round().astype(int)]])
    return np.stack(rays)


def shifted(cameras: NDArray[np.float64], size: float) -> NDArray[np.float64]:
    result = cameras.copy()
    result[:, :3, 3] += np.random.default_rng(1).normal(size=(len(cameras), 3)) * size
    return result


def misplaced(cameras: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """The root mean square distance of the cameras from the true ones after a translation and a scale."""
    ours, true = (each[:, :3, 3] - each[:, :3, 3].mean(axis=0) for each in (cameras, truth))
    return float(np.sqrt(((ours * (ours * true).sum() / (ours**2).sum() - true) ** 2).sum(axis=-1).mean()))


@pytest.mark.parametrize("places", [[(10, 0), (20, 50)], [(0, 0), (30, 70), (-10, 160), (20, 250), (60, 300)]])
def test_positions_are_recovered_up_to_a_translation_and_a_scale(places: list[tuple[float, float]]):
    truth = cameras_of(*places)
    start = shifted(truth, 0.05)
    found = match_outlines(start, outlines(truth))
    np.testing.assert_array_equal(found[:, :3, :3], truth[:, :3, :3])
    assert misplaced(found, truth) < 0.1 * misplaced(start, truth)
    again = match_outlines(found, outlines(truth))
    np.testing.assert_allclose(again, found, atol=0.01)


def test_matching_outlines_move_no_camera():
    cameras = cameras_of((10, 0), (20, 50), (0, 200))
    np.testing.assert_allclose(match_outlines(cameras, outlines(cameras)), cameras, atol=1e-6)


@pytest.mark.parametrize("places", [[(10, 30)], [(10, 30), (10, 30)], [(10, 30), (-10, 210)]])
def test_a_single_the_same_and_opposite_cameras_stay(places: list[tuple[float, float]]):
    """The planes through two cameras are unknown if they coincide or see each other through the object."""
    cameras = cameras_of(*places)
    np.testing.assert_allclose(match_outlines(cameras, outlines(cameras_of((0, 0), (0, 90)))[: len(places)]), cameras)


def test_outlines_that_cannot_match_move_cameras_by_a_bounded_amount():
    cameras = cameras_of((10, 0), (20, 60), (0, 150))
    wrong = outlines(cameras) * [[[3, 3, 1]], [[1, 1, 1]], [[0.2, 0.2, 1]]]
    moved = np.linalg.norm((match_outlines(cameras, wrong) - cameras)[:, :3, 3], axis=-1)
    assert np.isfinite(moved).all() and moved.max() < 2.0 * 3 * LARGEST


def test_a_convex_outline_surrounds_whole_pixels():
    opaque = np.zeros((20, 30), bool)
    opaque[5:8, 10:20] = True
    corners = convex_outline(opaque)
    assert corners.shape == (CORNERS, 2)
    assert {tuple(corner) for corner in corners.tolist()} == {(10, 5), (20, 5), (20, 8), (10, 8)}
