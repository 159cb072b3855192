"""Points of two images that show the same place: SIFT, and learned matchers from transformers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes
from torch import Tensor, nn

from lp_framework.errors import UserError, optional_import

WEIGHTS = {  # hub ids of the learned matchers' published weights
    "lightglue": "ETH-CVG/lightglue_superpoint",
    "efficientloftr": "zju-community/efficientloftr",
}
SIDE = 640  # pixels of the images that learned matchers see; a multiple of 32, which EfficientLoFTR needs
FINER = 64  # the processors round to whole pixels of the size that they are told; so to 1/64 of an image's
WHITE = 0.98  # of [-1, 1]: what is darker in some channel is the object's


class Matches(NamedTuple):
    """M points in the reference and the query image, `[M, 2]` each: x to the right and y down in pixels, (0, 0) the
    centre of the first one."""

    reference: NDArray[np.float64]
    query: NDArray[np.float64]

    def within(self, *masks: NDArray[np.bool_]) -> Matches:
        """Those whose points lie on the objects, given where these are in reference and query, `[H, W]` each."""
        kept = np.ones(len(self.reference), dtype=bool)
        for points, mask in zip(self, masks, strict=True):
            column, row = np.rint(points).astype(int).T
            kept &= mask[row.clip(0, mask.shape[0] - 1), column.clip(0, mask.shape[1] - 1)]
        return Matches(self.reference[kept], self.query[kept])


class Matcher(ABC):
    """Describes every image once, then matches descriptions. `network` is the network, if it has one."""

    network: nn.Module | None = None

    @abstractmethod
    def describe(self, image: Tensor) -> Any:
        """What matching needs of an image `[3, H, W]` in [-1, 1] on white."""

    @abstractmethod
    def match(self, reference: Any, query: Any) -> Matches:
        """Matches on the objects of two described images."""


def weights_error(network: str, source: str, error: Exception) -> UserError:
    """What to raise where the weights of a network could not be loaded."""
    reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
    return UserError(
        f"{source}: the weights of {network} cannot be had from there ({reason}); "
        "give solver.weights= a local path or an id of the Hugging Face hub"
    )


def foreground(image: Tensor) -> NDArray[np.bool_]:
    """Where the object is, `[H, W]`, in an image `[3, H, W]` on white: what is not white, and white within it."""
    filled: NDArray[np.bool_] = binary_fill_holes((image.amin(dim=0) < WHITE).cpu().numpy())
    return filled


def pixels(image: Tensor) -> NDArray[np.uint8]:
    """Pixels `[H, W, 3]` of an image `[3, H, W]` in [-1, 1]."""
    levels = ((image.float() + 1) * 127.5).round().clamp(0, 255).byte()
    return np.ascontiguousarray(levels.permute(1, 2, 0).cpu().numpy())


class Sift(Matcher):
    """SIFT of OpenCV (Lowe 2004) within the object, matched where nearest both ways and clearly nearer than the next.

    `ratio` is the largest share that the distance of the nearest descriptor may be of the second nearest's.
    """

    def __init__(self, ratio: float) -> None:
        self.cv2 = optional_import("cv2", "solver=features", "pip install 'lp_framework[features]'")
        self.ratio = ratio
        self.sift = self.cv2.SIFT_create(enable_precise_upscale=True)  # else points are off by a quarter of a pixel
        self.nearest = self.cv2.BFMatcher(self.cv2.NORM_L2)

    def describe(self, image: Tensor) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Points `[K, 2]` and descriptors `[K, 128]`."""
        grey = self.cv2.cvtColor(pixels(image), self.cv2.COLOR_RGB2GRAY)
        points, descriptors = self.sift.detectAndCompute(grey, foreground(image).astype(np.uint8))
        places = np.array([point.pt for point in points], dtype=np.float64).reshape(-1, 2)
        return places, np.zeros((0, 128), np.float32) if descriptors is None else descriptors

    def match(self, reference: Any, query: Any) -> Matches:
        forth, back = self._pairs(reference[1], query[1]), self._pairs(query[1], reference[1])
        mutual = [(first, second) for first, second in forth.items() if back.get(second) == first]
        first, second = np.array(mutual, dtype=int).reshape(-1, 2).T
        return Matches(reference[0][first], query[0][second])

    def _pairs(self, ours: NDArray[np.float32], theirs: NDArray[np.float32]) -> dict[int, int]:
        """For those of our descriptors that pass the ratio test, the nearest of theirs."""
        if len(theirs) < 2:
            return {}
        two = self.nearest.knnMatch(ours, theirs, k=2)
        return {near.queryIdx: near.trainIdx for near, far in two if near.distance < self.ratio * far.distance}


class Learned(Matcher):
    """A network of transformers that matches key points: LightGlue on SuperPoint (2023) or EfficientLoFTR (2024)."""

    network: nn.Module

    def __init__(self, name: str, weights: str | None) -> None:
        user, install = f"solver.matcher={name}", "pip install 'transformers>=4.54'"
        transformers = optional_import("transformers", user, install)
        source = weights or WEIGHTS[name]
        try:
            self.processor = transformers.AutoImageProcessor.from_pretrained(source)
            self.network = transformers.AutoModelForKeypointMatching.from_pretrained(source)
        except AttributeError as error:
            raise UserError(f"{user} needs a newer transformers: {install}") from error
        except Exception as error:  # the hub's package and its HTTP libraries have many of their own
            raise weights_error(name, source, error) from error
        self.network.eval().requires_grad_(False)

    def describe(self, image: Tensor) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Pixels `[H, W, 3]` and where the object is, `[H, W]`."""
        return pixels(image), foreground(image)

    @torch.no_grad()
    def match(self, reference: Any, query: Any) -> Matches:
        images = [reference[0], query[0]]
        inputs = self.processor([images], size={"height": SIDE, "width": SIDE}, return_tensors="pt")
        outputs = self.network(**inputs.to(next(self.network.parameters()).device))
        sizes = [[tuple(FINER * side for side in image.shape[:2]) for image in images]]
        # Its threshold of scores is the least that EfficientLoFTR's own settings keep.
        (found,) = self.processor.post_process_keypoint_matching(outputs, sizes, threshold=0.2)
        places = []
        for key, image in zip(("keypoints0", "keypoints1"), images, strict=True):
            size = np.array(image.shape[1::-1])  # pixels of SIDE are counted from the centre of their first, too
            places.append(found[key].cpu().double().numpy() / FINER + size / (2 * SIDE) - 0.5)
        return Matches(*places).within(reference[1], query[1])
