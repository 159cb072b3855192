"""Laws of two views: relative cameras, the optimal scale, the relative pose that a relative camera stands for."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from lp_framework.geometry import (
    at_optimal_scale,
    camera_to_world,
    from_opencv,
    inverse,
    pose_of_relative_camera,
    relative_camera,
    relative_pose,
    rigid_transform,
    rotation_error,
    so3_exp,
    translation_error,
    wrap_angle,
)

BATCHES = [(), (5,), (2, 3)]


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def camera(*batch: int, seed: int = 0) -> Tensor:
    return rigid_transform(so3_exp(random(*batch, 3, seed=seed)), random(*batch, 3, seed=seed + 1))


def view_poses(count: int, seed: int) -> Tensor:
    unit = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.tensor([-1.4, 0.0, 1.1]) + unit * torch.tensor([2.8, 2 * math.pi, 1.0], dtype=torch.float64)


@pytest.mark.parametrize("batch", BATCHES)
def test_the_reference_followed_by_the_relative_camera_is_the_query(batch):
    reference, query = camera(*batch), camera(*batch, seed=7)
    relative = relative_camera(reference, query)
    torch.testing.assert_close(reference @ relative, query)
    moved = camera(*batch, seed=9)  # whatever the world's frame
    torch.testing.assert_close(relative_camera(moved @ reference, moved @ query), relative)


@pytest.mark.parametrize("batch", BATCHES)
def test_opencvs_axes(batch):
    opengl = camera(*batch)
    opencv = from_opencv(opengl)  # its own inverse
    torch.testing.assert_close(from_opencv(opencv), opengl)
    torch.testing.assert_close(opencv[..., :3, 2], -opengl[..., :3, 2])  # it looks along +z
    torch.testing.assert_close(opencv[..., :3, 1], -opengl[..., :3, 1])
    torch.testing.assert_close(opencv[..., :3, 3], opengl[..., :3, 3])
    assert (torch.linalg.det(opencv[..., :3, :3]) > 0).all()


# ---------------------------------------------------------------- optimal scale


def test_the_optimal_scale_is_the_closed_form_and_the_best_of_a_fine_search():
    predicted, true = camera(40), camera(40, seed=3)
    t, wanted = predicted[:, :3, 3], true[:, :3, 3]
    scaled = at_optimal_scale(predicted, true)
    factor = ((t * wanted).sum(1) / t.square().sum(1)).clamp(min=0)
    torch.testing.assert_close(scaled[:, :3, 3], factor[:, None] * t)
    assert torch.equal(scaled[:, :3, :3], predicted[:, :3, :3])
    tried = torch.linspace(0, 5, 2001, dtype=torch.float64)[:, None, None] * t
    distances = torch.linalg.vector_norm(tried - wanted, dim=-1)
    assert (translation_error(scaled, true) <= distances.min(dim=0).values + 1e-12).all()
    assert 0 < (factor == 0).sum() < 40  # both cases are among them


def test_the_optimal_scale_does_not_depend_on_the_scale_and_finds_a_right_direction():
    true = camera(6)
    for factor in (1e-6, 1.0, 1e6):
        predicted = rigid_transform(true[:, :3, :3], factor * true[:, :3, 3])
        torch.testing.assert_close(at_optimal_scale(predicted, true), true)


def test_a_camera_that_has_not_moved_stays_and_one_that_is_missing_stays_missing():
    true = camera()
    still = rigid_transform(true[:3, :3], torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(at_optimal_scale(still, true), still)
    missing = at_optimal_scale(torch.full_like(true, torch.nan), true)
    assert rotation_error(missing, true).isnan() and translation_error(missing, true).isnan()


# ---------------------------------------------------------------- relative pose


def test_spherical_cameras_have_the_relative_pose_of_their_view_poses_at_any_scale():
    reference, query = view_poses(500, 0), view_poses(500, 1)
    reference[:, 2] = 1.5
    wanted = relative_pose(reference, query)
    aside = (wrap_angle(wanted[:, 1]).abs() < 3.0) & (wanted[:, 1] > 0.01)
    exact = relative_camera(camera_to_world(reference), camera_to_world(query))
    for factor in (0.01, 1.0, 30.0):
        scaled = rigid_transform(exact[:, :3, :3], factor * exact[:, :3, 3])
        found = pose_of_relative_camera(scaled, reference_radius=1.5)
        torch.testing.assert_close(found[aside], wanted[aside], rtol=0, atol=1e-7)
    assert aside.sum() > 400


def test_the_radius_goes_with_that_of_the_reference():
    reference, query = view_poses(50, 2), view_poses(50, 3)
    relative = relative_camera(camera_to_world(reference), camera_to_world(query))
    found = pose_of_relative_camera(relative, reference_radius=3.0)[:, 2]
    torch.testing.assert_close(found, 3.0 * (query[:, 2] / reference[:, 2] - 1), rtol=0, atol=1e-7)


@pytest.mark.parametrize("batch", BATCHES)
def test_the_same_view_is_the_relative_pose_zero(batch):
    same = torch.eye(4, dtype=torch.float64).expand(*batch, 4, 4)
    assert torch.equal(pose_of_relative_camera(same, 1.4), torch.zeros(*batch, 3, dtype=torch.float64))


def test_where_the_lines_of_sight_do_not_meet_in_front_the_radius_stays():
    exact = relative_camera(*camera_to_world(torch.tensor([[0.1, 0.2, 1.5], [0.3, 1.0, 1.8]], dtype=torch.float64)))
    backwards = rigid_transform(exact[:3, :3], -exact[:3, 3])
    found = pose_of_relative_camera(backwards, 1.5)
    torch.testing.assert_close(found, torch.tensor([0.2, 0.8, 0.0], dtype=torch.float64))
    along = rigid_transform(exact[:3, :3], 2 * exact[:3, 2])
    assert pose_of_relative_camera(along, 1.5)[2] == 0


def test_a_small_error_of_the_camera_is_a_small_error_of_the_pose():
    """Also where cameras are nearly the same, where latitudes themselves are undetermined."""
    reference = view_poses(200, 4)
    query = reference + torch.tensor([0.05, 0.001, 0.1], dtype=torch.float64)
    exact = relative_camera(camera_to_world(reference), camera_to_world(query))
    noisy = exact @ rigid_transform(so3_exp(1e-4 * random(200, 3)), 1e-5 * random(200, 3, seed=1))
    away = pose_of_relative_camera(noisy, 1.5) - pose_of_relative_camera(exact, 1.5)
    assert away[:, 0].abs().max() < 1e-3
    assert wrap_angle(away[:, 1]).abs().max() < 3e-3


def test_a_missing_camera_has_no_pose():
    cameras = torch.stack([torch.full((4, 4), torch.nan), torch.eye(4)])
    assert pose_of_relative_camera(cameras, 1.4).isnan().tolist() == [[True] * 3, [False] * 3]


def test_the_inverse_camera_has_the_negative_pose():
    reference, query = camera_to_world(torch.tensor([[0.1, 0.2, 1.5], [0.3, 1.0, 1.5]], dtype=torch.float64))
    forth = relative_camera(reference, query)
    there, back = (pose_of_relative_camera(each, 1.5) for each in (forth, inverse(forth)))
    torch.testing.assert_close(back, relative_pose(there, torch.zeros_like(there)))
