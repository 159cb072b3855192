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
    """A prior's codes of B images: `latent` `[B, C, h, w]` and `embedding` `[B, tokens, channels]`.

    It can be indexed like a batch: `code[2:5]`, or `code[index]` with integers `[N]`.
    """

    latent: Tensor
    embedding: Tensor

    def __len__(self) -> int:
        return len(self.latent)

    def __getitem__(self, index: slice | Tensor) -> ViewCode:
        return ViewCode(self.latent[index], self.embedding[index])


class Prior(nn.Module, ABC):
    """A frozen pose-conditioned diffusion model. Subclasses set the attributes and implement the prediction.

    Relative poses are `query - reference`, `(latitude, longitude, radius)` in radians and scene units, `[B, 3]`.
    """

    num_timesteps: int  # timesteps are integers from 0 (almost no noise) to num_timesteps - 1
    latent_shape: tuple[int, int, int]  # of an image's latent, and thus of the noise
    image_size: int  # side length in pixels of input and generated images
    usual_error: float | None = None  # mean denoising error at true poses of in-distribution objects, if known

    @abstractmethod
    def encode(self, images: Tensor) -> ViewCode:
        """Encode images `[B, 3, H, W]` in [-1, 1] on white, resizing them if necessary."""

    @abstractmethod
    def residual(self, target: ViewCode, source: ViewCode, pose: Tensor, timestep: Tensor, noise: Tensor) -> Tensor:
        """Predicted minus true noise, `[B, *latent_shape]` float32; differentiable in `pose`, forward and reverse mode.

        The network denoises `target` (B codes), noised with `noise` `[B, *latent_shape]` to `timestep` `[B]` (int64),
        conditioned on `source` (B codes) and the relative pose `[B, 3]` of the target."""

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
        views in a call use the same noise."""

    def train(self, mode: bool = True) -> Prior:
        """Do nothing: a prior stays in evaluation mode."""
        return super().train(False)

    def check(self, target: ViewCode, source: ViewCode, pose: Tensor, timestep: Tensor, noise: Tensor) -> None:
        """Raise `UserError` if the shapes or timesteps of the arguments of `residual` are wrong."""
        batch, latents = len(pose), {"target": target.latent, "source": source.latent, "noise": noise}
        shapes: dict[str, tuple[int, ...]] = {**dict.fromkeys(latents, self.latent_shape), "pose": (3,), "timestep": ()}
        for name, tensor in {**latents, "pose": pose, "timestep": timestep}.items():
            wanted = [batch, *shapes[name]]
            if list(tensor.shape) != wanted:
                raise UserError(f"{name} must be {wanted} for {batch} poses, got {list(tensor.shape)}")
        known = timestep.device.type == "cpu"  # reading values on a GPU would synchronize with it at every step
        outside = batch and known and not 0 <= timestep.min() <= timestep.max() < self.num_timesteps
        if timestep.is_floating_point() or outside:
            raise UserError(f"timestep must hold integers from 0 to {self.num_timesteps - 1}, got {timestep.tolist()}")


def resized(images: Tensor, side: int) -> Tensor:
    """Resize images `[B, 3, H, W]` to `[B, 3, side, side]` with antialiasing; `UserError` for other shapes."""
    if images.ndim != 4 or images.shape[1] != 3:
        raise UserError(f"images must be [B, 3, H, W], got {list(images.shape)}")
    if images.shape[-2:] == (side, side):
        return images
    return functional.interpolate(images, [side, side], mode="bilinear", antialias=True, align_corners=False)
