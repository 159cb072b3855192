"""Local feature matching and the essential matrix: a baseline that needs neither a prior nor a model."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes
from torch import Tensor, nn

from lp_framework.data.views import FIELD_OF_VIEW_DEGREES
from lp_framework.errors import UserError, at_least, check_settings, optional_import, positive
from lp_framework.geometry import from_opencv, inverse
from lp_framework.keyed_random import keyed_bits
from lp_framework.registry import register
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.feed_forward import RelativeCameraSolver, with_weights

INSTALL = "pip install 'lp_framework[features]'"
MINIMAL = 5  # matches that determine an essential matrix
WEIGHTS = {  # hub ids of the learned matchers' published weights
    "lightglue": "ETH-CVG/lightglue_superpoint",
    "efficientloftr": "zju-community/efficientloftr",
}
SIDE = 640  # input size of the learned matchers in pixels; a multiple of 32, as EfficientLoFTR requires
FINER = 64  # the processors round to whole pixels of the size passed to them; this makes it 1/64 of a pixel
WHITE = 0.98  # in [-1, 1]: a pixel darker than this in any channel belongs to the object


@register("solver", "features")
class Features(RelativeCameraSolver):
    """Matched local features and their essential matrix; at most one answer per pair.

    PoseLib's LO-RANSAC (keyed by seed and pair) estimates the essential matrix and refines it on the inliers. Images
    must be square; each has its own field of view, or all have `field_of_view_degrees`. There is no answer with fewer
    than `fewest_inliers` inliers. If most matches move by at most `tolerance_pixels`, both cameras are taken to be at
    the same place. The energy is the share of outliers among the matches.
    """

    def __init__(
        self,
        matcher: Literal["sift", "lightglue", "efficientloftr"] = "sift",
        weights: str | None = None,
        ratio: float = 0.8,
        tolerance_pixels: float = 1.0,
        fewest_inliers: int = 15,
        field_of_view_degrees: float | None = None,
        reference_radius: float = 1.4,
    ) -> None:
        super().__init__(reference_radius)
        at_least(MINIMAL, "solver", fewest_inliers=fewest_inliers)
        positive("solver", tolerance_pixels=tolerance_pixels)
        angle = field_of_view_degrees
        check_settings(
            "solver",
            ("ratio", ratio, 0 < ratio <= 1, "in (0, 1]"),
            ("field_of_view_degrees", angle, angle is None or 0 < angle < 180, "between 0 and 180"),
        )
        if matcher == "sift" and weights is not None:
            raise UserError(f"solver.matcher=sift has no weights, got solver.weights={weights}")
        self.poselib = optional_import("poselib", "solver=features", INSTALL)
        self.matcher = Sift(ratio) if matcher == "sift" else Learned(matcher, weights)
        self.network = self.matcher.network  # an attribute, so that it is moved to the device
        self.tolerance, self.fewest_inliers = tolerance_pixels, fewest_inliers
        self.field_of_view_degrees = field_of_view_degrees

    def predict(self, pairs: Pairs, seed: int) -> tuple[Tensor, Tensor, int]:
        height, width = pairs.images.shape[-2:]
        if height != width:
            raise UserError(f"solver=features takes square images, got {height} x {width} pixels")
        focal = self.focal_lengths(pairs)
        views = torch.cat([pairs.reference, pairs.query]).unique().tolist()
        seen = {view: self.matcher.describe(pairs.images[view]) for view in views}
        draws = keyed_bits(seed, pairs.ids, count=1)[:, 0] & 0x7FFFFFFF
        cameras = torch.full((len(pairs), 4, 4), torch.nan, dtype=torch.float64)
        energies = torch.full((len(pairs),), torch.nan, dtype=torch.float64)
        problems = torch.stack([pairs.reference.cpu(), pairs.query.cpu(), draws], dim=1).tolist()
        for number, (reference, query, draw) in enumerate(problems):
            matches = self.matcher.match(seen[reference], seen[query])
            found = self.relative_camera(matches, width, (focal[reference], focal[query]), draw)
            if found is not None:
                cameras[number], energies[number] = torch.from_numpy(found[0]), found[1]
        flip = from_opencv(torch.eye(4, dtype=torch.float64))
        return flip @ from_opencv(cameras), energies, 0 if self.network is None else len(pairs)

    def focal_lengths(self, pairs: Pairs) -> list[float]:
        """Focal length of each image in pixels."""
        angles = pairs.field_of_view
        if angles is None or self.field_of_view_degrees is not None:
            degrees = self.field_of_view_degrees or FIELD_OF_VIEW_DEGREES
            angles = torch.full((len(pairs.images),), math.radians(degrees), dtype=torch.float64)
        lengths: list[float] = (pairs.images.shape[-1] / 2 / torch.tan(angles / 2)).tolist()
        return lengths

    def relative_camera(
        self, matches: Matches, width: int, focal: tuple[float, float], seed: int
    ) -> tuple[NDArray[np.float64], float] | None:
        """The query's camera in the reference's frame, `[4, 4]` with OpenCV axes and a translation of length 1 (0 if
        the camera did not move), and the share of outliers; None if there are too few matches or inliers. `focal`
        holds the focal lengths of reference and query in pixels."""
        count = len(matches.reference)
        if count < self.fewest_inliers:
            return None
        centre = (width - 1) / 2  # (0, 0) is the centre of the first pixel
        seen = centre + (matches.query - centre) * (focal[0] / focal[1])  # at the reference's focal length
        moved = np.linalg.norm(seen - matches.reference, axis=1)
        if np.median(moved) <= self.tolerance:
            return np.eye(4), float((moved > self.tolerance).mean())
        cameras = [
            {"model": "SIMPLE_PINHOLE", "width": width, "height": width, "params": [each, centre, centre]}
            for each in focal
        ]
        settings = {"max_epipolar_error": self.tolerance, "seed": seed}
        pose, report = self.poselib.estimate_relative_pose(*matches, *cameras, settings)
        if report["num_inliers"] < self.fewest_inliers:
            return None
        to_query = np.eye(4)
        to_query[:3, :3], to_query[:3, 3] = pose.R, pose.t / np.linalg.norm(pose.t)
        return inverse(torch.from_numpy(to_query)).numpy(), 1 - report["num_inliers"] / count


class Matches(NamedTuple):
    """M corresponding points in the reference and the query image, `[M, 2]` each: x to the right and y down in pixels,
    with (0, 0) at the centre of the first pixel."""

    reference: NDArray[np.float64]
    query: NDArray[np.float64]


class Sift:
    """OpenCV's SIFT (Lowe 2004) on the object, with mutual nearest neighbours as matches that pass the ratio test:
    distance at most `ratio` times that of the second nearest."""

    network = None

    def __init__(self, ratio: float) -> None:
        self.cv2, self.ratio = optional_import("cv2", "solver=features", INSTALL), ratio
        self.sift = self.cv2.SIFT_create(enable_precise_upscale=True)  # otherwise points are off by 1/4 pixel
        self.nearest = self.cv2.BFMatcher(self.cv2.NORM_L2)

    def describe(self, image: Tensor) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Points `[K, 2]` and descriptors `[K, 128]` of an image `[3, H, W]` in [-1, 1] on white."""
        grey = self.cv2.cvtColor(pixels(image), self.cv2.COLOR_RGB2GRAY)
        points, descriptors = self.sift.detectAndCompute(grey, foreground(image).astype(np.uint8))
        places = np.array([point.pt for point in points], dtype=np.float64).reshape(-1, 2)
        return places, np.zeros((0, 128), np.float32) if descriptors is None else descriptors

    def match(self, reference: Any, query: Any) -> Matches:
        """Match two described images."""
        forth, back = self._pairs(reference[1], query[1]), self._pairs(query[1], reference[1])
        mutual = [(first, second) for first, second in forth.items() if back.get(second) == first]
        first, second = np.array(mutual, dtype=int).reshape(-1, 2).T
        return Matches(reference[0][first], query[0][second])

    def _pairs(self, source: NDArray[np.float32], target: NDArray[np.float32]) -> dict[int, int]:
        """Map each source descriptor that passes the ratio test to its nearest neighbour among the target ones."""
        if len(target) < 2:
            return {}
        two = self.nearest.knnMatch(source, target, k=2)
        return {near.queryIdx: near.trainIdx for near, far in two if near.distance < self.ratio * far.distance}


