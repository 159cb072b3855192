"""Two views of one object: relative cameras, and the relative pose they imply.

A *relative camera* `[..., 4, 4]` is the query's camera in the frame of the reference's camera, both with OpenGL axes
(the camera looks down its -Z, +Y up, +X right). From two images alone, its translation can be found only up to scale.
Batch dimensions are arbitrary and broadcast between two arguments.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lp_framework.geometry.se3 import inverse, rigid_transform
from lp_framework.geometry.spherical import relative_pose


def from_opencv(camera: Tensor) -> Tensor:
    """Convert camera-to-world matrices `[..., 4, 4]` from OpenCV axes (x right, y down, looks down +z) to ours.

    >>> from_opencv(torch.eye(4)).diagonal()
    tensor([ 1., -1., -1.,  1.])
    """
    return camera * camera.new_tensor([1.0, -1.0, -1.0, 1.0])


def relative_camera(reference: Tensor, query: Tensor) -> Tensor:
    """The relative camera of two camera-to-world matrices, all `[..., 4, 4]`.

    >>> left, right = (rigid_transform(torch.eye(3), torch.tensor([x, 0.0, 0.0])) for x in (1.0, 3.0))
    >>> relative_camera(left, right)[:3, 3]
    tensor([2., 0., 0.])
    """
    return inverse(reference) @ query


def at_optimal_scale(camera: Tensor, true: Tensor) -> Tensor:
    """A relative camera with its translation t scaled to be as close as possible to the true one, t*.

    The factor is max(0, t . t*) / (t . t), the paper's "optimal scale" (Details of Baseline Settings) for one pair. It
    is never negative, so that cameras do not switch sides. A zero translation is left unchanged.

    >>> ahead, true = (rigid_transform(torch.eye(3), torch.tensor(t)) for t in ([0.0, 0.0, 5.0], [1.0, 0.0, 2.0]))
    >>> at_optimal_scale(ahead, true)[:3, 3]
    tensor([0., 0., 2.])
    """
    translation, true = torch.broadcast_tensors(camera[..., :3, 3], true[..., :3, 3])
    squared = translation.square().sum(-1, keepdim=True)
    along = (translation * true).sum(-1, keepdim=True).clamp(min=0)
    factor = torch.where(squared > 0, along / squared.where(squared > 0, torch.ones_like(squared)), squared)
    return rigid_transform(camera[..., :3, :3], factor * translation)


def pose_of_relative_camera(camera: Tensor, reference_radius: float) -> Tensor:
    """Relative pose `[..., 3]` of a relative camera, for upright cameras that look at the object's centre.

    For two such cameras at latitudes a and b with longitude difference d, the relative rotation is Rx(a) Ry(d) Rx(-b).
    It determines d and, unless d is half a turn, b - a. The lines of sight meet at the centre, `reference_radius` in
    front of the reference. With the direction of the translation, of any length, this determines the query's radius (by
    least squares if the lines do not intersect). The relative radius is 0 if they do not meet in front of both cameras,
    or if the translation is zero or lies along the query's line of sight.

    >>> from lp_framework.geometry.spherical import camera_to_world
    >>> reference, query = camera_to_world(torch.tensor([[0.1, 0.5, 1.5], [0.3, 1.0, 1.7]]))
    >>> pose_of_relative_camera(relative_camera(reference, query), reference_radius=1.5)
    tensor([0.2000, 0.5000, 0.2000])
    """
    rotation, translation = camera[..., :3, :3], camera[..., :3, 3]
    # (1 + cos d) times cosine and sine of b - a
    latitude = torch.atan2(rotation[..., 1, 2] - rotation[..., 2, 1], rotation[..., 1, 1] + rotation[..., 2, 2])
    sine = torch.linalg.vector_norm(rotation[..., 0, 1:], dim=-1)
    leftwards = rotation[..., 0, 2] < rotation[..., 2, 0]  # the difference is sin d (cos a + cos b)
    longitude = torch.atan2(torch.where(leftwards, -sine, sine), rotation[..., 0, 0])

    # length u - radius z = (0, 0, -reference_radius), with u the translation's direction and z the query's +Z
    distance = torch.linalg.vector_norm(translation, dim=-1, keepdim=True)
    u, z = translation / distance.where(distance > 0, torch.ones_like(distance)), rotation[..., :, 2]
    cosine = (u * z).sum(-1)
    determinant = (1 - cosine.square()).where(distance[..., 0] > 0, torch.zeros_like(cosine))
    sound = determinant > 1e-6
    divisor = determinant.where(sound, torch.ones_like(determinant))
    length = reference_radius * (cosine * z[..., 2] - u[..., 2]) / divisor
    radius = reference_radius * (z[..., 2] - cosine * u[..., 2]) / divisor
    sound &= (length > 0) & (radius > 0)
    radius = radius.where(sound | cosine.isnan(), torch.full_like(radius, reference_radius))
    pose = torch.stack([latitude, longitude, radius - reference_radius], dim=-1)
    return relative_pose(torch.zeros_like(pose), pose)
