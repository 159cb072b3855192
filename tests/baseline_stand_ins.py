"""Mocks of the external parts of the baselines: matches, and the packages of DUSt3R and VGGT.

They know the view poses that `exact_prior.image_of` has put into the images, and answer in the form of the real ones.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lp_framework.geometry import camera_to_world, from_opencv, inverse
from lp_framework.solvers.base import Solver
from lp_framework.solvers.features import Matches

FIELD_OF_VIEW = 49.1  # degrees
BALL = np.random.default_rng(0).normal(size=(80, 3)) / 8  # places on an object


def project(pose: Tensor, places: np.ndarray, size: int) -> np.ndarray:
    """Pixels `[M, 2]`, counted from the centre of the first one, where a view pose `[3]` sees places `[M, 3]`."""
    rotation, centre = (part.cpu().numpy() for part in camera_to_world(pose.double())[:3].split([3, 1], dim=1))
    seen = (places - centre[:, 0]) @ rotation
    focal = size / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    return np.stack([seen[:, 0], -seen[:, 1]], axis=1) / -seen[:, 2:] * focal + (size - 1) / 2


class KnownMatcher:
    """Matches of places on the object, `noise` pixels off, with `outliers` more that match nothing."""

    network = None

    def __init__(self, count: int = 80, noise: float = 0.0, outliers: int = 0, size: int = 8) -> None:
        self.count, self.noise, self.outliers, self.size = count, noise, outliers, size

    def describe(self, image: Tensor) -> Tensor:
        return image.flatten()[:3]

    def match(self, reference: Tensor, query: Tensor) -> Matches:
        random = np.random.default_rng(1)
        ends = []
        for pose in (reference, query):
            points = project(pose, BALL[: self.count], self.size)
            points += self.noise * random.normal(size=points.shape)
            ends.append(np.concatenate([points, random.uniform(0, self.size - 1, (self.outliers, 2))]))
        return Matches(*ends)


def known_cameras(images: Tensor) -> Tensor:
    """Cameras to world `[..., 4, 4]` with OpenCV's axes of images `[..., 3, H, W]`, float32."""
    return from_opencv(camera_to_world(images.flatten(-3)[..., :3].double())).float()


class KnownNetwork(nn.Module):
    """A mock of the networks of DUSt3R and VGGT; all lengths are `scale` times the true ones."""

    scale = 1.0

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(()))

    @classmethod
    def from_pretrained(cls, weights: str) -> KnownNetwork:
        if weights == "nobody/nothing":
            raise OSError(
                "nobody/nothing is not a local folder and is not a valid model identifier\nIf this is private"
            )
        return cls()

    # VGGT's, on images [B, S, 3, H, W] in [0, 1]
    def aggregator(self, images: Tensor) -> tuple[list[Tensor], int]:
        self.shape = images.shape
        return [images], 5

    def camera_head(self, tokens: list[Tensor]) -> list[Tensor]:
        """An encoding `[B, S, 9]` for each refinement; the early ones are bad. The stand-in's is of image numbers."""
        encoded = torch.nn.functional.pad((tokens[-1] * 2 - 1).flatten(2)[..., :3], (0, 6))
        return [torch.zeros_like(encoded), encoded]


def pose_encoding_to_extri_intri(encoding: Tensor, image_size_hw: Any) -> tuple[Tensor, Tensor]:
    """World to camera `[B, S, 3, 4]` with OpenCV's axes, the world the first camera's; intrinsics `[B, S, 3, 3]`."""
    cameras = known_cameras(encoding[..., :3, None, None].double())
    matrices = (inverse(cameras.double()) @ cameras[:, :1].double()).float()[..., :3, :]
    matrices[..., 3] *= KnownNetwork.scale
    return matrices, torch.eye(3).expand(*encoding.shape[:2], 3, 3)


