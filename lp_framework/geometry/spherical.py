"""Spherical view poses, relative poses, the corresponding cameras, and errors between cameras.

Convention (the paper's appendix, Coordinate System): a view pose `[..., 3]` is (latitude, longitude, radius) in
radians, radians, scene units. Latitude is up-positive from the equator; longitude 0 lies on +Z and grows towards +X
(counter-clockwise seen from +Y); the camera looks at the origin, +Y is up. `camera_to_world` `[..., 4, 4]` is OpenGL
style: the camera looks down its -Z, +Y up, +X right. Batch dimensions are arbitrary.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lp_framework.geometry.se3 import geodesic_angle, rigid_transform, so3_exp


def wrap_angle(angle: Tensor) -> Tensor:
    """The same angle in [-pi, pi), radians; exact (and so sign-preserving) for angles already there.

    >>> wrap_angle(torch.tensor([3.5, -3.5, 0.25, torch.pi]))
    tensor([-2.7832,  2.7832,  0.2500, -3.1416])
    """
    rest = torch.fmod(angle[..., None], 2 * math.pi)  # exact, in (-2 pi, 2 pi); the shifts below are exact too
    rest = torch.where(rest >= math.pi, rest - 2 * math.pi, rest)
    return torch.where(rest < -math.pi, rest + 2 * math.pi, rest).squeeze(-1)


def _reduce(angle: Tensor, turn: float) -> Tensor:
    """The same angle in [0, turn); `angle` needs at least one dimension (see `se3._even_function`)."""
    rest = torch.remainder(angle, turn)
    # For a tiny negative angle, `remainder` rounds to `turn` itself.
    return torch.where(rest >= turn, rest - turn, rest)


def reduce_longitude(pose: Tensor) -> Tensor:
    """The same pose `[..., 3]` with its longitude in [0, 2 pi); exact for longitudes already there.

    >>> reduce_longitude(torch.tensor([0.1, -0.5, 1.5]))
    tensor([0.1000, 5.7832, 1.5000])
    """
    latitude, longitude, radius = pose.split(1, dim=-1)
    return torch.cat([latitude, _reduce(longitude, 2 * math.pi), radius], dim=-1)


def relative_pose(reference: Tensor, query: Tensor) -> Tensor:
    """Relative pose `[..., 3]`, query minus reference, of two view poses `[..., 3]`; longitude in [0, 2 pi).

    >>> relative_pose(torch.tensor([0.1, 6.2, 1.5]), torch.tensor([0.3, 0.1, 1.5]))
    tensor([0.2000, 0.1832, 0.0000])
    """
    return reduce_longitude(query - reference)


def apply_relative_pose(reference: Tensor, x: Tensor) -> Tensor:
    """View pose `[..., 3]` of the query: reference plus relative pose `x`, both `[..., 3]`; longitude in [0, 2 pi).

    >>> apply_relative_pose(torch.tensor([0.1, 6.2, 1.5]), torch.tensor([0.2, 0.1832, 0.0]))
    tensor([0.3000, 0.1000, 1.5000])
    """
    return reduce_longitude(reference + x)


def camera_to_world(pose: Tensor) -> Tensor:
    """Camera matrix `[..., 4, 4]` of a view pose `[..., 3]`: rotation Ry(longitude) Rx(-latitude), smooth everywhere.

    >>> camera_to_world(torch.tensor([0.0, torch.pi / 6, 2.0]))
    tensor([[ 0.8660, -0.0000,  0.5000,  1.0000],
            [ 0.0000,  1.0000,  0.0000,  0.0000],
            [-0.5000, -0.0000,  0.8660,  1.7321],
            [ 0.0000,  0.0000,  0.0000,  1.0000]])
    """
    latitude, longitude, radius = pose.unbind(-1)
    sin_lat, cos_lat, sin_lon, cos_lon = latitude.sin(), latitude.cos(), longitude.sin(), longitude.cos()
    right = torch.stack([cos_lon, torch.zeros_like(cos_lon), -sin_lon], dim=-1)
    up = torch.stack([-sin_lat * sin_lon, cos_lat, -sin_lat * cos_lon], dim=-1)
    backward = torch.stack([cos_lat * sin_lon, sin_lat, cos_lat * cos_lon], dim=-1)
    return rigid_transform(torch.stack([right, up, backward], dim=-1), radius[..., None] * backward)


def level_camera(pose: Tensor, direction: Tensor) -> Tensor:
    """Level camera `[..., 4, 4]` (horizontal +X axis) at a view pose `[..., 3]` that sees the origin along `direction`
    `[..., 3]`, a vector of any length in the camera's own axes with a negative third entry.

    It is `camera_to_world(pose)`, which sees the origin straight ahead, rotated until the origin appears along
    `direction`. Near a pole there may be no level camera; the result then has the smallest roll.

    >>> camera = level_camera(torch.tensor([0.0, 0.0, 2.0]), torch.tensor([1.0, 0.0, -1.0]))  # the origin at the right
    >>> camera[:, 2]  # so it looks to the left of it
    tensor([0.7071, 0.0000, 0.7071, 0.0000])
    """
    x, y, z = direction.unbind(-1)
    aside = torch.hypot(x, y)
    axis = torch.stack([-y, x, torch.zeros_like(x)], dim=-1) / aside.clamp(min=torch.finfo(x.dtype).tiny)[..., None]
    turn = so3_exp(axis * torch.atan2(aside, -z)[..., None])  # the smallest rotation of `direction` to straight ahead
    right, up, back = turn[..., 0].unbind(-1)  # the rotated +X axis, made horizontal by the roll below
    sine = -pose[..., 0].tan() * back / torch.hypot(right, up)
    roll = torch.asin(sine.clamp(-1, 1)) - torch.atan2(up, right)
    ahead = camera_to_world(pose)
    rotation = ahead[..., :3, :3] @ so3_exp(torch.stack([0 * roll, 0 * roll, roll], dim=-1)) @ turn
    return rigid_transform(rotation, ahead[..., :3, 3])


def view_pose(camera: Tensor) -> Tensor:
    """View pose `[..., 3]` of the centre of a camera `[..., 4, 4]`; latitude in [-pi/2, pi/2], longitude in [0, 2 pi).

    At the poles (up to rounding) the centre does not determine the longitude, so it comes from the camera's right axis,
    which keeps `view_pose(camera_to_world(pose)) == pose`. Latitude and longitude are not differentiable at the poles.

    >>> view_pose(camera_to_world(torch.tensor([-0.3, 6.0, 1.5])))
    tensor([-0.3000,  6.0000,  1.5000])
    """
    x, y, z = camera[..., :3, 3].split(1, dim=-1)
    radius = torch.linalg.vector_norm(camera[..., :3, 3], dim=-1, keepdim=True)
    horizontal_squared = x.square() + z.square()
    polar = horizontal_squared <= (4 * torch.finfo(x.dtype).eps * radius).square()
    horizontal = horizontal_squared.masked_fill(polar, 1.0).sqrt().masked_fill(polar, 0.0)
    longitude = torch.atan2(torch.where(polar, -camera[..., 2, :1], x), torch.where(polar, camera[..., 0, :1], z))
    return reduce_longitude(torch.cat([torch.atan2(y, horizontal), longitude, radius], dim=-1))


def rotation_error(predicted: Tensor, true: Tensor) -> Tensor:
    """Geodesic angle `[...]` in degrees, in [0, 180], between the rotations of two cameras (paper, Evaluation Metrics).

    Each is a camera-to-world matrix `[..., 4, 4]` or a rotation `[..., 3, 3]`; batch dimensions broadcast.

    >>> rotation_error(camera_to_world(torch.tensor([0.0, 0.3, 1.5])), camera_to_world(torch.tensor([0.0, 0.1, 2.0])))
    tensor(11.4592)
    """
    return torch.rad2deg(geodesic_angle(predicted[..., :3, :3], true[..., :3, :3]))


def translation_error(predicted: Tensor, true: Tensor) -> Tensor:
    """Distance `[...]` in scene units between the centres of two cameras `[..., 4, 4]`.

    >>> near, far = camera_to_world(torch.tensor([[0.0, 0.4, 1.5], [0.0, 0.4, 2.0]]))
    >>> translation_error(near, far)
    tensor(0.5000)
    """
    return torch.linalg.vector_norm(predicted[..., :3, 3] - true[..., :3, 3], dim=-1)


def spherical_residual(camera: Tensor) -> Tensor:
    """Angle `[...]` in degrees between a camera `[..., 4, 4]` and the spherical camera at its centre.

    This is the rotation error of a method that finds the camera's centre exactly but predicts spherical cameras.

    >>> upright = rigid_transform(torch.eye(3), torch.tensor([1.0, 0.0, 1.0]))  # looks along -Z, past the origin
    >>> spherical_residual(upright)
    tensor(45.)
    """
    return rotation_error(camera, camera_to_world(view_pose(camera)))


def to_ifusion(pose: Tensor) -> Tensor:
    """The iFusion `latlon` `[..., 3]` of a view pose: (down-positive latitude, longitude in [0, 360), degrees; radius).

    >>> to_ifusion(torch.tensor([0.5235988, 1.5707963, 1.5]))
    tensor([-30.0000,  90.0000,   1.5000])
    """
    latitude, longitude, radius = pose.split(1, dim=-1)
    return torch.cat([-torch.rad2deg(latitude), _reduce(torch.rad2deg(longitude), 360.0), radius], dim=-1)
