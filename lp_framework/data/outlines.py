"""Positions of cameras with known rotations, from the outlines of an object in their images.

The middle of an outline serves as the object's centre, but it is a different point of the object in every image.
However, the planes through two cameras that touch the object touch its outlines in both images (epipolar tangency:
Wong & Cipolla, Structure and Motion from Silhouettes, 2001), and this determines the cameras' relative positions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import ConvexHull
from trimesh.util import unitize

CORNERS = 64  # of an outline's convex hull
WIDEST = 2.5  # radians between the two touching planes of a pair; at pi they coincide, and nothing can be compared
NEAREST = 0.05  # distance between two cameras, relative to their distance from the object
MOST_PAIRS = 500  # of cameras that are compared; with many cameras, more pairs only cost time
LARGEST = 0.2  # shift; larger ones mean that the rotations are wrong
REGULARIZATION = 0.1  # weight of the shifts, which determines what the outlines leave open


def convex_outline(opaque: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Corners `[CORNERS, 2]` (column, row) of the convex hull of an image's opaque pixels `[H, W]`; some may repeat."""
    rows, columns = np.nonzero(opaque)
    corners = np.concatenate([np.stack([columns + x, rows + y], axis=-1) for x in (0.0, 1.0) for y in (0.0, 1.0)])
    hull = corners[ConvexHull(corners).vertices]
    return hull[np.linspace(0, len(hull) - 1, CORNERS).round().astype(int)]


def match_outlines(cameras: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shift cameras to world `[V, 4, 4]` (OpenGL axes), which look at an object around the origin, until its outlines
    match; rotations stay. `rays` `[V, K, 3]` point from each camera, in its axes, to K corners of the outline.

    A shift moves a camera in its image plane and changes its distance, each by up to `LARGEST` of the distance. What
    the outlines leave open, above all the position of the object as a whole, stays as close as possible.
    """
    rotations, directions = cameras[:, :3, :3], np.einsum("vij,vkj->vki", cameras[:, :3, :3], rays)
    origins = -np.einsum("vji,vj->vi", rotations, cameras[:, :3, 3])  # in the cameras' axes
    pairs = _comparable_pairs(cameras[:, :3, 3], directions)

    def positions(shifts: NDArray[np.float64]) -> NDArray[np.float64]:
        sideways, distance = np.split(shifts.reshape(-1, 3), [2], axis=1)
        moved = (origins - origins[:, 2:] * np.pad(sideways, ((0, 0), (0, 1)))) * np.exp(distance)
        return -np.einsum("vij,vj->vi", rotations, moved)

    def residuals(shifts: NDArray[np.float64]) -> NDArray[np.float64]:
        sides = _touching_planes(positions(shifts), directions, pairs)
        return np.concatenate([(sides[:, 0] - sides[:, 1]).ravel(), REGULARIZATION * shifts])

    found = least_squares(residuals, np.zeros(3 * len(cameras)), bounds=(-LARGEST, LARGEST), x_scale=0.05)
    result = cameras.copy()
    result[:, :3, 3] = positions(found.x)
    return result


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
