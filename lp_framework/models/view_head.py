"""An auxiliary linear readout of the relative pose from the features, for training. Ours, not the paper's.

As long as the features contain no longitude, the score objective has a saddle point where training stalls. This readout
maps a view's features to a complex number u, a latitude and a radius, and penalises errors of a pair's differences; for
the longitude, u_q conj(u_r) should be exp(i dlongitude). `model.view_loss=0` gives the paper's objective.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lp_framework.data.pairs import PairBatch

# One over the spread of latitude differences (radians) and radius differences (scene units) of the paper's views.
SCALE = (2.0, 3.0)


def scaled(pose: Tensor) -> Tensor:
    """Latitudes and radii `[..., 2]` of relative poses `[..., 3]`, each multiplied by its `SCALE`."""
    # Plain numbers, because a tensor would be copied to the device at every step.
    return torch.stack([pose[..., 0] * SCALE[0], pose[..., 2] * SCALE[1]], dim=-1)


def relative_pose_loss(readout: Tensor, batch: PairBatch) -> Tensor:
    """Mean squared error of the batch's relative poses (a scalar), given the `readout` `[I, 4]` of its views: real and
    imaginary part of the longitude's phase, scaled latitude and radius."""
    readout, true = readout.float(), batch.relative_poses()  # there are no complex bfloat16 numbers
    phase = torch.complex(readout[:, 0], readout[:, 1])
    turn = phase[batch.query] * phase[batch.reference].conj()
    difference = readout[batch.query, 2:] - readout[batch.reference, 2:]
    error = difference - scaled(true)
    longitude = torch.view_as_real(turn - torch.polar(torch.ones_like(true[:, 1]), true[:, 1]))
    return longitude.square().sum(dim=-1).mean() + error.square().mean()
