"""The prior interface: a frozen, pose-conditioned diffusion model whose denoising error is an energy over poses."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from lp_framework.errors import UserError


@dataclass(frozen=True)
class ViewCode:
    """What a prior keeps of B images: `latent` `[B, C, h, w]` and `embedding` `[B, tokens, channels]`.

    It can be indexed like a batch: `code[2:5]`, or `code[index]` with integers `[N]`.
    """

    latent: Tensor
    embedding: Tensor

    def __len__(self) -> int:
        return len(self.latent)

    def __getitem__(self, index: slice | Tensor) -> ViewCode:
        return ViewCode(self.latent[index], self.embedding[index])


class Prior(nn.Module, ABC):
    """A frozen pose-conditioned diffusion model. A subclass sets the attributes and says what the network predicts.

    Relative poses are `query - reference`, `(latitude, longitude, radius)` in radians and scene units, `[B, 3]`.
    """

    num_timesteps: int  # timesteps are integers from 0 (hardly any noise) to num_timesteps - 1
    latent_shape: tuple[int, int, int]  # of an image's latent, and so of the noise
    image_size: int  # pixels a side of the images that the prior sees and generates
    usual_error: float | None = (
        None  # mean denoising error at true poses of objects like those that it has met, if known
    )

    @abstractmethod
    def encode(self, images: Tensor) -> ViewCode:
        """The codes of images `[B, 3, H, W]` in [-1, 1] on white, which are resized if necessary."""

    @abstractmethod
    def residual(self, target: ViewCode, source: ViewCode, pose: Tensor, timestep: Tensor, noise: Tensor) -> Tensor:
        """Predicted minus true noise, `[B, *latent_shape]` float32; differentiable in `pose`, forward and backward.

        The prediction is for `target` (B codes) noised by `noise` `[B, *latent_shape]` to `timestep` `[B]` (int64),
        seen from `source` (B codes) under the relative pose `[B, 3]` of the target."""

    def denoising_error(
        self, target: ViewCode, source: ViewCode, pose: Tensor, timestep: Tensor, noise: Tensor
    ) -> Tensor:
        """The mean square of `residual`, `[B]`: the energy of each pose, differentiable in it."""
        return self.residual(target, source, pose, timestep, noise).square().flatten(1).mean(dim=1)

    @abstractmethod
    def generate(
        self,
        source: ViewCode,
        pose: Tensor,
        steps: int = 50,
        guidance: float = 3.0,
        generator: torch.Generator | None = None,
        eta: float = 1.0,
    ) -> Tensor:
        """Novel views `[B, 3, image_size, image_size]` in [-1, 1] of `source` under relative poses `[B, 3]`, by DDIM.

        `guidance` is the scale of classifier-free guidance (1: none), `eta` the share of fresh noise (0: none). All
        views of a call have the same draws."""

    def train(self, mode: bool = True) -> Prior:
        """Does nothing: a prior stays in evaluation mode."""
        return super().train(False)

    def check(self, target: ViewCode, source: ViewCode, pose: Tensor, timestep: Tensor, noise: Tensor) -> None:
        """Raise `UserError` if the shapes or timesteps of the arguments of `residual` are wrong."""
        batch, latents = len(pose), {"target": target.latent, "source": source.latent, "noise": noise}
        shapes: dict[str, tuple[int, ...]] = {**dict.fromkeys(latents, self.latent_shape), "pose": (3,), "timestep": ()}
        for name, tensor in {**latents, "pose": pose, "timestep": timestep}.items():
            wanted = [batch, *shapes[name]]
            if list(tensor.shape) != wanted:
                raise UserError(f"{name} must be {wanted} for {batch} poses, got {list(tensor.shape)}")
        known = timestep.device.type == "cpu"  # looking at the values on a GPU would wait for it, at every step
        outside = batch and known and not 0 <= timestep.min() <= timestep.max() < self.num_timesteps
        if timestep.is_floating_point() or outside:
            raise UserError(f"timestep must hold integers from 0 to {self.num_timesteps - 1}, got {timestep.tolist()}")


def resized(images: Tensor, side: int) -> Tensor:
    """Images `[B, 3, side, side]` of `[B, 3, H, W]`, with antialiasing; `UserError` for other shapes."""
    if images.ndim != 4 or images.shape[1] != 3:
        raise UserError(f"images must be [B, 3, H, W], got {list(images.shape)}")
    if images.shape[-2:] == (side, side):
        return images
    return functional.interpolate(images, [side, side], mode="bilinear", antialias=True, align_corners=False)
