"""Denoising score matching of the relative pose: the perturbation kernel, the noised pose and the two targets.

Paper: Eq. (3), appendix "Energy-based Modeling", "Closed-Form Expression" and "Theoretical Justification".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from lp_framework.errors import UserError

TURN = 2 * math.pi


class PoseKernel:
    """The Gaussian kernel p_sigma(noised | true) over relative poses `[..., 3]`.

    `line` is the paper's: every coordinate lives on the real line, so longitudes 0 and 2 pi are far apart.
    `periodic` wraps the longitude's Gaussian around the circle, p(d) = sum_k N(d + 2 pi k; 0, sigma^2): its score is
    smooth, vanishes at the truth and at the antipode, and equals the line's where one image of the truth dominates.
    """

    def __init__(self, target: Literal["periodic", "line"] = "periodic", sigma: float = 1.0) -> None:
        if not sigma > 0:
            raise UserError(f"sigma must be above 0, got {sigma}")
        self.sigma = sigma
        self.periodic = target == "periodic"
        # Images of the truth more than 8 sigma away have a weight below float64's epsilon.
        self._turns = math.ceil(0.5 + 8 * sigma / TURN) if self.periodic else 0

    def _images(self, noised: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
        """Offsets noised - true: `[..., 3]`, and the longitude's to every image of the truth `[..., images]`."""
        offset = noised - true
        turns = torch.arange(-self._turns, self._turns + 1, device=offset.device, dtype=offset.dtype) * TURN
        longitude = offset[..., 1:2]
        if self.periodic:
            longitude = torch.remainder(longitude + math.pi, TURN) - math.pi
        return offset, longitude + turns

    def energy(self, noised: Tensor, true: Tensor) -> Tensor:
        """-log p_sigma(noised | true) `[...]` up to a constant: |noised - true|^2 / (2 sigma^2) on the line."""
        offset, images = self._images(noised, true)
        plane = offset[..., 0].square() + offset[..., 2].square()
        return plane / (2 * self.sigma**2) - torch.logsumexp(-images.square() / (2 * self.sigma**2), dim=-1)

    def score(self, noised: Tensor, true: Tensor) -> Tensor:
        """Gradient of log p_sigma(noised | true) in `noised`, `[..., 3]`: (true - noised) / sigma^2 on the line."""
        offset, images = self._images(noised, true)
        weights = torch.softmax(-images.square() / (2 * self.sigma**2), dim=-1)
        longitude = (weights * images).sum(dim=-1)
        return -torch.stack([offset[..., 0], longitude, offset[..., 2]], dim=-1) / self.sigma**2


class NoisedPose:
    """Sampler of noised poses for training.

    `uniform` over a box (the paper's choice): the optimum is the mean of the kernel's scores over all answers
    (Lemma 1). `gaussian` around the truth: the optimum weights the answers by their posterior (Proposition 1).
    """

    def __init__(self, noise: str, sigma: float, low: Sequence[float], high: Sequence[float]) -> None:
        if len(low) != 3 or len(high) != 3 or not all(a < b for a, b in zip(low, high, strict=False)):
            raise UserError(
                f"noise_low={list(low)} and noise_high={list(high)} must be three numbers each "
                "(latitude, longitude, radius), every low below its high"
            )
        self.noise, self.sigma = noise, sigma
        self.low, self.high = list(low), list(high)

    def draw(self, true: Tensor, generator: torch.Generator) -> Tensor:
        """Draw noised poses `[P, 3]` for true relative poses `[P, 3]`, with a generator on the CPU."""
        if self.noise == "gaussian":
            return true + self.sigma * torch.randn(true.shape, generator=generator).to(true)
        return self.place(torch.rand(true.shape, generator=generator)).to(true)

    def place(self, unit: Tensor) -> Tensor:
        """Map uniform draws in [0, 1] `[..., 3]` to the box."""
        low, high = unit.new_tensor(self.low), unit.new_tensor(self.high)
        return low + unit * (high - low)
