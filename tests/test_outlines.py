"""Cameras whose outlines match: against truth, and where outlines determine nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from lp_framework.data.outlines import CORNERS, LARGEST, convex_outline, match_outlines
from lp_framework.geometry import camera_to_world, level_camera, view_pose

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


def shifted(cameras: NDArray[np.float64], seed: int = 0) -> NDArray[np.float64]:
    """Level cameras at the same latitudes and longitudes, but with other distances, that see the origin elsewhere."""
    poses, random = view_pose(torch.from_numpy(cameras)), np.random.default_rng(seed)
    poses[:, 2] *= torch.from_numpy(np.exp(0.15 * random.normal(size=len(cameras))))
    directions = np.concatenate([0.05 * random.normal(size=(len(cameras), 2)), -np.ones((len(cameras), 1))], axis=1)
    return level_camera(poses, torch.from_numpy(directions)).numpy()


def misplaced(cameras: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """The root mean square distance of the cameras from the true ones after a translation and a scale."""
    ours, true = (each[:, :3, 3] - each[:, :3, 3].mean(axis=0) for each in (cameras, truth))
    return float(np.sqrt(((ours * (ours * true).sum() / (ours**2).sum() - true) ** 2).sum(axis=-1).mean()))


def misoriented(cameras: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """The root mean square angle between the cameras and the true ones, in degrees."""
    relative = np.swapaxes(cameras[:, :3, :3], 1, 2) @ truth[:, :3, :3]
    angles = np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1))
    return float(np.degrees(np.sqrt((angles**2).mean())))


AROUND = [(0, 0), (30, 70), (-10, 160), (20, 250), (60, 300)]
MORE = [*AROUND, (10, 30), (-20, 100), (40, 200)]


@pytest.mark.parametrize(("places", "left"), [([(0, 0), (20, 50), (10, 120)], 0.6), (AROUND, 0.4), (MORE, 0.05)])
def test_cameras_are_recovered_up_to_a_translation_and_a_scale(places: list[tuple[float, float]], left: float):
    truth = cameras_of(*places)
    for seed in range(4):
        start = shifted(truth, seed)
        found = match_outlines(start, outlines(truth))
        assert misplaced(found, truth) < left * misplaced(start, truth)
        again = match_outlines(found, outlines(truth))
        np.testing.assert_allclose(again, found, atol=0.05)


def test_the_more_outlines_the_better_their_cameras_orientations():
    errors = []
    for places in (AROUND, MORE):
        truth = cameras_of(*places)
        start = shifted(truth)
        found = match_outlines(start, outlines(truth))
        errors.append(misoriented(found, truth) / misoriented(start, truth))
    assert errors[0] < 0.4 and errors[1] < 0.1


def test_cameras_stay_level_at_their_latitudes_and_longitudes():
    truth = cameras_of(*AROUND)
    found = match_outlines(shifted(truth), outlines(truth))
    expected, actual = (view_pose(torch.from_numpy(each))[:, :2] for each in (truth, found))
    torch.testing.assert_close(actual, expected)
    np.testing.assert_allclose(found[:, 1, 0], 0, atol=1e-12)  # the +X axis is horizontal


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
    moved = match_outlines(cameras, wrong)
    origins = -np.einsum("vji,vj->vi", moved[:, :3, :3], moved[:, :3, 3])
    assert np.isfinite(moved).all()
    assert (np.abs(origins[:, :2] / origins[:, 2:]) < LARGEST + 1e-9).all()
    assert (np.abs(np.log(-origins[:, 2] / 2.0)) < LARGEST + 1e-9).all()


def test_a_convex_outline_surrounds_whole_pixels():
    opaque = np.zeros((20, 30), bool)
    opaque[5:8, 10:20] = True
    corners = convex_outline(opaque)
    assert corners.shape == (CORNERS, 2)
    assert {tuple(corner) for corner in corners.tolist()} == {(10, 5), (20, 5), (20, 8), (10, 8)}
