"""Cameras with known latitudes and longitudes, from the outlines of an object in their images.

The middle of an outline serves as the object's centre, but it is a different point of the object in every image.
However, the planes through two cameras that touch the object touch its outlines in both images (epipolar tangency:
Wong & Cipolla, Structure and Motion from Silhouettes, 2001). This determines where in each image the centre is, and how
far away, the better the more images there are.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import ConvexHull
from trimesh.util import unitize

from lp_framework.geometry import level_camera, view_pose

CORNERS = 64  # of an outline's convex hull
WIDEST = 2.5  # radians between the two touching planes of a pair; at pi they coincide, and nothing can be compared
NEAREST = 0.05  # distance between two cameras, relative to their distance from the object
MOST_PAIRS = 500  # of cameras that are compared; with many cameras, more pairs only cost time
LARGEST = 0.5  # shift; larger ones mean that the poses are wrong
SPREAD = (0.0125, 0.0125, 0.065)  # standard deviations of shifts for exact poses (the twelve embedded objects)
ERRORS = 0.004, 0.0005  # radians, of the angles of touching planes: the first assumption and the least


def convex_outline(opaque: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Corners `[CORNERS, 2]` (column, row) of the convex hull of an image's opaque pixels `[H, W]`; some may repeat."""
    rows, columns = np.nonzero(opaque)
    corners = np.concatenate([np.stack([columns + x, rows + y], axis=-1) for x in (0.0, 1.0) for y in (0.0, 1.0)])
    hull = corners[ConvexHull(corners).vertices]
    return hull[np.linspace(0, len(hull) - 1, CORNERS).round().astype(int)]


def match_outlines(cameras: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shift the point at which level cameras to world `[V, 4, 4]` (OpenGL axes) see the origin, and its distance, until
    the outlines of the object there match. `rays` `[V, K, 3]` point from each camera, in its axes, to K corners of the
    outline.

    A camera stays level at its latitude and longitude. Shifts are regularized by their typical size, in relation to the
    error with which the outlines match in the end, so that wrong poses do not cause large shifts.
    """
    places = view_pose(torch.from_numpy(cameras))
    origins = -np.einsum("vji,vj->vi", cameras[:, :3, :3], cameras[:, :3, 3])  # in the cameras' axes
    pairs = _comparable_pairs(cameras[:, :3, 3], np.einsum("vij,vkj->vki", cameras[:, :3, :3], rays))

    def shifted(shifts: NDArray[np.float64]) -> NDArray[np.float64]:
        sideways, distance = np.split(shifts.reshape(-1, 3), [2], axis=1)
        seen = (origins - origins[:, 2:] * np.pad(sideways, ((0, 0), (0, 1)))) * np.exp(distance)
        radii = np.linalg.norm(seen, axis=-1, keepdims=True)
        return level_camera(torch.cat([places[:, :2], torch.from_numpy(radii)], dim=-1), torch.from_numpy(seen)).numpy()

    def differences(shifts: NDArray[np.float64]) -> NDArray[np.float64]:
        moved = shifted(shifts)
        sides = _touching_planes(moved[:, :3, 3], np.einsum("vij,vkj->vki", moved[:, :3, :3], rays), pairs)
        return (sides[:, 0] - sides[:, 1]).ravel()

    def residuals(shifts: NDArray[np.float64], error: float) -> NDArray[np.float64]:
        return np.concatenate([differences(shifts) / error, (shifts.reshape(-1, 3) / SPREAD).ravel()])

    shifts, error = np.zeros(3 * len(cameras)), ERRORS[0]
    for _ in range(2 if len(pairs) else 0):  # the second time with the error that the first leaves
        shifts = least_squares(residuals, shifts, bounds=(-LARGEST, LARGEST), x_scale=0.05, args=(error,)).x
        error = max(ERRORS[1], float(np.sqrt(np.mean(differences(shifts) ** 2))))
    return shifted(shifts)


def _touching_planes(
    centres: NDArray[np.float64], directions: NDArray[np.float64], pairs: NDArray[np.intp]
) -> NDArray[np.float64]:
    """The planes through pairs `[P, 2]` of cameras at `centres` `[V, 3]` that touch the outlines with `directions`
    `[V, K, 3]`: angles `[P, 2 (images), 2 (sides)]` about the baseline, 0 through the origin."""
    first, second = centres[pairs.T]
    baseline = unitize(second - first)
    inward = unitize((first * baseline).sum(axis=-1, keepdims=True) * baseline - first)
    axes = np.stack([inward, np.cross(baseline, inward)], axis=-1)
    towards, across = np.moveaxis(directions[pairs] @ axes[:, None], -1, 0)
    angles = np.arctan2(across, towards)
    return np.stack([angles.min(axis=-1), angles.max(axis=-1)], axis=-1)


def _comparable_pairs(centres: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.intp]:
    """Up to `MOST_PAIRS` pairs of cameras `[P, 2]` whose touching planes are well defined."""
    pairs = np.stack(np.triu_indices(len(centres), k=1), axis=-1)
    first, second = centres[pairs.T]
    apart = np.linalg.norm(second - first, axis=-1) > NEAREST * np.linalg.norm(first, axis=-1)
    angles = np.ptp(_touching_planes(centres, directions, pairs), axis=-1)
    pairs = pairs[apart & (angles.max(axis=-1) < WIDEST)]
    return pairs[np.linspace(0, len(pairs) - 1, min(len(pairs), MOST_PAIRS)).round().astype(int)]
