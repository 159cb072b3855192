"""The tiny prior's networks: an image's code, how a relative pose steers it, and the Gaussian that it predicts."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lp_framework.models.view_head import scaled
from lp_framework.priors.tiny.latents import ImageDecoder, PrincipalLatents

CONSTANT, WAVES = 64, 8  # numbers of a code that a turn leaves as they are; waves of each order


class Gaussian(NamedTuple):
    """A Gaussian over latents with a diagonal covariance: `mean` and `log_spread` `[..., D]`."""

    mean: Tensor
    log_spread: Tensor


def code_dim(orders: int) -> int:
    """Numbers in a code: a constant part, `orders` x `WAVES` complex waves, a place (scaled latitude and radius)."""
    return CONSTANT + 2 * WAVES * orders + 2


def readout(code: Tensor, orders: int) -> Tensor:
    """Of codes `[B, code_dim]` the numbers `[B, 4]` that stand for the view pose (see `relative_pose_loss`)."""
    waves = code[:, CONSTANT:-2].view(-1, 2, orders, WAVES)
    return torch.cat([waves[:, :, 0, 0], code[:, -2:]], dim=1)


def steer(code: Tensor, pose: Tensor, orders: int) -> Tensor:
    """Codes `[..., code_dim]` (see `code_dim`) as seen from relative poses `[..., 3]` away.

    A wave of order m turns by m times the relative longitude, and the place moves by the relative latitude and radius:
    a turn of the camera acts on the code as it acts on functions on a circle. So the result is periodic in longitude,
    composes (`steer` by x, then by y, is `steer` by x + y) and what is learned of one pair serves all others.
    """
    constant, waves, place = code[..., :CONSTANT], code[..., CONSTANT:-2], code[..., -2:]
    real, imaginary = waves.unflatten(-1, (2, orders, WAVES)).unbind(dim=-3)
    angle = pose[..., 1:2] * torch.arange(1, orders + 1, device=pose.device, dtype=pose.dtype)
    cosine, sine = angle.cos()[..., None], angle.sin()[..., None]
    turned = torch.stack([real * cosine - imaginary * sine, real * sine + imaginary * cosine], dim=-3)
    moved = place + scaled(pose)
    return torch.cat([constant.expand(*moved.shape[:-1], -1), turned.flatten(-3), moved], dim=-1)


class Residual(nn.Module):
    """x + silu(norm(W x)); smooth, because solvers differentiate it."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(width, width), nn.LayerNorm(width), nn.SiLU())

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x)


class TinyNetworks(nn.Module):
    """All that is trained (and the latents' basis). `predict` is the model: p(target's latents | source, pose)."""

    def __init__(self, feature_dim: int, latent_dim: int, scale: float, orders: int, width: int, layers: int) -> None:
        super().__init__()
        self.latent_dim, self.orders = latent_dim, orders
        self.latents = PrincipalLatents(latent_dim, scale)
        self.encoder = nn.Linear(feature_dim, code_dim(orders))
        last = nn.Linear(width, 2 * latent_dim)
        nn.init.zeros_(last.weight[latent_dim:])
        nn.init.constant_(last.bias[latent_dim:], math.log(0.3 * scale))
        self.head = nn.Sequential(nn.Linear(code_dim(orders), width), *(Residual(width) for _ in range(layers)), last)
        self.decoder = ImageDecoder(latent_dim)

    def predict(self, code: Tensor, pose: Tensor) -> Gaussian:
        """The Gaussian over the target's latents for codes `[..., code_dim]` of sources, relative poses `[..., 3]`."""
        mean, log_spread = self.head(steer(code, pose, self.orders)).chunk(2, dim=-1)
        return Gaussian(mean, log_spread)

    def marginal(self) -> Gaussian:
        """The Gaussian over latents of all training views `[latent_dim]`: what is predicted of no source."""
        return Gaussian(torch.zeros_like(self.latents.spread), self.latents.spread.clamp(min=1e-6).log())


def predicted_noise(noisy: Tensor, alpha: Tensor, predicted: Gaussian) -> Tensor:
    """epsilon_theta: the expected noise in `noisy` `[..., D]`, given that the clean latents are as `predicted`.

    With z = sqrt(alpha) z_0 + sqrt(1 - alpha) epsilon and z_0 ~ N(mu, s^2), E[epsilon | z] =
    sqrt(1 - alpha) (z - sqrt(alpha) mu) / (alpha s^2 + 1 - alpha); `alpha` (alpha-bar_t) broadcasts to `[..., 1]`.
    """
    variance = alpha * (2 * predicted.log_spread).exp() + (1 - alpha)
    return (1 - alpha).sqrt() * (noisy - alpha.sqrt() * predicted.mean) / variance
