"""The tiny prior as an energy over relative poses, and as a generator of novel views."""

from __future__ import annotations

import torch
from torch import Tensor

from lp_framework.errors import UserError
from lp_framework.models.checkpoints import SHIPPED, find_checkpoint, read_checkpoint, restore
from lp_framework.priors.base import Prior, ViewCode
from lp_framework.priors.ddim import ddim_sample, guided, standard_normal
from lp_framework.priors.tiny.latents import IMAGE_SIZE
from lp_framework.priors.tiny.networks import predicted_noise
from lp_framework.priors.tiny.training import PriorModel
from lp_framework.registry import register


@register("prior", "tiny")
class TinyPrior(Prior):
    """A small diffusion model that comes trained on the embedded objects; `path`: one of your own training.

    `path` is a run of `train model=prior`, or a folder that `convert` made of it.

    The target's latents are predicted to be Gaussian, with a mean and a spread that depend on source and pose, so the
    denoiser has a closed form and never finds the target's pose in the noised target itself: the energy depends on the
    pose at every timestep.
    """

    def __init__(self, path: str | None = None) -> None:
        super().__init__()
        file = find_checkpoint(SHIPPED / "tiny" if path is None else path)
        model = restore(file, read_checkpoint(file))
        if not isinstance(model, PriorModel):
            raise UserError(f"{file}: holds a model of the pose, not a prior; use it with checkpoint={path}")
        self.model = model
        self.num_timesteps = len(self.model.alphas_cumprod)
        self.latent_shape = (self.model.networks.latent_dim, 1, 1)
        self.image_size = IMAGE_SIZE

    @torch.no_grad()
    def encode(self, images: Tensor) -> ViewCode:
        """See `Prior.encode`: principal components `[B, D, 1, 1]`, and a code that poses steer `[B, 1, code_dim]`."""
        if images.ndim != 4 or images.shape[1] != 3:
            raise UserError(f"images must be [B, 3, H, W], got {list(images.shape)}")
        latents, codes = self.model.code(images.float())
        return ViewCode(latents[..., None, None], codes[:, None])

    def residual(self, target: ViewCode, source: ViewCode, pose: Tensor, timestep: Tensor, noise: Tensor) -> Tensor:
        self.check(target, source, pose, timestep, noise)
        alpha = self.model.alphas_cumprod[timestep][:, None]
        noise = noise.flatten(1)
        noisy = alpha.sqrt() * target.latent.flatten(1) + (1 - alpha).sqrt() * noise
        predicted = self.model.networks.predict(source.embedding[:, 0], pose)
        return (predicted_noise(noisy, alpha, predicted) - noise)[..., None, None]

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
        if not guidance >= 0:
            raise UserError(f"guidance must not be negative, got {guidance}")
        networks, alphas = self.model.networks, self.model.alphas_cumprod
        # Without a source the prediction is the Gaussian of all training views.
        predicted, anything = networks.predict(source.embedding[:, 0], pose.float()), networks.marginal()

        def predict(latent: Tensor, timestep: int) -> Tensor:
            free, conditional = (predicted_noise(latent, alphas[timestep], each) for each in (anything, predicted))
            return guided(free, conditional, guidance)

        start = standard_normal(predicted.mean, generator)
        return networks.decoder(ddim_sample(predict, start, alphas, steps, eta, generator))
