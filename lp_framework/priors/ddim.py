"""DDIM (Song, Meng and Ermon 2021) over the 1000 steps of a trained diffusion model.

Symbols: `alpha` is the paper's alpha_t (Ho et al.'s alpha-bar_t), `latent` its x_t, `noise` its epsilon_theta(x_t).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from lp_framework.errors import UserError

STEPS_OFFSET = 1  # latent-diffusion's sampler visits 1, 21, 41, ... instead of 0, 20, 40, ...


def scaled_linear_alphas(num_timesteps: int = 1000, start: float = 0.00085, end: float = 0.0120) -> Tensor:
    """alpha_t `[num_timesteps]` of latent-diffusion's schedule: the square root of beta_t is linear in t."""
    betas = torch.linspace(start**0.5, end**0.5, num_timesteps, dtype=torch.float64) ** 2
    return (1 - betas).cumprod(dim=0).float()


def ddim_timesteps(steps: int, num_timesteps: int = 1000) -> list[int]:
    """The timesteps visited when sampling, from noise to image.

    >>> ddim_timesteps(5)
    [801, 601, 401, 201, 1]
    """
    if not 1 <= steps <= num_timesteps:
        raise UserError(f"steps must lie between 1 and {num_timesteps}, got {steps}")
    stride = num_timesteps // steps
    return [min(step * stride + STEPS_OFFSET, num_timesteps - 1) for step in reversed(range(steps))]


def ddim_step(latent: Tensor, noise: Tensor, alpha: Tensor, alpha_next: Tensor, eta: float, fresh: Tensor) -> Tensor:
    """One denoising step (Eq. 12); `fresh` is standard normal noise, with a share of `eta` (Eq. 16)."""
    sigma = eta * ((1 - alpha_next) / (1 - alpha) * (1 - alpha / alpha_next)).sqrt()
    image = (latent - (1 - alpha).sqrt() * noise) / alpha.sqrt()  # "predicted x_0"
    direction = (1 - alpha_next - sigma.square()).sqrt() * noise  # "direction pointing to x_t"
    return alpha_next.sqrt() * image + direction + sigma * fresh


def ddim_sample(
    predict: Callable[[Tensor, int], Tensor],
    start: Tensor,
    alphas: Tensor,
    steps: int,
    eta: float,
    generator: torch.Generator | None,
) -> Tensor:
    """Sample latents `[B, ...]` from the noise `start` in `steps` steps; `predict(latent, timestep)` is epsilon_theta.

    Fresh noise is shared by the whole batch, see `standard_normal`.
    """
    if not 0 <= eta <= 1:
        raise UserError(f"eta must lie in [0, 1], got {eta}")
    timesteps = ddim_timesteps(steps, len(alphas))
    latent = start
    for timestep, following in zip(timesteps, [*timesteps[1:], 0], strict=True):
        noise = predict(latent, timestep)
        fresh = standard_normal(latent, generator) if eta > 0 else latent
        latent = ddim_step(latent, noise, alphas[timestep], alphas[following], eta, fresh)
    return latent


def standard_normal(like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Standard normal noise of the shape, device and dtype of `like` `[B, ...]`, drawn on the generator's device.

    The batch shares one draw, so that views differ only by their conditioning and do not depend on the batch.
    """
    device = generator.device if generator is not None else like.device
    return torch.randn(like.shape[1:], generator=generator, device=device).to(like).expand_as(like)


def guided(unconditional: Tensor, conditional: Tensor, guidance: float) -> Tensor:
    """Classifier-free guidance (Ho and Salimans 2022) of predicted noise; `guidance` 1 returns the conditional one."""
    if not guidance >= 0:
        raise UserError(f"guidance must not be negative, got {guidance}")
    return unconditional + guidance * (conditional - unconditional)
