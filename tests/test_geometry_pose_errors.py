"""Pose errors: closed forms over [0, 180] degrees, tiny angles in float32, published numbers, derivatives."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from lp_framework.geometry import (
    camera_to_world,
    rigid_transform,
    rotation_error,
    se3_exp,
    so3_exp,
    translation_error,
)


def double(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


REFERENCE = Path(__file__).parent / "data" / "reference" / "ifusion_poses.json"
BATCHES = [(), (5,), (2, 3)]
law = settings(max_examples=60, deadline=None, derandomize=True)
twists = st.tuples(*[st.floats(-3, 3)] * 6).map(double)


def errors_of(pose: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
    """Both errors of the camera at a view pose."""
    predicted = camera_to_world(pose)
    return rotation_error(predicted, true), translation_error(predicted, true)


def random_cameras(batch: tuple[int, ...], seed: int = 0) -> Tensor:
    return se3_exp(torch.randn(*batch, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))


@pytest.mark.parametrize("degrees", [0.0, 1e-10, 1e-3, 5.0, 15.0, 30.0, 90.0, 179.9, 179.9999999, 180.0])
@pytest.mark.parametrize("batch", BATCHES)
def test_rotation_error_is_the_angle_turned(batch: tuple[int, ...], degrees: float) -> None:
    true = random_cameras(batch)
    omega = math.radians(degrees) * double([2 / 3, -1 / 3, 2 / 3])
    predicted = rigid_transform(so3_exp(omega), double([0.4, 0.0, -0.3])) @ true
    error = rotation_error(predicted, true)
    torch.testing.assert_close(error, torch.full(batch, degrees, dtype=torch.float64), rtol=0, atol=1e-12)
    torch.testing.assert_close(rotation_error(predicted[..., :3, :3], true), error, rtol=0, atol=0)


@pytest.mark.parametrize("degrees", [1e-6, 1e-4, 1e-3, 1e-2])
def test_tiny_angles_are_resolved_in_float32(degrees: float) -> None:
    # About a camera whose entries are exact in float32; arccos would read 0 for all of these.
    turned = so3_exp(torch.tensor([0.0, 0.0, math.radians(degrees)]))
    assert rotation_error(turned, torch.eye(3)).item() == pytest.approx(degrees, rel=1e-5)


def test_tiny_longitude_differences_in_float32() -> None:
    view, moved = camera_to_world(torch.tensor([[0.3, 0.6, 1.5], [0.3, 0.6 + 1e-4, 1.5]]))
    assert rotation_error(moved, view).item() == pytest.approx(math.degrees(1e-4), rel=2e-3)
    assert rotation_error(view, view).item() == 0


def test_half_turns_stay_in_range_in_float32() -> None:
    true = random_cameras((200,)).float()
    predicted = true @ torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))
    error = rotation_error(predicted, true)
    assert (error <= 180).all() and (error > 179.999).all()


@law
@given(predicted=twists, true=twists, motion=twists)
def test_errors_are_symmetric_and_independent_of_the_world_frame(
    predicted: Tensor, true: Tensor, motion: Tensor
) -> None:
    predicted, true, motion = se3_exp(predicted), se3_exp(true), se3_exp(motion)
    for error in (rotation_error, translation_error):
        torch.testing.assert_close(error(predicted, true), error(true, predicted), rtol=0, atol=1e-12)
        torch.testing.assert_close(error(motion @ predicted, motion @ true), error(predicted, true), rtol=0, atol=1e-11)
    assert 0 <= rotation_error(predicted, true) <= 180


def test_errors_broadcast() -> None:
    assert rotation_error(random_cameras((2, 3)), random_cameras((3,))).shape == (2, 3)
    assert translation_error(random_cameras((2, 1)), random_cameras((3,))).shape == (2, 3)


@pytest.mark.parametrize(
    ("predicted", "true", "rotation", "translation"),
    [
        ((0.2, 0.6, 1.5), (0.2, 0.6, 1.5), 0.0, 0.0),
        ((0.2, 0.6, 2.0), (0.2, 0.6, 1.5), 0.0, 0.5),
        ((0.0, 0.6, 1.5), (0.0, 0.6 + math.pi, 1.5), 180.0, 3.0),
        ((0.0, 0.1, 2.0), (0.0, 6.2, 2.0), math.degrees(2 * math.pi - 6.1), 4 * math.sin(math.pi - 3.05)),
        ((math.pi / 6, 0.6, 2.0), (-math.pi / 6, 0.6, 2.0), 60.0, 2.0),
        # At latitude a, half a turn of longitude turns the camera by 180 degrees but moves it by 2 r cos(a).
        ((math.pi / 3, 0.0, 2.0), (math.pi / 3, math.pi, 2.0), 180.0, 2.0),
    ],
)
def test_pose_errors_by_hand(
    predicted: tuple[float, ...], true: tuple[float, ...], rotation: float, translation: float
) -> None:
    turned, moved = errors_of(double(predicted), camera_to_world(double(true)))
    torch.testing.assert_close(turned, double(rotation), rtol=0, atol=1e-12)
    torch.testing.assert_close(moved, double(translation), rtol=0, atol=1e-14)


@pytest.mark.parametrize("batch", BATCHES)
def test_pose_errors_keep_the_batch(batch: tuple[int, ...]) -> None:
    pose = double([0.1, 2.0, 1.5]).expand(*batch, 3)
    rotation, translation = errors_of(pose, random_cameras(batch))
    assert rotation.shape == batch and translation.shape == batch


def test_errors_are_differentiable_and_finite_where_they_are_zero() -> None:
    pose, true = double([0.1, 2.0, 1.5]).requires_grad_(), camera_to_world(double([-0.3, 1.2, 1.8]))
    assert torch.autograd.gradcheck(lambda p: errors_of(p, true), pose, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(lambda p: errors_of(p, true), pose)
    rotation, translation = errors_of(pose, camera_to_world(pose.detach()))
    (gradient,) = torch.autograd.grad(rotation + translation, pose)
    assert torch.equal(gradient, torch.zeros(3, dtype=torch.float64))


def test_against_ifusion_errors() -> None:
    # Published iFusion code, float32; its arccos multiplies the rounding of the trace by 1 / sin(angle).
    reference = json.loads(REFERENCE.read_text())
    cameras, latlon = double(reference["camera_to_world"]), double(reference["latlon_deg"])
    pose = torch.stack([-latlon[:, 0].deg2rad(), latlon[:, 1].deg2rad(), latlon[:, 2]], dim=-1)  # down-positive
    first, second = ([pair[key] for pair in reference["pairs"]] for key in ("a", "b"))
    rotation = double([pair["rotation_error_deg"] for pair in reference["pairs"]])
    translation = double([pair["translation_error"] for pair in reference["pairs"]])
    uncertainty = math.degrees(4 * torch.finfo(torch.float32).eps) / torch.deg2rad(rotation).sin()
    assert ((rotation_error(cameras[first], cameras[second]) - rotation).abs() < uncertainty).all()
    torch.testing.assert_close(translation_error(cameras[first], cameras[second]), translation, rtol=0, atol=1e-6)
    turned, moved = errors_of(pose[first], cameras[second])
    assert ((turned - rotation).abs() < uncertainty).all()
    torch.testing.assert_close(moved, translation, rtol=0, atol=1e-6)
