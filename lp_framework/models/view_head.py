"""A second, linear readout of the features that shows training the way to the relative pose. Ours, not the paper's.

The score objective is a sum over pairs of noised poses around relative longitudes; starting from features in which
the longitude is not yet apparent its gradient all but vanishes (the optimum of a network that ignores the longitude is
a saddle), and training stays there for long. This readout maps a view's features to a complex number u, a latitude and
a radius, and asks that a pair's differences be right: u_q conj(u_r) = exp(i dlongitude). Where an object's longitude
starts is left to the network, so no object gets a parameter of its own. `model.view_loss=0` is the paper's objective.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lp_framework.data.pairs import PairBatch


class ViewHead(nn.Module):
    """Linear map of features `[I, D]` to (real and imaginary part of the longitude's phase, latitude, radius)."""

    # One over the spread of latitude differences (radians) and radius differences (scene units) of the paper's views.
    SCALE = (2.0, 3.0)

    def __init__(self, feature_dim: int) -> None:
        super().__init__()
        self.readout = nn.Linear(feature_dim, 4)

    def loss(self, features: Tensor, batch: PairBatch) -> Tensor:
        """Mean squared error of the relative pose over the batch's pairs."""
        values = self.readout(features).float()
        true = batch.relative_poses()
        phase = torch.complex(values[:, 0], values[:, 1])
        turn = phase[batch.query] * phase[batch.reference].conj()
        difference = values[batch.query, 2:] - values[batch.reference, 2:]
        error = difference - true[:, ::2] * true.new_tensor(self.SCALE)
        longitude = torch.view_as_real(turn - torch.polar(torch.ones_like(true[:, 1]), true[:, 1]))
        return longitude.square().sum(dim=-1).mean() + error.square().mean()
