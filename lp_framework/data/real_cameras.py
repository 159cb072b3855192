"""Cameras of photographs, and their conversion to spherical poses with the priors' field of view.

A photograph's camera is a camera-to-world matrix `[..., 4, 4]` (OpenGL axes, see `geometry.spherical`) in the object's
frame (centre of its bounding box at the origin, +Y up, longest side 1), with intrinsics `[..., 3, 3]` in pixels, the
corner of the image at (0, 0) and its first pixel's centre at (0.5, 0.5). docs/data.md explains the conversion: one
homography turns the camera about its own centre and crops the image so that the plane through the object's centre looks
as large as to a camera with the priors' field of view at the *effective radius*.

Without a model of the object, up is the direction most nearly perpendicular to the cameras' right axes, because
photographers hold cameras level; its silhouettes or point cloud give its centre and longest side. A few of many cameras
may be wrong: `fitting_views` and `agreeing_views` identify the consistent ones.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.data.views import FIELD_OF_VIEW_DEGREES
from lp_framework.geometry import camera_to_world, geodesic_angle, inverse, rigid_transform, view_pose

NEAREST_RADIUS, FARTHEST_RADIUS = 1.2, 2.0  # of rendered views; an object's median is mapped to their middle
STRAY = 0.01  # fraction of a cloud's points excluded on each side of its box: reconstructions have outliers
POINTS = 20_000  # of a cloud, used to compute its box
PROJECTED = 2_000  # of a cloud, used to compute its box in a photograph
LEAST_OVERLAP = 0.5  # intersection over union of the boxes of a silhouette and a cloud in a photograph
CANDIDATES = 2_000  # pairs of views whose lines of sight propose the object's centre
FARTHEST_APART = 0.25  # between a silhouette's middle and the projected centre, in longest sides of the silhouette
MOST_LARGER = 3.0  # largest ratio of a silhouette's length at the centre's distance to the median
LEVEL = math.sin(math.radians(5))  # component of a right axis along up; less level cameras have less weight


def from_pytorch3d(rotation: Tensor, translation: Tensor) -> Tensor:
    """Convert PyTorch3D's `R` `[..., 3, 3]` and `T` `[..., 3]` to camera to world `[..., 4, 4]` with OpenGL axes.

    They act on row vectors, X_camera = X_world R + T, with x left, y up and z forward.

    >>> from_pytorch3d(torch.eye(3), torch.tensor([0.0, 0.0, 2.0]))[:3, 3]
    tensor([-0., -0., -2.])
    """
    return inverse(rigid_transform(rotation.mT, translation)) * rotation.new_tensor([-1.0, 1.0, -1.0, 1.0])


def ndc_intrinsics(focal_length: Tensor, principal_point: Tensor, size: tuple[int, int], isotropic: bool) -> Tensor:
    """Convert PyTorch3D's intrinsics `[..., 2]` to `[..., 3, 3]` in pixels, for images of `size` (width, height).

    Its coordinates start at the image centre, x left and y up. If `isotropic`, half the shorter side is 1 (PyTorch3D
    0.5 and later), else half the width and half the height are 1 each.

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
    """Convert a camera `[..., 4, 4]` from a world with +Z up to ours: x, y, z become Z, X, Y.

    A longitude that increases from +X towards +Y there equals ours.

    >>> z_up_to_y_up(rigid_transform(torch.eye(3), torch.tensor([1.0, 2.0, 3.0])))[:3, 3]
    tensor([2., 3., 1.])
    """
    return camera[..., [1, 2, 0, 3], :]


def turn_towards_centre(camera: Tensor) -> tuple[Tensor, Tensor]:
    """Turn a camera `[..., 4, 4]` about its own centre until it is spherical; also returns the angle `[...]` of the
    turn in degrees, including the roll."""
    turned = camera_to_world(view_pose(camera))
    return turned, torch.rad2deg(geodesic_angle(camera[..., :3, :3], turned[..., :3, :3]))


