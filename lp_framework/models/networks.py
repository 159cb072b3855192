"""The pose network: features of two images and a noised pose in, a score or an energy out.

Paper, appendix "Model Architecture and Hyperparameters".
"""

from __future__ import annotations

from torch import Tensor, nn

from lp_framework.models.embedding import PoseEmbedding


class ResidualLayer(nn.Module):
    """x + relu(norm(W x)), width unchanged."""

    def __init__(self, width: int, dropout: float) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(width, width), nn.LayerNorm(width), nn.ReLU(), nn.Dropout(dropout))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x)


class PoseNetwork(nn.Module):
    """Residual MLP on (reference features, query features, embedded pose): `[..., outputs]`.

    The first layer is a linear map of the concatenated input, kept as one map an input: an image's part is computed
    once (`project`) and shared by all pairs, noised poses and solver steps that meet the image.
    """

    def __init__(
        self, feature_dim: int, outputs: int, hidden: int, layers: int, frequencies: int, periodic: bool, dropout: float
    ) -> None:
        super().__init__()
        self.embedding = PoseEmbedding(frequencies, periodic)
        self.reference = nn.Linear(feature_dim, hidden)
        self.query = nn.Linear(feature_dim, hidden, bias=False)
        self.pose = nn.Linear(self.embedding.dim, hidden, bias=False)
        self.residual = nn.Sequential(*(ResidualLayer(hidden, dropout) for _ in range(layers)))
        self.output = nn.Linear(hidden, outputs)

    def project(self, reference: Tensor, query: Tensor) -> Tensor:
        """The image part of the first layer: `[P, hidden]` for features `[P, feature_dim]` of each side."""
        return self.reference(reference) + self.query(query)

    def forward(self, images: Tensor, pose: Tensor) -> Tensor:
        """`[..., outputs]` for projected image pairs `[..., hidden]` and relative poses `[..., 3]`."""
        return self.output(self.residual(images + self.pose(self.embedding(pose))))
