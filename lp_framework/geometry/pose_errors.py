"""Rotation and translation error between cameras (the paper's Evaluation Metrics)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lp_framework.geometry.se3 import geodesic_angle
from lp_framework.geometry.spherical import camera_to_world


class PoseErrors(NamedTuple):
    """Errors `[...]` of predicted cameras: `rotation` in degrees, `translation` in scene units."""

    rotation: Tensor
    translation: Tensor


def rotation_error(predicted: Tensor, true: Tensor) -> Tensor:
    """Geodesic angle `[...]` in degrees, in [0, 180], between the rotations of two cameras.

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


def pose_errors(predicted_view_pose: Tensor, true_camera_to_world: Tensor) -> PoseErrors:
    """Both errors `[...]` of a predicted view pose `[..., 3]` against the true camera `[..., 4, 4]`.

    >>> pose_errors(torch.tensor([0.1, 0.0, 1.5]), camera_to_world(torch.tensor([0.0, 0.0, 1.5])))
    PoseErrors(rotation=tensor(5.7296), translation=tensor(0.1499))
    """
    predicted = camera_to_world(predicted_view_pose)
    return PoseErrors(
        rotation=rotation_error(predicted, true_camera_to_world),
        translation=translation_error(predicted, true_camera_to_world),
    )