def effective_radii(distances: Tensor) -> Tensor:
    """The radii `[V]` of an object's views from their cameras' distances `[V]` in units of its longest side.

    One factor per object maps the median distance to the middle of the range of rendered views, which preserves ratios
    of distances. Radii outside the range are clipped.

    >>> effective_radii(torch.tensor([6.0, 8.0, 9.0, 20.0, 4.0]))
    tensor([1.2000, 1.6000, 1.8000, 2.0000, 1.2000])
    """
    middle = (NEAREST_RADIUS + FARTHEST_RADIUS) / 2
    return (distances * (middle / distances.median())).clamp(NEAREST_RADIUS, FARTHEST_RADIUS)


def crop_field_of_view(distance: Tensor, radius: Tensor) -> Tensor:
    """Field of view `[...]` in radians of the crop from `distance` that represents a camera at the effective `radius`.

    >>> torch.rad2deg(crop_field_of_view(torch.tensor([1.6, 8.0]), torch.tensor([1.6, 1.6])))
    tensor([49.1000, 10.4397])
    """
    return 2 * torch.atan(radius / distance * math.tan(math.radians(FIELD_OF_VIEW_DEGREES) / 2))


def crop_homography(camera: Tensor, intrinsics: Tensor, radius: Tensor, size: int) -> Tensor:
    """Homography `[..., 3, 3]` from points of the crop, in pixels (`size` per side), to those of the photograph with
    this `camera` `[..., 4, 4]` and `intrinsics` `[..., 3, 3]`; `radius` `[...]` is the effective one."""
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
    """The spherical camera `[..., 4, 4]` that the crop represents, at `radius` `[...]` in the same direction."""
    pose = view_pose(camera)
    return camera_to_world(torch.cat([pose[..., :2], radius[..., None]], dim=-1))


def project(camera: Tensor, intrinsics: Tensor, points: Tensor) -> Tensor:
    """Pixels `[..., P, 2]` of points `[P, 3]` in the image of a camera `[..., 4, 4]`; infinite or NaN from behind."""
    seen = (inverse(camera) @ torch.cat([points, torch.ones_like(points[:, :1])], dim=-1).mT).mT[..., :3]
    image = (intrinsics @ (seen * seen.new_tensor([1.0, -1.0, -1.0])).mT).mT
    return torch.where(image[..., 2:] > 0, image[..., :2] / image[..., 2:], torch.inf)


def perspective_residual(camera: Tensor, radius: Tensor, points: Tensor) -> Tensor:
    """Root mean square distance `[...]`, in units of the image's side, between points `[P, 3]` of the object in the
    crop and in the image of the spherical camera it represents; infinite if that camera is among the points."""
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


class ObjectFrame(NamedTuple):
    """The pose of an object in the world: rows `[3, 3]` of its axes (second: up), centre `[3]` and longest side, and
    the `sides` `[3]` of its bounding box in units of the longest."""

    axes: Tensor
    centre: Tensor
    longest_side: Tensor
    sides: Tensor

    def camera(self, camera: Tensor) -> Tensor:
        """Transform a camera `[..., 4, 4]` from the world to the object's frame."""
        place = (self.axes @ (camera[..., :3, 3] - self.centre)[..., None]).squeeze(-1) / self.longest_side
        return rigid_transform(self.axes @ camera[..., :3, :3], place)

    def corners(self) -> Tensor:
        """Corners `[8, 3]` of its bounding box, in the frame."""
        return torch.cartesian_prod(*(torch.stack([-side, side]) / 2 for side in self.sides))


