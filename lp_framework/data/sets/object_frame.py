"""The frame of an object of which there is no model: from the cameras around it, its silhouettes and its point cloud.

Up is the direction to which the cameras' right axes are closest to perpendicular: photographers hold cameras level.
Centre and longest side are those of the point cloud's box, where there is one that agrees with the silhouettes, else
those of the silhouettes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.errors import UserError
from lp_framework.geometry import camera_to_world, rigid_transform, view_pose

STRAY = 0.01  # share of a cloud's points beyond either side of its box: reconstructions have stray points
POINTS = 20_000  # of a cloud that its box is taken from
FARTHEST_APART, MOST_LARGER = 0.25, 1.5  # of the box of a cloud that agrees with the silhouettes: see `agrees`


class ObjectFrame(NamedTuple):
    """Where an object is in the world: rows `[3, 3]` of its axes (second: up), centre `[3]` and longest side, and the
    `sides` `[3]` of its bounding box in units of the longest."""

    axes: Tensor
    centre: Tensor
    longest_side: Tensor
    sides: Tensor

    def camera(self, camera: Tensor) -> Tensor:
        """A camera `[..., 4, 4]` of the world in the object's frame."""
        place = (self.axes @ (camera[..., :3, 3] - self.centre)[..., None]).squeeze(-1) / self.longest_side
        return rigid_transform(self.axes @ camera[..., :3, :3], place)

    def corners(self) -> Tensor:
        """Corners `[8, 3]` of its bounding box, in the frame."""
        return torch.cartesian_prod(*(torch.stack([-side, side]) / 2 for side in self.sides))

    def agrees(self, other: ObjectFrame) -> bool:
        """Whether another account of the object has its centre no further away than a quarter of the other's longest
        side, and that side no more than half as long again, or shorter by as much."""
        apart = (self.centre - other.centre).norm() / other.longest_side
        larger = self.longest_side / other.longest_side
        return bool(apart <= FARTHEST_APART and 1 / MOST_LARGER <= larger <= MOST_LARGER)


def frame_of_silhouettes(cameras: Tensor, intrinsics: Tensor, pixels: list[NDArray[np.float64]]) -> ObjectFrame:
    """The frame of an object from cameras `[V, 4, 4]` around it, intrinsics `[V, 3, 3]` and pixels `[M, 2]` of the
    outline of its silhouette in each photograph.

    The centre is the point nearest to the lines of sight through the middles of the silhouettes. The height is the
    median of the silhouettes' heights, both widths are nearly the largest of theirs (a 90 % quantile), all at the
    centre's distance. Raises `UserError` where the cameras do not go round the object.
    """
    axes = _axes(cameras)
    rays = [_rays(*each) for each in zip(axes @ cameras[:, :3, :3], intrinsics, pixels, strict=True)]
    places = cameras[:, :3, 3] @ axes.mT
    centre = _nearest_point(places, torch.stack([ray.mean(dim=0) for ray in rays]))
    for _ in range(3):  # the middle of a silhouette is that of a view towards the centre
        turned = camera_to_world(view_pose(rigid_transform(torch.eye(3).to(axes), places - centre)))[:, :3, :3]
        extents = torch.stack([_extent(ray @ turn) for ray, turn in zip(rays, turned, strict=True)])  # [V, 2, 2]
        middle = torch.cat([extents.mean(dim=1), -torch.ones(len(rays), 1).to(axes)], dim=-1)
        centre = _nearest_point(places, (turned @ middle[..., None]).squeeze(-1))
    distances = (places - centre).norm(dim=-1, keepdim=True)
    across, high = ((extents[:, 1] - extents[:, 0]) * distances).unbind(-1)
    sides = torch.stack([across.quantile(0.9), high.median(), across.quantile(0.9)])
    if not sides.max() > 0:
        raise UserError("its cameras stand in the object's centre")
    return ObjectFrame(axes, centre @ axes, sides.max(), sides / sides.max())


def frame_of_points(cameras: Tensor, points: Tensor) -> ObjectFrame:
    """The frame of an object from cameras `[V, 4, 4]` around it and points `[P, 3]` on its surface.

    Its box stands upright, is turned to where it covers the least ground, and leaves out `STRAY` of the points on
    each side. Raises `UserError` where the cameras do not go round the object and where the points have no extent.
    """
    axes = _axes(cameras)
    points = points[torch.linspace(0, len(points) - 1, min(len(points), POINTS)).round().long()]
    turns = [_about_up(math.radians(degrees)) @ axes for degrees in range(90)]
    boxes = [torch.quantile(points @ turned.mT, torch.tensor([STRAY, 1 - STRAY]).to(axes), dim=0) for turned in turns]
    sides = torch.stack([high - low for low, high in boxes])  # [90, 3]
    best = int((sides[:, 0] * sides[:, 2]).argmin())
    longest = sides[best].max()
    if not (longest.isfinite() and longest > 0):
        raise UserError("its point cloud has no extent")
    return ObjectFrame(turns[best], boxes[best].mean(dim=0) @ turns[best], longest, sides[best] / longest)


def _axes(cameras: Tensor) -> Tensor:
    """Rows `[3, 3]` of axes of the world the second of which is up; the horizontal ones are any."""
    right, up = cameras[:, :3, 0], cameras[:, :3, 1]
    spread, directions = torch.linalg.eigh(right.mT @ right / len(right))
    axis = directions[:, 0]
    if spread[1] < 0.02:
        raise UserError("its cameras do not go round the object, so which way is up cannot be told")
    axis = axis * torch.where((up @ axis).mean() < 0, -1.0, 1.0)
    first = torch.linalg.cross(axis, torch.eye(3, dtype=axis.dtype)[axis.abs().argmin()])
    first = first / first.norm()
    return torch.stack([first, axis, torch.linalg.cross(first, axis)])


def _about_up(angle: float) -> Tensor:
    cosine, sine = math.cos(angle), math.sin(angle)
    return torch.tensor([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]], dtype=torch.float64)


def _rays(rotation: Tensor, intrinsics: Tensor, pixels: NDArray[np.float64]) -> Tensor:
    """Directions `[M, 3]` of pixels `[M, 2]`, in the frame of `rotation` `[3, 3]` (camera to world, OpenGL axes)."""
    points = torch.from_numpy(np.concatenate([pixels, np.ones((len(pixels), 1))], axis=-1))
    seen = torch.linalg.solve(intrinsics, points.mT).mT * points.new_tensor([1.0, -1.0, -1.0])
    return seen @ rotation.mT


def _extent(seen: Tensor) -> Tensor:
    """Least and greatest tangent `[2, 2]` (x and y) of directions `[M, 3]` in a camera's axes."""
    tangents = seen[:, :2] / -seen[:, 2:]
    return torch.stack([tangents.amin(dim=0), tangents.amax(dim=0)])


def _nearest_point(places: Tensor, directions: Tensor) -> Tensor:
    """The point `[3]` with the least sum of squared distances from lines through `[V, 3]` along `[V, 3]`."""
    unit = torch.nn.functional.normalize(directions, dim=-1)
    across = torch.eye(3, dtype=unit.dtype) - unit[:, :, None] * unit[:, None, :]
    return torch.linalg.solve(across.sum(dim=0), (across @ places[..., None]).sum(dim=0).squeeze(-1))