class Learned:
    """A keypoint matcher from `transformers`: LightGlue on SuperPoint (2023) or EfficientLoFTR (2024)."""

    network: nn.Module

    def __init__(self, name: str, weights: str | None) -> None:
        library = optional_import("transformers", f"solver.matcher={name}", "pip install 'transformers>=4.54'")

        def load(source: str) -> tuple[Any, nn.Module]:
            network = library.AutoModelForKeypointMatching.from_pretrained(source)
            return library.AutoImageProcessor.from_pretrained(source), network

        self.processor, self.network = with_weights(load, name, weights or WEIGHTS[name])
        self.network.eval().requires_grad_(False)

    def describe(self, image: Tensor) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Pixels `[H, W, 3]` and object mask `[H, W]` of an image `[3, H, W]` in [-1, 1] on white."""
        return pixels(image), foreground(image)

    @torch.no_grad()
    def match(self, reference: Any, query: Any) -> Matches:
        """Match two described images, on the object only."""
        images = [reference[0], query[0]]
        inputs = self.processor([images], size={"height": SIDE, "width": SIDE}, return_tensors="pt")
        outputs = self.network(**inputs.to(next(self.network.parameters()).device))
        sizes = [[tuple(FINER * side for side in image.shape[:2]) for image in images]]
        # The threshold is the lowest score that EfficientLoFTR's own settings keep.
        (found,) = self.processor.post_process_keypoint_matching(outputs, sizes, threshold=0.2)
        ends, on_object = [], np.ones(len(found["keypoints0"]), dtype=bool)
        for key, (image, mask) in (("keypoints0", reference), ("keypoints1", query)):
            size = np.array(image.shape[1::-1])  # at SIDE, too, (0, 0) is the centre of the first pixel
            points = found[key].cpu().double().numpy() / FINER + size / (2 * SIDE) - 0.5
            column, row = np.rint(points).astype(int).clip(0, size - 1).T
            on_object &= mask[row, column]
            ends.append(points)
        return Matches(ends[0][on_object], ends[1][on_object])


def foreground(image: Tensor) -> NDArray[np.bool_]:
    """Object mask `[H, W]` of an image `[3, H, W]` on white: all non-white pixels, with holes filled."""
    return np.asarray(binary_fill_holes((image.amin(dim=0) < WHITE).cpu().numpy()))


def pixels(image: Tensor) -> NDArray[np.uint8]:
    """Pixels `[H, W, 3]` of an image `[3, H, W]` in [-1, 1]."""
    levels = ((image.float() + 1) * 127.5).round().clamp(0, 255).byte()
    return np.ascontiguousarray(levels.permute(1, 2, 0).cpu().numpy())