def fitting_views(cameras: Tensor, intrinsics: Tensor, pixels: list[NDArray[np.float64]], points: Tensor) -> Tensor:
    """Which views `[V]` (bool) have silhouettes that match the points `[P, 3]` on the object's surface; the other
    arguments are those of `frame_of_silhouettes`."""
    points = _some(points, PROJECTED)
    stray = torch.tensor([STRAY, 1 - STRAY]).to(points)
    cloud = torch.stack([torch.quantile(seen, stray, dim=0) for seen in project(cameras, intrinsics, points)])
    shown = _boxes(pixels)
    common = torch.minimum(cloud[:, 1], shown[:, 1]) - torch.maximum(cloud[:, 0], shown[:, 0])
    intersection = common.clamp(min=0).prod(dim=-1)
    areas = (cloud[:, 1] - cloud[:, 0]).prod(dim=-1) + (shown[:, 1] - shown[:, 0]).prod(dim=-1)
    return intersection >= LEAST_OVERLAP * (areas - intersection)  # false for NaN, from points behind the camera


def agreeing_views(cameras: Tensor, intrinsics: Tensor, pixels: list[NDArray[np.float64]]) -> Tensor:
    """Which views `[V]` (bool) agree on one point near the middle of their silhouettes and on the object's approximate
    length; the arguments are those of `frame_of_silhouettes`.

    Each pair of lines of sight through the middles proposes the point nearest to both; the one that most views agree on
    is used.
    """
    boxes = _boxes(pixels)
    middles, lengths = boxes.mean(dim=1), (boxes[:, 1] - boxes[:, 0]).amax(dim=-1)
    rays = _rays(cameras[:, :3, :3], intrinsics, middles[:, None])[:, 0]
    pairs = _some(torch.combinations(torch.arange(len(cameras))), CANDIDATES)
    points = _nearest_point(cameras[pairs, :3, 3], rays[pairs])
    offsets = (project(cameras, intrinsics, points) - middles[:, None]).norm(dim=-1)  # [V, P]
    agreed = offsets <= FARTHEST_APART * lengths[:, None]
    best = int(agreed.sum(dim=0).argmax())
    distances = (cameras[:, :3, 3] - points[best]).norm(dim=-1)
    sizes = lengths * distances / intrinsics[:, 0, 0]
    larger = sizes / sizes[agreed[:, best]].median()
    return agreed[:, best] & (larger <= MOST_LARGER) & (larger >= 1 / MOST_LARGER)


def _boxes(pixels: list[NDArray[np.float64]]) -> Tensor:
    """Minimum and maximum pixels `[V, 2, 2]` of silhouettes."""
    return torch.from_numpy(np.stack([np.stack([each.min(axis=0), each.max(axis=0)]) for each in pixels]))


def _some(rows: Tensor, count: int) -> Tensor:
    """At most `count` evenly spaced rows, from first to last."""
    return rows[torch.linspace(0, len(rows) - 1, min(len(rows), count)).round().long()]


def frame_of_silhouettes(cameras: Tensor, intrinsics: Tensor, pixels: list[NDArray[np.float64]]) -> ObjectFrame:
    """The frame of an object from cameras `[V, 4, 4]` around it, intrinsics `[V, 3, 3]` and pixels `[M, 2]` of the
    outline of its silhouette in each photograph.

    The centre is the point nearest to the lines of sight through the middles of the silhouettes. The height is the
    median of the silhouettes' heights; both widths are the 90 % quantile of their widths, nearly the largest; all at
    the centre's distance. Raises `ValueError` if the cameras do not go around the object.
    """
    axes = _axes(cameras)
    outlines = map(torch.from_numpy, pixels)
    rays = [_rays(*each) for each in zip(axes @ cameras[:, :3, :3], intrinsics, outlines, strict=True)]
    places = cameras[:, :3, 3] @ axes.mT
    centre = _nearest_point(places, torch.stack([ray.mean(dim=0) for ray in rays]))
    for _ in range(3):  # the middle of a silhouette is defined in a view towards the centre
        turned = camera_to_world(view_pose(rigid_transform(torch.eye(3).to(axes), places - centre)))[:, :3, :3]
        seen = [ray @ turn for ray, turn in zip(rays, turned, strict=True)]
        tangents = [each[:, :2] / -each[:, 2:] for each in seen]
        extents = torch.stack([torch.stack([each.amin(dim=0), each.amax(dim=0)]) for each in tangents])  # [V, 2, 2]
        middle = torch.cat([extents.mean(dim=1), -torch.ones(len(rays), 1).to(axes)], dim=-1)
        centre = _nearest_point(places, (turned @ middle[..., None]).squeeze(-1))
    distances = (places - centre).norm(dim=-1, keepdim=True)
    across, high = ((extents[:, 1] - extents[:, 0]) * distances).unbind(-1)
    sides = torch.stack([across.quantile(0.9), high.median(), across.quantile(0.9)])
    if not sides.max() > 0:
        raise ValueError("its cameras are at the object's centre")
    return ObjectFrame(axes, centre @ axes, sides.max(), sides / sides.max())


