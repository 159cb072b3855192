"""Laws of spherical view poses: round trips, ends of the ranges, closed forms, published numbers, derivatives."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from lp_framework.geometry import (
    apply_relative_pose,
    camera_to_world,
    is_rotation,
    level_camera,
    reduce_longitude,
    relative_pose,
    rigid_transform,
    so3_exp,
    spherical_residual,
    to_ifusion,
    view_pose,
    wrap_angle,
)


def double(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


REFERENCE = Path(__file__).parent / "data" / "reference" / "ifusion_poses.json"
DTYPES = [torch.float32, torch.float64]
BATCHES = [(), (5,), (2, 3)]
TURN = 2 * math.pi
law = settings(max_examples=60, deadline=None, derandomize=True)
poses = st.tuples(st.floats(-1.57, 1.57), st.floats(0, TURN, exclude_max=True), st.floats(0.1, 10)).map(double)


def random_poses(batch: tuple[int, ...], seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    """View poses over the whole range, radius in [1.2, 2]."""
    unit = torch.rand(*batch, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    low, span = double([-math.pi / 2, 0.0, 1.2]), double([math.pi, TURN, 0.8])
    return (low + span * unit).to(dtype)


def angle_gap(first: Tensor, second: Tensor) -> Tensor:
    return wrap_angle(first - second).abs()


# Angles


@pytest.mark.parametrize("dtype", DTYPES)
def test_wrap_angle_stays_in_its_half_open_range(dtype: torch.dtype) -> None:
    pi = torch.tensor(math.pi, dtype=dtype)
    edges = torch.stack([pi * k for k in range(-7, 8)])
    angles = torch.cat(
        [edges, edges.nextafter(-torch.ones_like(edges) * 99), edges.nextafter(torch.ones_like(edges) * 99)]
    )
    wrapped = wrap_angle(angles)
    assert (wrapped >= -pi).all() and (wrapped < pi).all()
    torch.testing.assert_close(wrapped.sin(), angles.sin(), rtol=0, atol=1e-5 if dtype == torch.float32 else 1e-14)
    assert wrap_angle(pi) == -pi and wrap_angle(-pi) == -pi


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_reduced_longitude_is_in_its_half_open_range_and_kept_where_it_was(dtype: torch.dtype) -> None:
    inside = torch.linspace(0, 2 * math.pi, 1001, dtype=torch.float64)[:-1].to(dtype)
    tiny = torch.tensor([-1e-9, -1e-30, -0.0], dtype=dtype)  # from which a turn up is the whole turn, rounded
    for longitude in (inside, tiny, inside - 40, inside + 40):
        pose = torch.stack([torch.full_like(longitude, 0.3), longitude, torch.full_like(longitude, 1.4)], dim=-1)
        reduced = reduce_longitude(pose)
        assert (reduced[:, 1] >= 0).all() and (reduced[:, 1] < 2 * math.pi).all()
        assert torch.equal(reduced[:, ::2], pose[:, ::2])
        torch.testing.assert_close(reduced[:, 1].cos(), longitude.cos(), rtol=0, atol=2e-5)
    same = reduce_longitude(torch.stack([inside] * 3, dim=-1))[:, 1]
    assert torch.equal(same, inside)


def test_wrap_angle_keeps_what_is_in_range_to_the_last_digit() -> None:
    angles = torch.tensor([1e-12, -1e-12, 3.0, -3.0])
    assert torch.equal(wrap_angle(angles), angles)


@law
@given(angle=st.floats(-50, 50))
def test_wrap_angle_changes_by_whole_turns_and_is_idempotent(angle: float) -> None:
    wrapped = wrap_angle(double(angle))
    turns = (angle - wrapped.item()) / TURN
    assert abs(turns - round(turns)) < 1e-13
    assert wrap_angle(wrapped) == wrapped


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("tiny", [-1e-3, -1e-7, -1e-10, -1e-20, -1e-40, -0.0, 0.0, 1e-20])
def test_longitudes_stay_below_a_whole_turn(dtype: torch.dtype, tiny: float) -> None:
    zero, x = torch.zeros(3, dtype=dtype), torch.tensor([0.0, tiny, 0.0], dtype=dtype)
    centre = torch.tensor([tiny, 0.0, 1.0], dtype=dtype)
    camera = rigid_transform(torch.eye(3, dtype=dtype), centre)
    for pose in (relative_pose(zero, x), apply_relative_pose(zero, x), view_pose(camera)):
        assert 0 <= pose[1].item() < TURN
    assert 0 <= to_ifusion(x)[1].item() < 360


def test_relative_pose_by_hand() -> None:
    reference, query = double([0.1, 6.0, 1.5]), double([-0.2, 0.5, 1.25])
    x = relative_pose(reference, query)
    torch.testing.assert_close(x, double([-0.3, 0.5 - 6.0 + TURN, -0.25]), rtol=0, atol=1e-15)
    back = relative_pose(query, reference)
    torch.testing.assert_close(back, double([0.3, 5.5, 0.25]), rtol=0, atol=1e-15)


@law
@given(reference=poses, query=poses)
def test_applying_a_relative_pose_undoes_taking_it(reference: Tensor, query: Tensor) -> None:
    x = relative_pose(reference, query)
    reached = apply_relative_pose(reference, x)
    assert 0 <= x[1] < TURN and 0 <= reached[1] < TURN
    assert (reached - query)[[0, 2]].abs().max() < 1e-14
    assert angle_gap(reached[1], query[1]) < 1e-14


@law
@given(first=poses, second=poses, third=poses)
def test_relative_poses_add_up(first: Tensor, second: Tensor, third: Tensor) -> None:
    whole, parts = relative_pose(first, third), relative_pose(first, second) + relative_pose(second, third)
    assert (whole - parts)[[0, 2]].abs().max() < 1e-14
    assert angle_gap(whole[1], parts[1]) < 1e-14


# Cameras


@pytest.mark.parametrize(
    ("pose", "centre"),
    [
        ((0.0, 0.0, 2.0), (0.0, 0.0, 2.0)),
        ((0.0, math.pi / 2, 2.0), (2.0, 0.0, 0.0)),  # longitude grows from +Z towards +X
        ((math.pi / 2, 0.3, 2.0), (0.0, 2.0, 0.0)),  # latitude is up-positive
        ((math.pi / 6, math.pi, 2.0), (0.0, 1.0, -math.sqrt(3))),
    ],
)
def test_centres_by_hand(pose: tuple[float, ...], centre: tuple[float, ...]) -> None:
    torch.testing.assert_close(camera_to_world(double(pose))[:3, 3], double(centre), rtol=0, atol=1e-15)


def test_the_camera_at_the_origin_of_angles_is_not_turned() -> None:
    assert torch.equal(camera_to_world(double([0.0, 0.0, 2.0]))[:3, :3], torch.eye(3, dtype=torch.float64))


@pytest.mark.parametrize("batch", BATCHES)
def test_cameras_look_at_the_origin_with_level_right_axis_and_up_upwards(batch: tuple[int, ...]) -> None:
    pose = random_poses(batch)
    camera = camera_to_world(pose)
    assert camera.shape == (*batch, 4, 4)
    right, up, backward, centre = camera[..., :3, :].unbind(-1)
    torch.testing.assert_close(centre, pose[..., 2:] * backward)
    assert right[..., 1].abs().max() == 0 and (up[..., 1] >= 0).all()
    torch.testing.assert_close(torch.linalg.cross(right, up), backward)
    assert torch.equal(camera[..., 3, :], double([0, 0, 0, 1]).expand(*batch, 4))


@pytest.mark.parametrize("latitude", [-math.pi / 2, -1.2, 0.0, 0.6, math.pi / 2, 2.0])
def test_camera_rotation_is_ry_rx_also_at_and_beyond_the_poles(latitude: float) -> None:
    longitude = 0.6
    rotation = camera_to_world(double([latitude, longitude, 1.5]))[:3, :3]
    expected = so3_exp(double([0.0, longitude, 0.0])) @ so3_exp(double([-latitude, 0.0, 0.0]))
    torch.testing.assert_close(rotation, expected, rtol=0, atol=1e-15)
    torch.testing.assert_close(rotation.mT @ rotation, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-15)
    assert rotation.det() > 0


@law
@given(pose=poses)
def test_view_pose_inverts_camera_to_world(pose: Tensor) -> None:
    again = view_pose(camera_to_world(pose))
    assert (again - pose)[[0, 2]].abs().max() < 1e-13
    # The longitude is as uncertain as the centre, over its distance from the axis.
    assert angle_gap(again[1], pose[1]) * pose[0].cos() < 1e-14


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("batch", BATCHES)
def test_round_trips_keep_shape_and_dtype(batch: tuple[int, ...], dtype: torch.dtype) -> None:
    pose = random_poses(batch, seed=1, dtype=dtype)
    camera = camera_to_world(pose)
    assert camera.dtype == dtype and view_pose(camera).dtype == dtype and spherical_residual(camera).shape == batch
    tolerance = 1e-5 if dtype == torch.float32 else 1e-13
    torch.testing.assert_close(camera_to_world(view_pose(camera)), camera, rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("latitude", [-math.pi / 2, math.pi / 2])
def test_the_longitude_survives_at_the_poles(latitude: float, dtype: torch.dtype) -> None:
    pose = torch.tensor([[latitude, longitude, 1.5] for longitude in (0.0, 0.6, 2.5, 4.0)], dtype=dtype)
    tolerance = 1e-6 if dtype == torch.float32 else 1e-14
    torch.testing.assert_close(view_pose(camera_to_world(pose)), pose, rtol=0, atol=tolerance)
    assert spherical_residual(camera_to_world(pose)).max() < 1e-4


@pytest.mark.parametrize("degrees", [1e-9, 0.5, 30.0, 90.0, 180.0])
def test_a_rolled_camera_has_its_roll_as_residual(degrees: float) -> None:
    camera = camera_to_world(random_poses((5,), seed=2))
    roll = rigid_transform(so3_exp(double([0.0, 0.0, math.radians(degrees)])), torch.zeros(3, dtype=torch.float64))
    assert spherical_residual(camera).max() < 1e-12
    torch.testing.assert_close(spherical_residual(camera @ roll), double([degrees] * 5), rtol=1e-6, atol=1e-11)


@pytest.mark.parametrize("batch", BATCHES)
def test_level_camera_sees_the_origin_along_the_direction_and_is_level(batch: tuple[int, ...]) -> None:
    pose = random_poses(batch) * double(
        [0.7, 1.0, 1.0]
    )  # latitudes up to 63 degrees, directions up to 23 from the axis
    direction = torch.cat(
        [double([0.3, -0.2]) * random_poses(batch, seed=1)[..., :2].sin(), -double([1.0]).expand(*batch, 1)], -1
    )
    camera = level_camera(pose, direction)
    rotation, centre = camera[..., :3, :3], camera[..., :3, 3]
    assert is_rotation(rotation, 1e-12).all() and (rotation[..., 1, 1] > 0).all()
    torch.testing.assert_close(centre, camera_to_world(pose)[..., :3, 3])
    assert rotation[..., 1, 0].abs().max() < 1e-12
    seen = -(rotation.mT @ centre[..., None])[..., 0]
    torch.testing.assert_close(torch.linalg.cross(seen, direction), torch.zeros_like(seen), rtol=0, atol=1e-12)
    assert ((seen * direction).sum(-1) > 0).all()
    ahead = level_camera(pose, 3 * double([0.0, 0.0, -1.0]).expand(*batch, 3))
    torch.testing.assert_close(ahead, camera_to_world(pose))


def test_level_camera_above_the_object_sees_it_along_the_direction_too() -> None:
    """There none is level that sees the origin at its side."""
    direction = double([0.2, 0.1, -1.0])
    for latitude in (math.pi / 2, -1.5, math.pi / 2 - 1e-9):
        camera = level_camera(double([latitude, 1.0, 2.0]), direction)
        seen = -(camera[:3, :3].mT @ camera[:3, 3])
        torch.testing.assert_close(seen, 2 * direction / direction.norm())


def test_cameras_are_differentiable_and_smooth_at_the_poles() -> None:
    pose = double([[0.4, 0.6, 1.5], [math.pi / 2, 0.6, 1.5], [-math.pi / 2, 3.0, 2.0]]).requires_grad_()
    assert torch.autograd.gradcheck(camera_to_world, pose, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(camera_to_world, pose)


def test_view_pose_is_differentiable_and_keeps_gradients_finite_at_the_poles() -> None:
    camera = camera_to_world(random_poses((4,), seed=3)).requires_grad_()
    assert torch.autograd.gradcheck(view_pose, camera, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(view_pose, camera)
    pole = rigid_transform(torch.eye(3, dtype=torch.float64), double([0.0, 2.0, 0.0])).requires_grad_()
    view_pose(pole).sum().backward()
    assert pole.grad is not None and pole.grad.isfinite().all()


def test_relative_poses_are_differentiable_across_the_seam() -> None:
    reference, query = double([0.1, 6.0, 1.5]).requires_grad_(), double([0.2, 0.3, 1.4]).requires_grad_()
    assert torch.autograd.gradcheck(relative_pose, (reference, query), check_forward_ad=True)
    assert torch.autograd.gradcheck(apply_relative_pose, (reference, query), check_forward_ad=True)
    on_seam = torch.func.jacrev(relative_pose, argnums=1)(torch.zeros(3), torch.tensor([0.0, -1e-10, 0.0]))
    assert torch.equal(on_seam, torch.eye(3))


@pytest.mark.parametrize("function", [camera_to_world, to_ifusion, wrap_angle, lambda pose: wrap_angle(pose[0])])
def test_forward_mode_keeps_float32_and_agrees_with_reverse_mode(function: Callable[[Tensor], Tensor]) -> None:
    pose = random_poses((), dtype=torch.float32)
    forward = torch.func.jacfwd(function)(pose)
    assert forward.dtype == torch.float32
    torch.testing.assert_close(forward, torch.func.jacrev(function)(pose))
    camera = camera_to_world(pose)
    assert (
        torch.func.jacfwd(view_pose)(camera).dtype == torch.func.jacfwd(spherical_residual)(camera).dtype == pose.dtype
    )


def test_functions_map_over_a_batch() -> None:
    pose = random_poses((4,), seed=4)
    torch.testing.assert_close(torch.func.vmap(camera_to_world)(pose), camera_to_world(pose))
    camera = camera_to_world(pose)
    torch.testing.assert_close(torch.func.vmap(view_pose)(camera), view_pose(camera))


# iFusion


def test_ifusion_latitude_is_down_positive() -> None:
    pose = double([math.pi / 6, -0.5 * math.pi, 1.5])
    torch.testing.assert_close(to_ifusion(pose), double([-30.0, 270.0, 1.5]))


def test_against_ifusion_cameras() -> None:
    # Published iFusion code, float32: six to seven digits.
    reference = json.loads(REFERENCE.read_text())
    latlon, cameras = double(reference["latlon_deg"]), double(reference["camera_to_world"])
    pose = torch.stack([-latlon[:, 0].deg2rad(), latlon[:, 1].deg2rad(), latlon[:, 2]], dim=-1)
    torch.testing.assert_close(camera_to_world(pose), cameras, rtol=0, atol=1e-6)
    torch.testing.assert_close(to_ifusion(view_pose(cameras)), latlon, rtol=1e-5, atol=1e-5)
    assert spherical_residual(cameras).max() < 1e-4
