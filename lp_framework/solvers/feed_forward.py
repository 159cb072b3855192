"""Feed-forward solvers, which predict the relative camera of a pair directly: DUSt3R and VGGT."""

from __future__ import annotations

import argparse
from abc import abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.functional import interpolate

from lp_framework.errors import UserError, optional_import, positive
from lp_framework.geometry import from_opencv, inverse, pose_of_relative_camera, relative_camera, rigid_transform
from lp_framework.registry import register
from lp_framework.solvers.base import Cost, Pairs, Solution, Solver, timed

Loaded = TypeVar("Loaded")


class RelativeCameraSolver(Solver):
    """One answer per pair (N = 1), **starts are ignored**; a pair without an answer is invalid and its pose is NaN.

    The `Solution` has full cameras, with translations up to scale. `pose_of_relative_camera` converts them to poses,
    with the reference at `reference_radius` (object sizes) from the object's centre; 1.4 is the distance that
    `estimate` assumes for prepared photographs.
    """

    one_answer = True

    def __init__(self, reference_radius: float) -> None:
        positive("solver", reference_radius=reference_radius)
        self.reference_radius = reference_radius

    @abstractmethod
    def predict(self, pairs: Pairs, seed: int) -> tuple[Tensor, Tensor, int]:
        """Relative cameras `[B, 4, 4]` (float64; NaN: no answer), energies `[B]`, and number of network passes."""

    @timed
    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        cameras, energies, passes = self.predict(pairs, seed)
        poses = pose_of_relative_camera(cameras, self.reference_radius)
        return Solution(
            poses=poses.to(starts)[:, None],
            energies=energies.to(starts)[:, None],
            valid=cameras.isfinite().all(dim=-1).all(dim=-1).to(starts.device)[:, None],
            chosen=torch.zeros(len(pairs), dtype=torch.int64, device=starts.device),
            cost=Cost(passes),
            cameras=cameras.to(starts)[:, None],
        )


def with_weights(load: Callable[[str], Loaded], network: str, weights: str) -> Loaded:
    """Load the weights of a network (a file, a folder or a hub id); raises `UserError` if `load` fails."""
    if Path(weights).suffix in (".pt", ".pth", ".safetensors") and not Path(weights).is_file():
        raise UserError(f"{weights}: there is no such file with the weights of {network}")
    try:
        return load(weights)
    except Exception as error:  # the hub's package and its HTTP libraries raise many types
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise UserError(
            f"{weights}: the weights of {network} cannot be loaded from there ({reason}); "
            "give solver.weights= a local path or an id of the Hugging Face hub"
        ) from error


class FeedForward(RelativeCameraSolver):
    """A network that predicts both cameras of a pair, reference first, in any frame and at any scale.

    Square images are resized to side length `image_size` in pixels, a multiple of the network's `patch`.
    """

    patch: int
    passes_per_pair: int

    def __init__(self, network: nn.Module, image_size: int, reference_radius: float) -> None:
        super().__init__(reference_radius)
        if image_size < self.patch or image_size % self.patch:
            raise UserError(f"solver.image_size must be a multiple of {self.patch}, got {image_size}")
        self.network, self.image_size = network.eval().requires_grad_(False), image_size

    @abstractmethod
    def cameras(self, images: Tensor) -> Tensor:
        """Camera-to-world `[2, 4, 4]` (OpenCV axes; NaN: no answer) of prepared images `[2, 3, H, W]` in [-1, 1]."""

    def prepare(self, images: Tensor) -> Tensor:
        """Resize images `[I, 3, H, W]` in [-1, 1] to the network's size, with Pillow's resampling."""
        size = (self.image_size, self.image_size)
        return interpolate(images, size, mode="bicubic", align_corners=False, antialias=True).clamp(-1, 1)

    def predict(self, pairs: Pairs, seed: int) -> tuple[Tensor, Tensor, int]:
        """See `RelativeCameraSolver.predict`; there is no energy, so all are 0."""
        ends = torch.stack([pairs.reference, pairs.query], dim=1)
        both = torch.stack([self.cameras(self.prepare(pairs.images[pair])).cpu().double() for pair in ends])
        reference, query = from_opencv(both).unbind(dim=1)
        energies = torch.zeros(len(pairs), dtype=torch.float64)
        return relative_camera(reference, query), energies, self.passes_per_pair * len(pairs)


@register("solver", "dust3r")
class Dust3r(FeedForward):
    """DUSt3R (Wang et al. 2024): point maps of both images and the cameras fitted to them; one answer per pair.

    The network sees the images in both orders; the cameras are computed as in the authors' `PairViewer`.
    """

    patch, passes_per_pair = 16, 2

    def __init__(
        self,
        weights: str = "naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt",
        image_size: int = 512,
        reference_radius: float = 1.4,
    ) -> None:
        where = "see docs/baselines.md, it is not on the package index"
        model, self.inference, self.alignment = (
            optional_import(f"dust3r.{part}", "solver=dust3r", where) for part in ("model", "inference", "cloud_opt")
        )
        torch.serialization.add_safe_globals([argparse.Namespace])  # stored in its checkpoints beside the weights
        network = with_weights(model.AsymmetricCroCo3DStereo.from_pretrained, "DUSt3R", weights)
        super().__init__(network, image_size, reference_radius)

    def cameras(self, images: Tensor) -> Tensor:
        shape = torch.tensor([images.shape[-2:]], dtype=torch.int32).numpy()
        first, second = (
            {"img": image[None], "true_shape": shape, "idx": index, "instance": str(index)}
            for index, image in enumerate(images)
        )
        output = self.inference.inference([(first, second), (second, first)], self.network, images.device, batch_size=2)
        mode = self.alignment.GlobalAlignerMode.PairViewer
        found: Tensor = self.alignment.global_aligner(output, device="cpu", mode=mode, verbose=False).get_im_poses()
        # If it finds no camera for the other image's points, it places both at exactly the same position.
        return torch.full_like(found, torch.nan) if torch.equal(found[0], found[1]) else found


@register("solver", "vggt")
class VGGT(FeedForward):
    """VGGT (Wang et al. 2025): both cameras from its camera head; one answer per pair."""

    patch, passes_per_pair = 14, 1

    def __init__(self, weights: str = "facebook/VGGT-1B", image_size: int = 518, reference_radius: float = 1.4) -> None:
        package = "pip install git+https://github.com/facebookresearch/vggt"
        model = optional_import("vggt.models.vggt", "solver=vggt", package).VGGT
        self.encoding = optional_import("vggt.utils.pose_enc", "solver=vggt", package)

        def load(source: str) -> nn.Module:
            if not Path(source).is_file():
                downloaded: nn.Module = model.from_pretrained(source)
                return downloaded
            safe = source.endswith(".safetensors")
            values = load_file(source) if safe else torch.load(source, map_location="cpu", weights_only=True)
            network: nn.Module = model()
            network.load_state_dict(values)
            return network

        super().__init__(with_weights(load, "VGGT", weights), image_size, reference_radius)

    def cameras(self, images: Tensor) -> Tensor:
        network: Any = self.network
        batch = (images[None] + 1) / 2
        with torch.autocast(images.device.type, dtype=torch.bfloat16, enabled=images.is_cuda):  # as published
            tokens, _ = network.aggregator(batch)
        encoded = network.camera_head(tokens)[-1]  # after the last refinement
        world_to_camera, _ = self.encoding.pose_encoding_to_extri_intri(encoded, batch.shape[-2:])
        matrices = world_to_camera[0].cpu().double()  # [2, 3, 4]
        return inverse(rigid_transform(matrices[..., :3], matrices[..., 3]))
