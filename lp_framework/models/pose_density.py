"""Closed-form probability densities of the relative pose, and the paper's smoothing of them.

The density is a product of the exponential of a Fourier series in the longitude (smooth, periodic, any number of modes,
normalised on a grid) and Gaussians in latitude and radius. Denoising score matching aims at the score of the density
convolved with the noise (paper, Proposition 1 in "Theoretical Justification"). Here that score needs no training:
convolution with a Gaussian multiplies the k-th harmonic of a periodic density by exp(-k^2 sigma^2 / 2), and adds
sigma^2 to the variance of a Gaussian.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from lp_framework.geometry import wrap_angle

GRID = 144  # longitudes at which densities are normalised, 2.5 degrees apart


@dataclass(frozen=True)
class PoseDensity:
    """Densities of P relative poses.

    `logits` `[P, GRID]`: log-densities at longitudes 0, 2 pi / GRID, ..., up to a constant; `mean` and `deviation`
    `[P, 2]` of latitude (radians) and radius (scene units); `sigma` (radians and scene units): standard deviation of
    the noise that `smoothed` convolves them with. Can be indexed and unsqueezed along P, like a model's conditions.
    """

    logits: Tensor
    mean: Tensor
    deviation: Tensor
    sigma: float = 1.0

    def __getitem__(self, index: Any) -> PoseDensity:
        return PoseDensity(self.logits[index], self.mean[index], self.deviation[index], self.sigma)

    @property
    def probabilities(self) -> Tensor:
        """Probabilities of the grid's longitudes, `[P, GRID]`."""
        return self.logits.softmax(dim=-1)

    def smoothed(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Score `[..., 3]` and energy `[...]` at poses `[..., 3]` of the density convolved with N(0, sigma^2).

        The energy is -log of the normalised density, so energies of different pairs are comparable.
        """
        order = torch.arange(GRID // 2, device=pose.device)
        harmonics = torch.fft.rfft(self.probabilities)[..., :-1] / (2 * math.pi)
        weight = torch.where(order == 0, 1.0, 2.0) * torch.exp(-0.5 * (order * self.sigma).square())
        phase = pose[..., 1:2] * order
        real, imaginary = weight * harmonics.real, weight * harmonics.imag
        # Rounding can make a tiny density negative.
        density = (real * phase.cos() - imaginary * phase.sin()).sum(dim=-1).clamp(min=1e-7)
        slope = (-order * (real * phase.sin() + imaginary * phase.cos())).sum(dim=-1)
        variance = self.deviation.square() + self.sigma**2
        offset = pose[..., ::2] - self.mean
        score = -offset / variance
        energy = -density.log() + 0.5 * (offset.square() / variance + (2 * math.pi * variance).log()).sum(dim=-1)
        return torch.stack([score[..., 0], slope / density, score[..., 1]], dim=-1), energy

    def log_prob(self, longitude: Tensor) -> Tensor:
        """Log-densities `[P]` (per radian) at longitudes `[P]`, interpolated by the Fourier series of the grid."""
        order = torch.arange(GRID // 2, device=longitude.device)
        harmonics = torch.fft.rfft(self.logits)[..., :-1] / GRID
        weight = torch.where(order == 0, 1.0, 2.0)
        phase = longitude[..., None] * order
        value = (weight * (harmonics.real * phase.cos() - harmonics.imag * phase.sin())).sum(dim=-1)
        return value - self.logits.logsumexp(dim=-1) - math.log(2 * math.pi / GRID)

    def modes(self, count: int) -> Tensor:
        """The longitudes `[P, count]` of the highest local maxima, refined between grid points by a parabola.

        If there are fewer than `count`, the highest is repeated.
        """
        behind, ahead = self.logits.roll(1, -1), self.logits.roll(-1, -1)
        top = (self.logits > behind) & (self.logits >= ahead)
        heights, places = torch.where(top, self.logits, -torch.inf).topk(count, dim=-1)
        places = torch.where(heights.isfinite(), places, places[..., :1])
        left, middle, right = (each.gather(-1, places) for each in (behind, self.logits, ahead))
        shift = 0.5 * (left - right) / (left - 2 * middle + right).clamp(max=-1e-6)
        return torch.remainder((places + shift.clamp(-0.5, 0.5)) * (2 * math.pi / GRID), 2 * math.pi)

    def probability(self, pose: Tensor, degrees: float) -> Tensor:
        """Probability `[...]` that the true rotation lies within `degrees` of those of relative poses `[..., 3]`.

        The angle between two upright cameras does not depend on the unknown latitude of the reference: the cosine of
        half this angle is the product of the cosines of half the difference in latitude and in longitude. The angle
        between their viewing directions is never larger.
        """
        reach = math.cos(math.radians(degrees) / 2)
        grid = torch.arange(GRID, device=pose.device) * (2 * math.pi / GRID)
        away = wrap_angle(grid - pose[..., 1:2])
        half = 2 * (reach / (away / 2).cos().clamp(min=1e-6)).clamp(max=1).acos()  # half range of latitude
        off, spread = pose[..., :1] - self.mean[..., :1], math.sqrt(2) * self.deviation[..., :1]
        band = (((off + half) / spread).erf() - ((off - half) / spread).erf()) / 2
        return (self.probabilities * band).sum(dim=-1)


def from_bins(logits: Tensor) -> Tensor:
    """Interpolate log-densities `[..., bins]` to `[..., GRID]` by Fourier series; `bins` is even and divides GRID."""
    bins = logits.shape[-1]
    harmonics = torch.fft.rfft(logits.float())
    harmonics = torch.cat([harmonics[..., :-1], harmonics[..., -1:] / 2], dim=-1)  # half of it has order -bins / 2
    return torch.fft.irfft(harmonics * (GRID / bins), n=GRID)
