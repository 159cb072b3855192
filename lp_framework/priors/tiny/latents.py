"""Linear latents of small images, and a decoder back to images."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

IMAGE_SIZE = 64  # pixels a side of what is decoded
LATENT_PIXELS = 32  # of what the latents are taken from


def shrink(images: Tensor) -> Tensor:
    """Pixels `[B, 3 * 64 * 64]` of images `[B, 3, H, W]`, resized with antialiasing."""
    if images.shape[-2:] != (IMAGE_SIZE, IMAGE_SIZE):
        size = [IMAGE_SIZE, IMAGE_SIZE]
        images = functional.interpolate(images, size, mode="bilinear", antialias=True, align_corners=False)
    return images.flatten(1)


def _halve(pixels: Tensor) -> Tensor:
    """Pixels `[B, 3 * 64 * 64]` averaged over 2 x 2: `[B, 3 * 32 * 32]`."""
    factor = IMAGE_SIZE // LATENT_PIXELS
    return functional.avg_pool2d(pixels.view(-1, 3, IMAGE_SIZE, IMAGE_SIZE), factor).flatten(1)


def principal_components(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues `[K]`, falling, and eigenvectors `[D, K]` of rows^T rows, for `rows` `[N, D]`; K = min(N, D)."""
    if len(rows) >= rows.shape[1]:
        values, vectors = torch.linalg.eigh(rows.T @ rows)
    else:  # those of the smaller product, mapped over
        values, vectors = torch.linalg.eigh(rows @ rows.T)
        vectors = functional.normalize(rows.T @ vectors, dim=0)
    return values.flip(0), vectors.flip(1)


class PrincipalLatents(nn.Module):
    """The first `dim` principal components of 32 x 32 images, scaled so that their mean square is `scale`^2.

    A linear map, so that noise of the latents is noise of the image; `spread` `[dim]` are the standard deviations.
    """

    mean: Tensor
    basis: Tensor
    spread: Tensor

    def __init__(self, dim: int, scale: float) -> None:
        super().__init__()
        self.dim, self.scale = dim, scale
        pixels = 3 * LATENT_PIXELS**2
        self.register_buffer("mean", torch.zeros(pixels))
        self.register_buffer("basis", torch.zeros(pixels, dim))  # scaled
        self.register_buffer("spread", torch.zeros(dim))

    @property
    def fitted(self) -> bool:
        """Whether there is a basis."""
        return bool(self.spread.any())

    @torch.no_grad()
    def fit(self, pixels: Tensor) -> None:
        """Take the basis from pixels `[I, 3 * 64 * 64]`; with fewer images than `dim` the rest of it is zero.

        It is computed in float64, so on the CPU.
        """
        small = _halve(pixels.float()).cpu().double()
        mean = small.mean(dim=0)
        variances, vectors = principal_components((small - mean) / len(small) ** 0.5)
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