def frame_of_points(cameras: Tensor, points: Tensor) -> ObjectFrame:
    """The frame of an object from cameras `[V, 4, 4]` around it and points `[P, 3]` on its surface.

    Its box is upright, has the orientation with the smallest ground area, and excludes `STRAY` of the points on each
    side. Raises `ValueError` if the cameras do not go around the object or the points have no extent.
    """
    axes = _axes(cameras)
    points = _some(points, POINTS)
    turns = [_about_up(math.radians(degrees)) @ axes for degrees in range(90)]
    boxes = [torch.quantile(points @ turned.mT, torch.tensor([STRAY, 1 - STRAY]).to(axes), dim=0) for turned in turns]
    sides = torch.stack([high - low for low, high in boxes])  # [90, 3]
    best = int((sides[:, 0] * sides[:, 2]).argmin())
    longest = sides[best].max()
    if not (longest.isfinite() and longest > 0):
        raise ValueError("its point cloud has no extent")
    return ObjectFrame(turns[best], boxes[best].mean(dim=0) @ turns[best], longest, sides[best] / longest)


def _axes(cameras: Tensor) -> Tensor:
    """Rows `[3, 3]` of axes of the world, the second of which is up; the horizontal ones are arbitrary."""
    right, up = cameras[:, :3, 0], cameras[:, :3, 1]
    weights = torch.ones_like(right[:, :1])
    for _ in range(10):  # least squares for nearly level cameras, least absolute values for others
        spread, directions = torch.linalg.eigh(right.mT @ (weights * right) / weights.sum())
        axis = directions[:, 0]
        weights = LEVEL / (right @ axis[:, None]).abs().clamp(min=LEVEL)
    if spread[1] < 0.02:
        raise ValueError("its cameras do not go around the object, so its up direction cannot be determined")
    axis = axis * torch.where((up @ axis).mean() < 0, -1.0, 1.0)
    first = torch.linalg.cross(axis, torch.eye(3, dtype=axis.dtype)[axis.abs().argmin()])
    first = first / first.norm()
    return torch.stack([first, axis, torch.linalg.cross(first, axis)])


def _about_up(angle: float) -> Tensor:
    cosine, sine = math.cos(angle), math.sin(angle)
    return torch.tensor([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]], dtype=torch.float64)


def _rays(rotation: Tensor, intrinsics: Tensor, pixels: Tensor) -> Tensor:
    """Directions `[..., M, 3]` of pixels `[..., M, 2]`, in the frame of `rotation` `[..., 3, 3]` (camera to world)."""
    points = torch.cat([pixels, torch.ones_like(pixels[..., :1])], dim=-1)
    seen = torch.linalg.solve(intrinsics, points.mT).mT * points.new_tensor([1.0, -1.0, -1.0])
    return seen @ rotation.mT


def _nearest_point(places: Tensor, directions: Tensor) -> Tensor:
    """The point `[..., 3]` with the least sum of squared distances from lines through `[..., V, 3]` along
    `[..., V, 3]`; any of them if it is not unique."""
    unit = torch.nn.functional.normalize(directions, dim=-1)
    across = torch.eye(3, dtype=unit.dtype) - unit[..., :, None] * unit[..., None, :]
    sums = across.sum(dim=-3), (across @ places[..., None]).sum(dim=-3)
    return (torch.linalg.pinv(sums[0], hermitian=True) @ sums[1]).squeeze(-1)