def inference(pairs: list[tuple[dict, dict]], model: nn.Module, device: Any, batch_size: int) -> dict[str, dict]:
    """DUSt3R's dicts of both views and predictions, with pairs along the batch; one point per pixel.

    A camera is in no output: `pts3d` are the first view's points in its own frame, `pts3d_in_other_view` the second
    view's in the first one's.
    """
    assert batch_size == 2 and [(first["idx"], second["idx"]) for first, second in pairs] == [(0, 1), (1, 0)]
    views: list[dict[str, Any]] = []
    points: list[list[Tensor]] = [[], []]
    for side in (0, 1):
        view = [pair[side] for pair in pairs]
        assert all(each["img"].shape[:2] == (1, 3) and each["true_shape"].dtype == np.int32 for each in view)
        views.append({key: [each[key] for each in view] for key in ("img", "true_shape", "idx", "instance")})
    for pair in pairs:
        first, second = (known_cameras(each["img"][0].cpu()).double() for each in pair)
        for side, camera in enumerate((first, second)):
            height, width = pair[side]["img"].shape[-2:]
            own = torch.from_numpy(np.random.default_rng(3).normal(size=(height * width, 3))) / 8
            own[:, 2] += 1.5  # in front of its camera
            world = own @ camera[:3, :3].mT + camera[:3, 3]
            local = (world - first[:3, 3]) @ first[:3, :3]
            points[side].append((KnownNetwork.scale * local).float().view(height, width, 3))
    confidence = torch.full((2, *points[0][0].shape[:2]), 5.0)
    return {
        "view1": views[0],
        "view2": views[1],
        "pred1": {"pts3d": torch.stack(points[0]), "conf": confidence},
        "pred2": {"pts3d_in_other_view": torch.stack(points[1]), "conf": confidence},
    }


class PairViewer:
    """DUSt3R's for two images: cameras to world with OpenCV's axes, the world being the first camera's."""

    fails = False

    def __init__(self, output: dict[str, dict]) -> None:
        other = output["pred2"]["pts3d_in_other_view"][0].double().flatten(0, 1)
        own = output["pred1"]["pts3d"][1].double().flatten(0, 1)  # of the second pair: its first view is this image
        shift = [points.mean(dim=0) for points in (own, other)]
        left, _, right = torch.linalg.svd((other - shift[1]).mT @ (own - shift[0]))  # Kabsch
        pose = torch.eye(4, dtype=torch.float64)
        sign = torch.tensor([1.0, 1.0, torch.linalg.det(left @ right)], dtype=torch.float64)
        pose[:3, :3] = left * sign @ right
        pose[:3, 3] = shift[1] - pose[:3, :3] @ shift[0]
        self.poses = nn.Parameter(torch.stack([torch.eye(4), torch.eye(4) if self.fails else pose.float()]))

    def get_im_poses(self) -> Tensor:
        return self.poses


def global_aligner(output: dict[str, dict], device: str, mode: str, verbose: bool) -> PairViewer:
    assert (device, mode, verbose) == ("cpu", "PairViewer", False)
    return PairViewer(output)


@contextmanager
def packages() -> Iterator[None]:
    """Make mocks of the authors' packages importable."""
    contents = {
        "dust3r": {},
        "dust3r.model": {"AsymmetricCroCo3DStereo": KnownNetwork},
        "dust3r.inference": {"inference": inference},
        "dust3r.cloud_opt": {
            "global_aligner": global_aligner,
            "GlobalAlignerMode": SimpleNamespace(PairViewer="PairViewer"),
        },
        "vggt": {},
        "vggt.models": {},
        "vggt.models.vggt": {"VGGT": KnownNetwork},
        "vggt.utils": {},
        "vggt.utils.pose_enc": {"pose_encoding_to_extri_intri": pose_encoding_to_extri_intri},
    }
    before = {name: sys.modules.get(name) for name in contents}
    for name, content in contents.items():
        sys.modules[name] = ModuleType(name)
        vars(sys.modules[name]).update(content)
    try:
        yield
    finally:
        for name, module in before.items():
            del sys.modules[name]
            if module is not None:
                sys.modules[name] = module


def know(solver: Solver) -> Solver:
    """The same solver; if it is one of the baselines, it sees the poses in the images of `exact_prior`."""
    if hasattr(solver, "matcher"):
        solver.matcher = KnownMatcher()
        solver.tolerance = 0.01  # of images of 8 pixels
    if hasattr(solver, "prepare"):
        solver.prepare = lambda images: images  # resized, the numbers in them are gone
    return solver
