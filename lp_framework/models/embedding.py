"""Sinusoidal embedding of a pose."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class PoseEmbedding(nn.Module):
    """Sines and cosines of a relative pose `[..., 3]` at doubling frequencies: `[..., 6 * frequencies]`.

    With `periodic` the lowest frequency of the longitude is one a turn, so that 0 and 2 pi are embedded alike; the
    paper's target on the line tells them apart, so there it is half a turn (and a quarter for room beyond the ends).
    """

    frequencies: Tensor

    def __init__(self, frequencies: int = 4, periodic: bool = True) -> None:
        super().__init__()
        doubling = 2.0 ** torch.arange(frequencies)
        longitude = doubling if periodic else doubling / 4
        self.register_buffer("frequencies", torch.stack([doubling, longitude, doubling]), persistent=False)
        self.dim = 6 * frequencies

    def forward(self, pose: Tensor) -> Tensor:
        phase = (pose[..., None] * self.frequencies).flatten(-2)
        return torch.cat([phase.sin(), phase.cos()], dim=-1)
