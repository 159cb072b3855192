"""Laws of SO(3) and SE(3): against matrix_exp, group laws, derivatives at and near zero."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from solver_problems import away
from torch import Tensor

from lp_framework.geometry import (
    camera_to_world,
    geodesic_angle,
    hat,
    inverse,
    is_rotation,
    rigid_transform,
    se3_exp,
    so3_exp,
    view_pose,
)


def double(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


GOLDEN = Path(__file__).parent / "data" / "reference" / "zero123_tiny" / "golden.npz"
BATCHES = [(), (5,), (2, 3)]
# Zero, both sides of the change from series to closed form (1), up to nearly a half turn.
ANGLES = [0.0, 1e-200, 1e-12, 1e-6, 1e-3, 0.3, 0.999999, 1.0, 1.000001, 2.0, 3.1, math.pi - 1e-4, math.pi - 1e-7]
law = settings(max_examples=60, deadline=None, derandomize=True)
components = st.floats(-2, 2)
twists = st.tuples(*[components] * 6).map(double)


def random_twists(batch: tuple[int, ...], seed: int = 0, scale: float = 1.0) -> Tensor:
    return scale * torch.randn(*batch, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def axis(seed: int = 0) -> Tensor:
    direction = torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return direction / direction.norm()


def twist_matrix(xi: Tensor) -> Tensor:
    """The 4x4 matrix of a twist, translation part first."""
    top = torch.cat([hat(xi[..., 3:]), xi[..., :3, None]], dim=-1)
    return torch.cat([top, torch.zeros_like(top[..., :1, :])], dim=-2)


# Values


@pytest.mark.parametrize("batch", BATCHES)
def test_hat_is_the_cross_product(batch: tuple[int, ...]) -> None:
    first, second = random_twists(batch).split(3, dim=-1)
    product = (hat(first) @ second[..., None]).squeeze(-1)
    torch.testing.assert_close(product, torch.linalg.cross(first, second))


@pytest.mark.parametrize("scale", [1e-8, 1e-3, 0.4, 1.0, 3.0])
@pytest.mark.parametrize("batch", BATCHES)
def test_exponentials_against_matrix_exp(batch: tuple[int, ...], scale: float) -> None:
    xi = random_twists(batch, scale=scale)
    assert se3_exp(xi).shape == (*batch, 4, 4)
    torch.testing.assert_close(se3_exp(xi), torch.linalg.matrix_exp(twist_matrix(xi)), rtol=0, atol=1e-13)
    torch.testing.assert_close(so3_exp(xi[..., 3:]), torch.linalg.matrix_exp(hat(xi[..., 3:])), rtol=0, atol=1e-13)


@pytest.mark.parametrize("angle", ANGLES)
def test_rotations_of_every_angle_against_matrix_exp(angle: float) -> None:
    xi = torch.cat([double([0.3, -1.1, 0.7]), angle * axis()])
    torch.testing.assert_close(se3_exp(xi), torch.linalg.matrix_exp(twist_matrix(xi)), rtol=0, atol=1e-14)


def test_zero_twist_is_exactly_the_identity() -> None:
    assert torch.equal(se3_exp(torch.zeros(6)), torch.eye(4))


def test_a_half_turn_forwards_along_a_half_circle() -> None:
    # Speed 1 for pi seconds at 1 rad/s about +Z: a half circle of radius 1.
    motion = se3_exp(double([math.pi, 0, 0, 0, 0, math.pi]))
    torch.testing.assert_close(motion[:3, 3], double([0.0, 2.0, 0.0]), rtol=0, atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-20, 1e-6, 0.01, 1.0, 3.0, 3.14])
def test_float32_is_as_good_as_float32_can_be(angle: float) -> None:
    xi = torch.cat([torch.tensor([0.3, -1.1, 0.7]), angle * axis().float()])
    exact = torch.linalg.matrix_exp(twist_matrix(xi.double()))
    torch.testing.assert_close(se3_exp(xi).double(), exact, rtol=0, atol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-5, 0.6, 3.0, math.pi - 1e-6, math.pi])
def test_geodesic_angle_is_the_angle_of_the_rotation_between(angle: float) -> None:
    first = so3_exp(random_twists((5,))[..., 3:])
    expected = double([angle] * 5)
    torch.testing.assert_close(geodesic_angle(first, so3_exp(angle * axis()) @ first), expected, rtol=0, atol=3e-15)
    torch.testing.assert_close(geodesic_angle(first, first @ so3_exp(angle * axis())), expected, rtol=0, atol=3e-15)


def test_rigid_transform_puts_the_parts_in_place_and_broadcasts() -> None:
    rotation, translation = so3_exp(random_twists((2, 3))[..., 3:]), random_twists((2, 3), seed=1)[..., :3]
    transform = rigid_transform(rotation, translation)
    assert torch.equal(transform[..., :3, :3], rotation) and torch.equal(transform[..., :3, 3], translation)
    assert torch.equal(transform[..., 3, :], double([0, 0, 0, 1]).expand(2, 3, 4))
    assert torch.equal(rigid_transform(torch.eye(3), torch.ones(5, 3))[:, :3, 3], torch.ones(5, 3))
    assert rigid_transform(rotation, translation[0, 0]).shape == (2, 3, 4, 4)


# Group laws


@law
@given(xi=twists)
def test_exponential_is_a_rigid_motion_and_minus_the_twist_undoes_it(xi: Tensor) -> None:
    motion = se3_exp(xi)
    rotation, eye = motion[:3, :3], torch.eye(4, dtype=torch.float64)
    torch.testing.assert_close(rotation.mT @ rotation, eye[:3, :3], rtol=0, atol=1e-14)
    assert rotation.det() > 0
    torch.testing.assert_close(motion @ se3_exp(-xi), eye, rtol=0, atol=1e-13)
    torch.testing.assert_close(inverse(motion), se3_exp(-xi), rtol=0, atol=1e-13)


@law
@given(xi=twists, first=components, second=components)
def test_motions_along_one_twist_add_up(xi: Tensor, first: float, second: float) -> None:
    torch.testing.assert_close(
        se3_exp(first * xi) @ se3_exp(second * xi), se3_exp((first + second) * xi), rtol=0, atol=1e-12
    )


@law
@given(first=twists, second=twists, third=twists)
def test_inverse_reverses_products_and_geodesic_angle_is_a_metric(first: Tensor, second: Tensor, third: Tensor) -> None:
    first, second, third = se3_exp(first), se3_exp(second), se3_exp(third)
    torch.testing.assert_close(inverse(first @ second), inverse(second) @ inverse(first), rtol=0, atol=1e-12)
    a, b, c = first[:3, :3], second[:3, :3], third[:3, :3]
    torch.testing.assert_close(geodesic_angle(a, b), geodesic_angle(b, a), rtol=0, atol=1e-14)
    torch.testing.assert_close(geodesic_angle(c @ a, c @ b), geodesic_angle(a, b), rtol=0, atol=1e-13)
    assert geodesic_angle(a, c) <= geodesic_angle(a, b) + geodesic_angle(b, c) + 1e-13


@pytest.mark.parametrize("batch", BATCHES)
def test_batches_are_their_elements_and_the_inverse_undoes(batch: tuple[int, ...]) -> None:
    motion = se3_exp(random_twists(batch, seed=5))
    torch.testing.assert_close(inverse(motion) @ motion, torch.eye(4, dtype=torch.float64).expand(*batch, 4, 4))
    twists = random_twists(batch, seed=5).reshape(-1, 6)
    single = torch.stack([se3_exp(one) for one in twists]).reshape(*batch, 4, 4)
    torch.testing.assert_close(motion, single, rtol=0, atol=1e-14)


# Derivatives


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.3, 0.9, 1.5, 3.0])
def test_first_and_second_derivatives_by_finite_differences(angle: float) -> None:
    xi = torch.cat([double([0.3, -1.1, 0.7]), angle * axis()]).requires_grad_()
    assert torch.autograd.gradcheck(se3_exp, xi, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(se3_exp, xi, check_fwd_over_rev=True)


def test_zero_twist_derivatives_in_closed_form() -> None:
    zero = torch.zeros(6, dtype=torch.float64)
    generators = torch.stack([twist_matrix(one) for one in torch.eye(6, dtype=torch.float64)], dim=-1)
    torch.testing.assert_close(torch.func.jacrev(se3_exp)(zero), generators, rtol=0, atol=0)
    torch.testing.assert_close(torch.func.jacfwd(se3_exp)(zero), generators, rtol=0, atol=0)
    # d^2 exp / dxi_i dxi_j at zero is the symmetrised product of the generators.
    product = torch.einsum("abi,bcj->acij", generators, generators)
    expected = (product + product.transpose(-1, -2)) / 2
    torch.testing.assert_close(torch.func.hessian(se3_exp)(zero), expected, rtol=0, atol=1e-15)


def test_jvp_under_vmap_agrees_with_the_batch() -> None:
    xi, direction = random_twists((4,)), random_twists((4,), seed=1)
    xi[0] = 0
    batched = torch.func.jvp(se3_exp, (xi,), (direction,))[1]
    mapped = torch.func.vmap(lambda x, d: torch.func.jvp(se3_exp, (x,), (d,))[1])(xi, direction)
    torch.testing.assert_close(mapped, batched)
    jacobians = torch.func.vmap(torch.func.jacrev(se3_exp))(xi)
    assert jacobians.shape == (4, 4, 4, 6) and jacobians.isfinite().all()


def test_huge_twists_do_not_spoil_the_gradient() -> None:
    xi = torch.full((6,), 1e5).requires_grad_()  # the power series would overflow here
    se3_exp(xi).sum().backward()
    assert xi.grad is not None and xi.grad.isfinite().all()


def test_geodesic_angle_is_differentiable_and_finite_at_its_kink() -> None:
    first, second = so3_exp(random_twists((2,))[..., 3:])
    first, second = first.clone().requires_grad_(), second.clone().requires_grad_()
    assert torch.autograd.gradcheck(geodesic_angle, (first, second), check_forward_ad=True)
    (gradient,) = torch.autograd.grad(geodesic_angle(first, first.detach()), first)
    assert torch.equal(gradient, torch.zeros_like(gradient))


@given(twists)
@law
def test_is_rotation(xi: Tensor) -> None:
    rotation = so3_exp(xi[3:])
    scaled, mirrored, sheared = 1.01 * rotation, -rotation, rotation + 0.01 * torch.eye(3, dtype=torch.float64)[0]
    found = is_rotation(torch.stack([rotation, scaled, mirrored, sheared, torch.full((3, 3), math.nan).double()]))
    assert found.tolist() == [True, False, False, False, False]
    assert is_rotation(rotation.float()) and not is_rotation(rotation + math.inf) and not is_rotation(1e300 * rotation)


# iFusion


def test_ifusion_ends_where_its_twist_leads() -> None:
    # golden.npz: published iFusion loop from (0, 90 degrees, radius 1); T = T0 @ exp(xi), latitude down-positive,
    # distance = 0.8 sin(norm - 1). Float32 on CPU.
    with np.load(GOLDEN) as golden:
        xi, (down, longitude, distance) = double(golden["adam_xi"]), double(golden["adam_traj"])[-1]
    start = camera_to_world(double([0.0, math.pi / 2, 1.0]))
    pose = view_pose(start @ se3_exp(xi))
    reached = torch.stack([-pose[0], pose[1], 0.8 * (pose[2] - 1).sin()])
    for turn in (0.0, 2 * math.pi):  # a published longitude may lie in any turn
        assert away(reached, torch.stack([down, longitude + turn, distance])).abs().max() < 2e-6
