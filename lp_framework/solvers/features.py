"""Local features, matched, and the essential matrix: what a user without a prior or a model would try first."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.errors import UserError, check_settings, optional_import
from lp_framework.geometry import from_opencv, inverse
from lp_framework.keyed_random import keyed_bits
from lp_framework.registry import register
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.matchers import Learned, Matcher, Matches, Sift
from lp_framework.solvers.relative_cameras import RelativeCameraSolver

MINIMAL = 5  # matches that fix an essential matrix


@register("solver", "features")
class Features(RelativeCameraSolver):
    """Matched local features and their essential matrix; one answer a pair, or none.

    Matches come from SIFT, with the ratio test at `ratio` and mutual, or from a learned matcher with `weights` of its
    own (a folder or a hub id; by default the published ones, downloaded). The essential matrix is that of PoseLib's
    LO-RANSAC, refined on its inliers, those within `tolerance_pixels` of their epipolar lines, for square images with a
    field of view of `field_of_view_degrees`. With fewer than `fewest_inliers` of them there is no answer. Matches that
    have mostly not moved by more than `tolerance_pixels` say that both images are from the same place, where an
    essential matrix says nothing.

    The energy of an answer is the share of matches that do not fit it. RANSAC draws by seed and pair. See
    `RelativeCameraSolver` for `reference_radius` and the cameras; starts are ignored.
    """

    def __init__(
        self,
        matcher: Literal["sift", "lightglue", "efficientloftr"] = "sift",
        weights: str | None = None,
        ratio: float = 0.8,
        tolerance_pixels: float = 1.0,
        fewest_inliers: int = 15,
        field_of_view_degrees: float = 49.1,
        reference_radius: float = 1.4,
    ) -> None:
        super().__init__(reference_radius)
        check_settings(
            "solver",
            ("ratio", ratio, 0 < ratio <= 1, "in (0, 1]"),
            ("tolerance_pixels", tolerance_pixels, tolerance_pixels > 0, "positive"),
            ("fewest_inliers", fewest_inliers, fewest_inliers >= MINIMAL, f"at least {MINIMAL}"),
            ("field_of_view_degrees", field_of_view_degrees, 0 < field_of_view_degrees < 180, "between 0 and 180"),
        )
        if matcher == "sift" and weights is not None:
            raise UserError(f"solver.matcher=sift has no weights, got solver.weights={weights}")
        self.poselib = optional_import("poselib", "solver=features", "pip install 'lp_framework[features]'")
        self.matcher: Matcher = Sift(ratio) if matcher == "sift" else Learned(matcher, weights)
        self.network = self.matcher.network  # where those look who move it to a device
        self.tolerance, self.fewest_inliers = tolerance_pixels, fewest_inliers
        self.field_of_view = math.radians(field_of_view_degrees)

    def predict(self, pairs: Pairs, seed: int) -> tuple[Tensor, Tensor, int]:
        height, width = pairs.images.shape[-2:]
        if height != width:
            raise UserError(f"solver=features takes square images, got {height} x {width} pixels")
        views = torch.cat([pairs.reference, pairs.query]).unique().tolist()
        seen = {view: self.matcher.describe(pairs.images[view]) for view in views}
        draws = keyed_bits(seed, pairs.ids, count=1)[:, 0] & 0x7FFFFFFF
        cameras = torch.full((len(pairs), 4, 4), torch.nan, dtype=torch.float64)
        energies = torch.full((len(pairs),), torch.nan, dtype=torch.float64)
        problems = torch.stack([pairs.reference.cpu(), pairs.query.cpu(), draws], dim=1).tolist()
        for number, (reference, query, draw) in enumerate(problems):
            matches = self.matcher.match(seen[reference], seen[query])
            found = self.relative_camera(matches, width, draw)
            if found is not None:
                cameras[number], energies[number] = torch.from_numpy(found[0]), found[1]
        flip = from_opencv(torch.eye(4, dtype=torch.float64))
        return flip @ from_opencv(cameras), energies, 0 if self.network is None else len(pairs)

    def relative_camera(self, matches: Matches, width: int, seed: int) -> tuple[NDArray[np.float64], float] | None:
        """The query's camera in the reference's frame, `[4, 4]` with OpenCV's axes and a translation of length 1, and
        the share of matches that do not fit it; None where there are too few.

        Where the camera has not moved it is the identity.
        """
        count = len(matches.reference)
        if count < self.fewest_inliers:
            return None
        moved = np.linalg.norm(matches.query - matches.reference, axis=1)
        if np.median(moved) <= self.tolerance:
            return np.eye(4), float((moved > self.tolerance).mean())
        focal = width / 2 / math.tan(self.field_of_view / 2)
        centre = (width - 1) / 2  # (0, 0) is the centre of the first pixel
        camera = {"model": "SIMPLE_PINHOLE", "width": width, "height": width, "params": [focal, centre, centre]}
        settings = {"max_epipolar_error": self.tolerance, "seed": seed}
        pose, report = self.poselib.estimate_relative_pose(matches.reference, matches.query, camera, camera, settings)
        if report["num_inliers"] < self.fewest_inliers:
            return None
        to_query = np.eye(4)
        to_query[:3, :3], to_query[:3, 3] = pose.R, pose.t / np.linalg.norm(pose.t)
        return inverse(torch.from_numpy(to_query)).numpy(), 1 - report["num_inliers"] / count
