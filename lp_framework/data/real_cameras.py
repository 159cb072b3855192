"""Cameras of photographs, and how each becomes a spherical pose with the priors' field of view.

A photograph's camera is a camera-to-world matrix `[..., 4, 4]` (OpenGL axes, see `geometry.spherical`) in the object's
frame (centre of its bounding box at the origin, +Y up, longest side 1), with intrinsics `[..., 3, 3]` in pixels, the
corner of the image at (0, 0) and its first pixel's centre at (0.5, 0.5). It stands anywhere, turned anyhow.

1. *Virtual turn.* Turning a camera about its own centre changes the image by a homography, exactly. So the camera is
   turned to look at the origin with +Y up: it is then spherical, at the latitude, longitude and distance of the real
   one.
2. *Crop.* The homography also chooses the field of view of the square crop. It is the one in which the object's centre
   plane looks as large as it does to a camera of the priors' field of view F at the *effective radius* r:
   tan(crop / 2) = r / distance * tan(F / 2). Any r could be had; `effective_radii` says which are taken.
3. *Residual.* The crop is not that camera's image: seen from another distance, near parts look larger or smaller.
   `perspective_residual` is that difference.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lp_framework.data.views import FIELD_OF_VIEW_DEGREES
from lp_framework.geometry import camera_to_world, geodesic_angle, inverse, rigid_transform, view_pose

NEAREST_RADIUS, FARTHEST_RADIUS = 1.2, 2.0  # of rendered views; their middle is what an object's median becomes


# ---------------------------------------------------------------- other conventions


def from_pytorch3d(rotation: Tensor, translation: Tensor) -> Tensor:
    """Camera to world `[..., 4, 4]` with OpenGL axes of PyTorch3D's `R` `[..., 3, 3]` and `T` `[..., 3]`.

    Theirs act on row vectors, X_camera = X_world R + T, with x left, y up and z forward.

    >>> from_pytorch3d(torch.eye(3), torch.tensor([0.0, 0.0, 2.0]))[:3, 3]
    tensor([-0., -0., -2.])
    """
    return inverse(rigid_transform(rotation.mT, translation)) * rotation.new_tensor([-1.0, 1.0, -1.0, 1.0])


def ndc_intrinsics(focal_length: Tensor, principal_point: Tensor, size: tuple[int, int], isotropic: bool) -> Tensor:
    """Intrinsics `[..., 3, 3]` in pixels of PyTorch3D's, `[..., 2]` each, for images of `size` (width, height).

    In its coordinates x points left and y up from the middle of the image; where `isotropic` half the shorter side is
    1 (PyTorch3D 0.5 and later), else half the width and half the height are 1 each.

    >>> ndc_intrinsics(torch.tensor([2.0, 2.0]), torch.tensor([0.0, 0.1]), (200, 100), isotropic=True)
    tensor([[100.,   0., 100.],
            [  0., 100.,  45.],
            [  0.,   0.,   1.]])
    """
    middle = focal_length.new_tensor(size) / 2
    scale = middle.min().expand(2) if isotropic else middle
    return _intrinsics(focal_length * scale, middle - principal_point * scale)


def _intrinsics(focal: Tensor, centre: Tensor) -> Tensor:
    matrix = torch.diag_embed(torch.cat([focal, torch.ones_like(focal[..., :1])], dim=-1))
    matrix[..., :2, 2] = centre
    return matrix


def z_up_to_y_up(camera: Tensor) -> Tensor:
    """A camera `[..., 4, 4]` of a world with +Z up in ours: x, y, z become Z, X, Y.

    So the longitude that grows from +X towards +Y there is our longitude.

    >>> z_up_to_y_up(rigid_transform(torch.eye(3), torch.tensor([1.0, 2.0, 3.0])))[:3, 3]
    tensor([2., 3., 1.])
    """
    return camera[..., [1, 2, 0, 3], :]


# ---------------------------------------------------------------- to spherical ones


def turn_towards_centre(camera: Tensor) -> tuple[Tensor, Tensor]:
    """The camera `[..., 4, 4]` turned about its own centre until it is spherical, and the angle `[...]` of that turn
    in degrees, the roll included."""
    turned = camera_to_world(view_pose(camera))
    return turned, torch.rad2deg(geodesic_angle(camera[..., :3, :3], turned[..., :3, :3]))


def effective_radii(distances: Tensor) -> Tensor:
    """The radii `[V]` that an object's views get, of their cameras' distances `[V]` in units of its longest side.

    One factor for the object, which takes the median distance to the middle of the range of rendered views: so the
    ratio of two radii is that of the distances. A view that would leave the range gets the range's end.

    >>> effective_radii(torch.tensor([6.0, 8.0, 9.0, 20.0, 4.0]))
    tensor([1.2000, 1.6000, 1.8000, 2.0000, 1.2000])
    """
    middle = (NEAREST_RADIUS + FARTHEST_RADIUS) / 2
    return (distances * (middle / distances.median())).clamp(NEAREST_RADIUS, FARTHEST_RADIUS)


def crop_field_of_view(distance: Tensor, radius: Tensor) -> Tensor:
    """Field of view `[...]` in radians of the crop from `distance` that stands for a camera at the effective `radius`.

    >>> torch.rad2deg(crop_field_of_view(torch.tensor([1.6, 8.0]), torch.tensor([1.6, 1.6])))
    tensor([49.1000, 10.4397])
    """
    return 2 * torch.atan(radius / distance * math.tan(math.radians(FIELD_OF_VIEW_DEGREES) / 2))


def crop_homography(camera: Tensor, intrinsics: Tensor, radius: Tensor, size: int) -> Tensor:
    """Homography `[..., 3, 3]` that takes points of the crop, in pixels of `size` a side, to those of the photograph.

    `camera` `[..., 4, 4]` and `intrinsics` `[..., 3, 3]` are the photograph's, `radius` `[...]` is the effective one.
    """
    turned, _ = turn_towards_centre(camera)
    half = torch.tan(crop_field_of_view(camera[..., :3, 3].norm(dim=-1), radius) / 2)
    # From a pixel of the crop to its ray: half the crop's side is the tangent of half its field of view.
    scale, one = 2 * half / size, torch.ones_like(half)
    rays = torch.diag_embed(torch.stack([scale, scale, one], dim=-1))
    rays[..., :2, 2] = -half[..., None]
    flip = camera.new_tensor([1.0, -1.0, -1.0])  # from OpenGL's axes to OpenCV's
    turn = flip[:, None] * (camera[..., :3, :3].mT @ turned[..., :3, :3]) * flip
    return intrinsics @ turn @ rays


def spherical_camera(camera: Tensor, radius: Tensor) -> Tensor:
    """The camera `[..., 4, 4]` that the crop stands for: spherical, where the real one is but at `radius` `[...]`."""
    pose = view_pose(camera)
    return camera_to_world(torch.cat([pose[..., :2], radius[..., None]], dim=-1))


def project(camera: Tensor, intrinsics: Tensor, points: Tensor) -> Tensor:
    """Pixels `[..., P, 2]` of points `[P, 3]` in the image of a camera `[..., 4, 4]`; infinite or NaN from behind."""
    seen = (inverse(camera) @ torch.cat([points, torch.ones_like(points[:, :1])], dim=-1).mT).mT[..., :3]
    image = (intrinsics @ (seen * seen.new_tensor([1.0, -1.0, -1.0])).mT).mT
    return torch.where(image[..., 2:] > 0, image[..., :2] / image[..., 2:], torch.inf)


def perspective_residual(camera: Tensor, radius: Tensor, points: Tensor) -> Tensor:
    """How far points `[P, 3]` of the object lie in the crop from where the spherical camera that it stands for has
    them: root mean square `[...]`, in units of the image's side; infinite where the photograph's camera is among them.

    0 where the effective radius is the distance.
    """
    turned, _ = turn_towards_centre(camera)
    distance = camera[..., :3, 3].norm(dim=-1)
    crop, virtual = (
        _unit_intrinsics(angle) for angle in (crop_field_of_view(distance, radius), crop_field_of_view(radius, radius))
    )
    offset = project(turned, crop, points) - project(spherical_camera(camera, radius), virtual, points)
    return offset.square().sum(-1).mean(-1).sqrt().nan_to_num(nan=torch.inf, posinf=torch.inf)


def _unit_intrinsics(field_of_view: Tensor) -> Tensor:
    """Intrinsics `[..., 3, 3]` of a square image of side 1 with a field of view `[...]` in radians."""
    focal = (0.5 / torch.tan(field_of_view / 2))[..., None].expand(*field_of_view.shape, 2)
    return _intrinsics(focal, torch.full_like(focal, 0.5))
