"""A prior to copy: any model that predicts the other view can be one."""

from __future__ import annotations

import torch
from torch import Tensor

from lp_framework.priors.base import Prior, ViewCode, resized
from lp_framework.registry import register


@register("prior", "cylinder")
class Cylinder(Prior):
    """Takes the object for an upright cylinder as wide as the image, seen from afar.

    The prediction has standard deviation `seen` where both cameras see the surface, and
    `unseen` elsewhere. The energy depends on the longitude alone: latitude and radius
    are not modelled.
    """

    alphas_cumprod: Tensor

    def __init__(
        self, image_size: int = 64, seen: float = 0.2, unseen: float = 1.0
    ) -> None:
        super().__init__()
        self.num_timesteps = 1000
        self.image_size = image_size
        self.latent_shape = (3, image_size, image_size)
        self.seen, self.unseen = seen, unseen
        # Zero123's noise schedule.
        betas = torch.linspace(0.00085**0.5, 0.012**0.5, self.num_timesteps) ** 2
        self.register_buffer("alphas_cumprod", (1 - betas).cumprod(dim=0))

    def encode(self, images: Tensor) -> ViewCode:
        """The resized images are their own latents; there is nothing else to keep."""
        nothing = images.new_zeros(len(images), 1, 0)
        return ViewCode(resized(images, self.image_size), nothing)

    def residual(
        self,
        target: ViewCode,
        source: ViewCode,
        pose: Tensor,
        timestep: Tensor,
        noise: Tensor,
    ) -> Tensor:
        """See `Prior.residual`; `predict` gives the moments of a Gaussian."""
        self.check(target, source, pose, timestep, noise)
        alpha = self.alphas_cumprod[timestep].view(-1, 1, 1, 1)
        noisy = alpha.sqrt() * target.latent + (1 - alpha).sqrt() * noise
        mean, spread = self.predict(source.latent, pose)
        share = (1 - alpha).sqrt() / (alpha * spread.square() + 1 - alpha)
        expected = share * (noisy - alpha.sqrt() * mean)
        return expected - noise

    def predict(self, source: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Mean `[B, 3, H, W]` and standard deviation `[B, 1, 1, W]` of the other view.

        A camera that moves to the right by the longitude `d` sees at the angle `a` what
        the source has at `a + d`.
        """
        width = self.image_size
        column = (torch.arange(width).to(pose) + 0.5) / width * 2 - 1  # in (-1, 1)
        angle = column.asin() + pose[:, 1:2]  # [B, W]
        place = ((angle.sin() + 1) * width - 1) / 2  # in the source, pixels
        left = place.detach().floor().clamp(0, width - 2)
        share = (place - left).clamp(0, 1)[:, None, None]
        index = left.long()[:, None, None].expand(-1, 3, width, -1)
        before, after = source.gather(3, index), source.gather(3, index + 1)
        mean = (1 - share) * before + share * after
        # 1 where the source sees the surface, smooth so that the energy is smooth.
        visible = torch.sigmoid(10 * angle.cos())[:, None, None]
        return visible * mean, visible * self.seen + (1 - visible) * self.unseen

    @torch.no_grad()
    def generate(
        self,
        source: ViewCode,
        pose: Tensor,
        steps: int = 50,
        guidance: float = 3.0,
        generator: torch.Generator | None = None,
        eta: float = 1.0,
    ) -> Tensor:
        """The predicted mean: this prior has no need of sampling."""
        return self.predict(source.latent, pose)[0].clamp(-1, 1)
