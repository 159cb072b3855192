"""Networks of the tiny prior: latents and code of an image, steering by a relative pose, predicted Gaussian."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from lp_framework.models.networks import ResidualLayer
from lp_framework.models.view_head import scaled
from lp_framework.priors.base import resized

IMAGE_SIZE = 64  # side length of decoded images in pixels
LATENT_PIXELS = 32  # side length of the images that latents are computed from
CONSTANT, WAVES = 64, 8  # rotation-invariant entries of a code; waves of each order


def shrink(images: Tensor) -> Tensor:
    """Downsize images `[B, 3, H, W]` to pixels `[B, 3 * 64 * 64]`."""
    return resized(images, IMAGE_SIZE).flatten(1)


def _halve(pixels: Tensor) -> Tensor:
    """Downsize pixels `[B, 3 * 64 * 64]` to `[B, 3 * 32 * 32]`."""
    return functional.avg_pool2d(pixels.view(-1, 3, IMAGE_SIZE, IMAGE_SIZE), 2).flatten(1)


class PrincipalLatents(nn.Module):
    """The first `dim` principal components of 32 x 32 images, scaled so that their mean square is `scale`^2.

    The map is linear, so noise in the latents is noise in the image; `spread` `[dim]` are the standard deviations.
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
        """Fit the basis to pixels `[I, 3 * 64 * 64]`; with fewer images than `dim`, the rest of it is zero."""
        small = _halve(pixels.float()).cpu().double()
        mean = small.mean(dim=0)
        rows = (small - mean) / len(small) ** 0.5
        if len(rows) >= rows.shape[1]:
            variances, vectors = torch.linalg.eigh(rows.T @ rows)
        else:  # eigenvectors of the smaller product, mapped back
            variances, vectors = torch.linalg.eigh(rows @ rows.T)
            vectors = functional.normalize(rows.T @ vectors, dim=0)
        variances, vectors = variances.flip(0), vectors.flip(1)  # in descending order
        missing = max(0, self.dim - len(variances))
        variances = functional.pad(variances[: self.dim].clamp(min=0), (0, missing))
        vectors = functional.pad(vectors[:, : self.dim], (0, missing))
        variances = torch.where(variances > 1e-9 * variances[0], variances, 0)
        vectors = vectors * torch.where(vectors.sum(dim=0) < 0, -1, 1)  # fix the arbitrary sign
        factor = self.scale / variances.mean().sqrt()
        self.mean.copy_(mean)
        self.basis.copy_(vectors * (variances > 0) * factor)
        self.spread.copy_(variances.sqrt() * factor)

    def forward(self, pixels: Tensor) -> Tensor:
        """Latents `[B, dim]` of pixels `[B, 3 * 64 * 64]`."""
        return (_halve(pixels) - self.mean) @ self.basis


class ImageDecoder(nn.Module):
    """Decodes latents `[B, dim]` to images `[B, 3, 64, 64]` in [-1, 1]: linear map to 8 x 8, three upsamplings."""

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
    """Size of a code: a constant part, `orders` x `WAVES` complex waves, and scaled latitude and radius."""
    return CONSTANT + 2 * WAVES * orders + 2


def readout(code: Tensor, orders: int) -> Tensor:
    """The entries `[B, 4]` of codes `[B, code_dim]` that represent the view pose (see `relative_pose_loss`)."""
    waves = code[:, CONSTANT:-2].view(-1, 2, orders, WAVES)
    return torch.cat([waves[:, :, 0, 0], code[:, -2:]], dim=1)


def steer(code: Tensor, pose: Tensor, orders: int) -> Tensor:
    """Transform codes `[..., code_dim]` (see `code_dim`) by relative poses `[..., 3]`.

    A wave of order m rotates by m times the relative longitude; relative latitude and radius are added to theirs.
    """
    constant, waves, place = code[..., :CONSTANT], code[..., CONSTANT:-2], code[..., -2:]
    real, imaginary = waves.unflatten(-1, (2, orders, WAVES)).unbind(dim=-3)
    angle = pose[..., 1:2] * torch.arange(1, orders + 1, device=pose.device, dtype=pose.dtype)
    cosine, sine = angle.cos()[..., None], angle.sin()[..., None]
    turned = torch.stack([real * cosine - imaginary * sine, real * sine + imaginary * cosine], dim=-3)
    moved = place + scaled(pose)
    return torch.cat([constant.expand(*moved.shape[:-1], -1), turned.flatten(-3), moved], dim=-1)


class TinyNetworks(nn.Module):
    """All trained networks and the latents' basis. `predict` is the model p(target's latents | source, pose)."""

    def __init__(self, feature_dim: int, latent_dim: int, scale: float, orders: int, width: int, layers: int) -> None:
        super().__init__()
        self.latent_dim, self.orders = latent_dim, orders
        self.latents = PrincipalLatents(latent_dim, scale)
        self.encoder = nn.Linear(feature_dim, code_dim(orders))
        last = nn.Linear(width, 2 * latent_dim)
        nn.init.zeros_(last.weight[latent_dim:])
        nn.init.constant_(last.bias[latent_dim:], math.log(0.3 * scale))
        first = nn.Linear(code_dim(orders), width)
        hidden = [ResidualLayer(width, nn.SiLU()) for _ in range(layers)]  # smooth, because solvers differentiate it
        self.head = nn.Sequential(first, *hidden, last)
        self.decoder = ImageDecoder(latent_dim)

    def predict(self, code: Tensor, pose: Tensor) -> Gaussian:
        """The Gaussian over the target's latents, given source codes `[..., code_dim]` and poses `[..., 3]`."""
        mean, log_spread = self.head(steer(code, pose, self.orders)).chunk(2, dim=-1)
        return Gaussian(mean, log_spread)


def predicted_noise(noisy: Tensor, alpha: Tensor, predicted: Gaussian) -> Tensor:
    """epsilon_theta: the expected noise in `noisy` `[..., D]` if the clean latents are distributed as `predicted`.

    With z = sqrt(alpha) z_0 + sqrt(1 - alpha) epsilon and z_0 ~ N(mu, s^2), E[epsilon | z] =
    sqrt(1 - alpha) (z - sqrt(alpha) mu) / (alpha s^2 + 1 - alpha); `alpha` (alpha-bar_t) broadcasts to `[..., 1]`.
    """
    variance = alpha * (2 * predicted.log_spread).exp() + (1 - alpha)
    return (1 - alpha).sqrt() * (noisy - alpha.sqrt() * predicted.mean) / variance
