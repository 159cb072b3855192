"""Rotations and rigid motions: SO(3) and SE(3) with their exponentials.

Convention: matrices act on column vectors; angles in radians; a twist `xi` `[..., 6]` holds the translation part
first, then the rotation part (iFusion's order). `se3_exp(xi)` is the matrix exponential of
`[[hat(xi[3:]), xi[:3]], [0, 0]]`, so the translation of the result is `V(omega) rho`, not `rho`.
Batch dimensions are arbitrary and broadcast between two arguments. Exponentials have correct first and second
derivatives in reverse and forward mode, also at and near zero. Products are written out elementwise because matrix
products lose digits under autocast or TF32.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

# Power series in the squared angle; below 1, 12 terms are enough for float64 in the value and both derivatives.
_TERMS = 12
_SIN_SERIES = [(-1) ** k / math.factorial(2 * k + 1) for k in range(_TERMS)]  # sin(t) / t
_COS_SERIES = [(-1) ** k / math.factorial(2 * k + 2) for k in range(_TERMS)]  # (1 - cos t) / t^2
_CUBIC_SERIES = [(-1) ** k / math.factorial(2 * k + 3) for k in range(_TERMS)]  # (t - sin t) / t^3


def _even_function(squared: Tensor, closed_form: Callable[[Tensor], Tensor], series: Sequence[float]) -> Tensor:
    """An even function of t, given t^2: its power series where t^2 < 1, otherwise `closed_form(t)`.

    Each branch gets harmless arguments where the other is selected, so that its NaNs never reach a gradient. `squared`
    needs at least one dimension: under vmap, forward-mode tangents of 0-dimensional float32 tensors combined with a
    Python float become float64 (seen with PyTorch 2.13).
    """
    near = squared < 1
    inside = squared.masked_fill(~near, 0.0)
    total = torch.full_like(squared, series[-1])
    for coefficient in reversed(series[:-1]):
        total = total * inside + coefficient
    return torch.where(near, total, closed_form(squared.masked_fill(near, 1.0).sqrt()))


def _cos_ratio(squared: Tensor) -> Tensor:
    return _even_function(squared, lambda t: 2 * ((t / 2).sin() / t).square(), _COS_SERIES)


def hat(omega: Tensor) -> Tensor:
    """Skew-symmetric matrix `[..., 3, 3]` of a vector `[..., 3]`: `hat(a) @ b` is the cross product of a and b.

    >>> hat(torch.tensor([1.0, 2.0, 3.0]))
    tensor([[ 0., -3.,  2.],
            [ 3.,  0., -1.],
            [-2.,  1.,  0.]])
    """
    x, y, z = omega.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def so3_exp(omega: Tensor) -> Tensor:
    """Rotation matrix `[..., 3, 3]` of a rotation vector `[..., 3]` (axis times angle, radians), by Rodrigues' formula.

    >>> so3_exp(torch.tensor([0.0, torch.pi / 6, 0.0]))
    tensor([[ 0.8660,  0.0000,  0.5000],
            [ 0.0000,  1.0000,  0.0000],
            [-0.5000,  0.0000,  0.8660]])
    """
    squared = omega.square().sum(-1, keepdim=True)[..., None]
    first, second = _even_function(squared, lambda t: t.sin() / t, _SIN_SERIES), _cos_ratio(squared)
    identity = torch.eye(3, dtype=omega.dtype, device=omega.device)
    # hat(omega)^2 = omega omega^T - |omega|^2 I
    outer = omega[..., :, None] * omega[..., None, :]
    return first * hat(omega) + second * outer + (1 - second * squared) * identity


def geodesic_angle(first: Tensor, second: Tensor) -> Tensor:
    """Angle `[...]` in radians, in [0, pi], between two rotations `[..., 3, 3]`.

    Computed by atan2 of sine and cosine, both from the difference of the matrices: exactly zero for equal rotations,
    and accurate for tiny angles in float32. The gradient is 0 at angle 0, where the angle is not differentiable.

    >>> geodesic_angle(torch.eye(3), so3_exp(torch.tensor([3e-6, 0.0, 4e-6])))
    tensor(5.0000e-06)
    """
    difference = second - first
    # With R = second first^T and columns a_i: sum_i a_i x (R a_i - a_i) = 2 sin(angle) axis.
    first, difference = torch.broadcast_tensors(first, difference)
    twice_sine = torch.linalg.vector_norm(torch.linalg.cross(first, difference, dim=-2).sum(-1), dim=-1)
    cosine = 1 - difference.square().sum((-2, -1)) / 4
    return torch.atan2(twice_sine / 2, cosine)


def is_rotation(matrix: Tensor, tolerance: float = 1e-3) -> Tensor:
    """Whether matrices `[..., 3, 3]` are rotations, `[...]`: orthonormal to `tolerance`, with positive determinant.

    False if an entry is not finite.

    >>> is_rotation(torch.stack([torch.eye(3), -torch.eye(3), 2 * torch.eye(3)]))
    tensor([ True, False, False])
    """
    skew = (matrix.mT @ matrix - torch.eye(3).to(matrix)).abs().amax(dim=(-2, -1))
    return (skew < tolerance) & (matrix.det() > 0)


def rigid_transform(rotation: Tensor, translation: Tensor) -> Tensor:
    """Homogeneous matrix `[..., 4, 4]` of a rotation `[..., 3, 3]` followed by a translation `[..., 3]`.

    >>> rigid_transform(torch.eye(3), torch.tensor([1.0, 2.0, 3.0]))[:, 3]
    tensor([1., 2., 3., 1.])
    """
    batch = torch.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    top = torch.cat([rotation.expand(*batch, 3, 3), translation[..., None].expand(*batch, 3, 1)], dim=-1)
    bottom = torch.eye(4, dtype=top.dtype, device=top.device)[3:]
    return torch.cat([top, bottom.expand(*batch, 1, 4)], dim=-2)


def inverse(transform: Tensor) -> Tensor:
    """Inverse `[..., 4, 4]` of a rigid transform `[..., 4, 4]`.

    >>> inverse(rigid_transform(torch.eye(3), torch.tensor([1.0, 2.0, 3.0])))[:, 3]
    tensor([-1., -2., -3.,  1.])
    """
    rotation, translation = transform[..., :3, :3], transform[..., :3, 3]
    return rigid_transform(rotation.mT, -(rotation * translation[..., None]).sum(-2))


def se3_exp(xi: Tensor) -> Tensor:
    """Rigid transform `[..., 4, 4]` of a twist `[..., 6]` (translation part in scene units, then radians).

    >>> se3_exp(torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0, torch.pi]))[:3, 3]  # half a circle of length 1
    tensor([0.0000, 0.6366, 0.0000])
    """
    rho, omega = xi.split(3, dim=-1)
    squared = omega.square().sum(-1, keepdim=True)
    second, third = _cos_ratio(squared), _even_function(squared, lambda t: (t - t.sin()) / t**3, _CUBIC_SERIES)
    # V rho with V = I + second * hat(omega) + third * hat(omega)^2
    turned = torch.linalg.cross(omega, rho, dim=-1)
    translation = rho + second * turned + third * torch.linalg.cross(omega, turned, dim=-1)
    return rigid_transform(so3_exp(omega), translation)
