"""The pose network (paper, appendix "Model Architecture and Hyperparameters")."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class PoseEmbedding(nn.Module):
    """Sines and cosines of a relative pose `[..., 3]` at doubling frequencies: `[..., 6 * frequencies]`.

    With `periodic`, longitudes 0 and 2 pi have the same embedding; the paper's target on the line distinguishes them.
    """

    def __init__(self, frequencies: int = 4, periodic: bool = True) -> None:
        super().__init__()
        doubling = 2.0 ** torch.arange(frequencies)
        longitude = doubling if periodic else doubling / 4
        self.frequencies = nn.Buffer(torch.stack([doubling, longitude, doubling]), persistent=False)
        self.dim = 6 * frequencies

    def forward(self, pose: Tensor) -> Tensor:
        phase = (pose[..., None] * self.frequencies).flatten(-2)
        return torch.cat([phase.sin(), phase.cos()], dim=-1)


class ResidualLayer(nn.Module):
    """x + activation(norm(W x)), width unchanged."""

    def __init__(self, width: int, *activation: nn.Module) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(width, width), nn.LayerNorm(width), *activation)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x)


class PoseNetwork(nn.Module):
    """Residual MLP on (reference features, query features, embedded pose): `[..., outputs]`.

    The first layer is split into one linear map per input, so that the image part is computed only once (`project`).
    """

    def __init__(
        self, feature_dim: int, outputs: int, hidden: int, layers: int, frequencies: int, periodic: bool, dropout: float
    ) -> None:
        super().__init__()
        self.embedding = PoseEmbedding(frequencies, periodic)
        self.reference = nn.Linear(feature_dim, hidden)
        self.query = nn.Linear(feature_dim, hidden, bias=False)
        self.pose = nn.Linear(self.embedding.dim, hidden, bias=False)
        residual = [ResidualLayer(hidden, nn.ReLU(), nn.Dropout(dropout)) for _ in range(layers)]
        self.residual = nn.Sequential(*residual)
        self.output = nn.Linear(hidden, outputs)

    def project(self, reference: Tensor, query: Tensor) -> Tensor:
        """The image part of the first layer: `[P, hidden]` for features `[P, feature_dim]` of each side."""
        return self.reference(reference) + self.query(query)

    def forward(self, images: Tensor, pose: Tensor) -> Tensor:
        """`[..., outputs]` for projected image pairs `[..., hidden]` and relative poses `[..., 3]`."""
        return self.output(self.residual(images + self.pose(self.embedding(pose))))
