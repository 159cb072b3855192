"""The tiny prior's networks: an image's latents and code, how a relative pose steers it, the Gaussian it predicts."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from lp_framework.models.networks import ResidualLayer
from lp_framework.models.view_head import scaled
from lp_framework.priors.base import resized

IMAGE_SIZE = 64  # pixels a side of what is decoded
LATENT_PIXELS = 32  # of what the latents are taken from
CONSTANT, WAVES = 64, 8  # numbers of a code that a turn leaves as they are; waves of each order


def shrink(images: Tensor) -> Tensor:
    """Pixels `[B, 3 * 64 * 64]` of images `[B, 3, H, W]`."""
    return resized(images, IMAGE_SIZE).flatten(1)


def _halve(pixels: Tensor) -> Tensor:
    """Pixels `[B, 3 * 32 * 32]` of `[B, 3 * 64 * 64]`."""
    return functional.avg_pool2d(pixels.view(-1, 3, IMAGE_SIZE, IMAGE_SIZE), 2).flatten(1)


class PrincipalLatents(nn.Module):
    """The first `dim` principal components of 32 x 32 images, scaled so that their mean square is `scale`^2.

    A linear map, so that noise of the latents is noise of the image; `spread` `[dim]` are the standard deviations.
    """

    def __init__(self, dim: int, scale: float) -> None:
        super().__init__()
        self.dim, self.scale = dim, scale
        pixels = 3 * LATENT_PIXELS**2
        self.mean = nn.Buffer(torch.zeros(pixels))
        self.basis = nn.Buffer(torch.zeros(pixels, dim))  # scaled
        self.spread = nn.Buffer(torch.zeros(dim))

    @torch.no_grad()
    def fit(self, pixels: Tensor) -> None:
        """Take the basis from pixels `[I, 3 * 64 * 64]`; with fewer images than `dim` the rest of it is zero."""
        small = _halve(pixels.float()).cpu().double()
        mean = small.mean(dim=0)
        rows = (small - mean) / len(small) ** 0.5
        if len(rows) >= rows.shape[1]:
            variances, vectors = torch.linalg.eigh(rows.T @ rows)
        else:  # those of the smaller product, mapped over
            variances, vectors = torch.linalg.eigh(rows @ rows.T)
            vectors = functional.normalize(rows.T @ vectors, dim=0)
        variances, vectors = variances.flip(0), vectors.flip(1)  # from the largest to the least
        missing = max(0, self.dim - len(variances))
        variances = functional.pad(variances[: self.dim].clamp(min=0), (0, missing))
        vectors = functional.pad(vectors[:, : self.dim], (0, missing))
        variances = torch.where(variances > 1e-9 * variances[0], variances, 0)
        vectors = vectors * torch.where(vectors.sum(dim=0) < 0, -1, 1)  # the sign is free
        factor = self.scale / variances.mean().sqrt()
        self.mean.copy_(mean)
        self.basis.copy_(vectors * (variances > 0) * factor)
        self.spread.copy_(variances.sqrt() * factor)

    def forward(self, pixels: Tensor) -> Tensor:
        """Latents `[B, dim]` of pixels `[B, 3 * 64 * 64]`."""
        return (_halve(pixels) - self.mean) @ self.basis


class ImageDecoder(nn.Module):
    """Latents `[B, dim]` to images `[B, 3, 64, 64]` in [-1, 1]: a linear map to 8 x 8, three doublings."""

    def __init__(self, dim: int, channels: int = 64) -> None:
        super().__init__()
        half = channels // 2
        self.layers = nn.Sequential(
            nn.Linear(dim, channels * 64),
            nn.Unflatten(1, (channels, 8, 8)),
            nn.ReLU(),
            nn.Upsample(scale_factor=2),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.ReLU(),
            nn.Upsample(scale_factor=2),
            nn.Conv2d(channels, half, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(half, 12, 3, padding=1),
            nn.PixelShuffle(2),
            nn.Tanh(),
        )

    def forward(self, latents: Tensor) -> Tensor:
        return self.layers(latents)


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

    A wave of order m turns by m times the relative longitude, and the place moves by the relative latitude and radius.
    """
    constant, waves, place = code[..., :CONSTANT], code[..., CONSTANT:-2], code[..., -2:]
    real, imaginary = waves.unflatten(-1, (2, orders, WAVES)).unbind(dim=-3)
    angle = pose[..., 1:2] * torch.arange(1, orders + 1, device=pose.device, dtype=pose.dtype)
    cosine, sine = angle.cos()[..., None], angle.sin()[..., None]
    turned = torch.stack([real * cosine - imaginary * sine, real * sine + imaginary * cosine], dim=-3)
    moved = place + scaled(pose)
    return torch.cat([constant.expand(*moved.shape[:-1], -1), turned.flatten(-3), moved], dim=-1)


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
        first = nn.Linear(code_dim(orders), width)
        hidden = [ResidualLayer(width, nn.SiLU()) for _ in range(layers)]  # smooth, since solvers differentiate it
        self.head = nn.Sequential(first, *hidden, last)
        self.decoder = ImageDecoder(latent_dim)

    def predict(self, code: Tensor, pose: Tensor) -> Gaussian:
        """The Gaussian over the target's latents for codes `[..., code_dim]` of sources, relative poses `[..., 3]`."""
        mean, log_spread = self.head(steer(code, pose, self.orders)).chunk(2, dim=-1)
        return Gaussian(mean, log_spread)


def predicted_noise(noisy: Tensor, alpha: Tensor, predicted: Gaussian) -> Tensor:
    """epsilon_theta: the expected noise in `noisy` `[..., D]`, given that the clean latents are as `predicted`.

    With z = sqrt(alpha) z_0 + sqrt(1 - alpha) epsilon and z_0 ~ N(mu, s^2), E[epsilon | z] =
    sqrt(1 - alpha) (z - sqrt(alpha) mu) / (alpha s^2 + 1 - alpha); `alpha` (alpha-bar_t) broadcasts to `[..., 1]`.
    """
    variance = alpha * (2 * predicted.log_spread).exp() + (1 - alpha)
    return (1 - alpha).sqrt() * (noisy - alpha.sqrt() * predicted.mean) / variance
