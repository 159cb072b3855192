"""Zero123's conditioning vector, known here and nowhere else."""

from __future__ import annotations

import torch
from torch import Tensor


def conditioning_vector(pose: Tensor) -> Tensor:
    """T = [-dlatitude, sin dlongitude, cos dlongitude, dradius] `[..., 4]` of relative poses `[..., 3]`.

    Zero123 (section 3.2) counts the polar angle down from the pole, so its first entry is minus the difference of
    latitudes; iFusion's (theta, azimuth, distance) has theta = -latitude.

    >>> conditioning_vector(torch.tensor([0.2, 0.0, -0.5]))
    tensor([-0.2000,  0.0000,  1.0000, -0.5000])
    """
    latitude, longitude, radius = pose.unbind(-1)
    return torch.stack([-latitude, longitude.sin(), longitude.cos(), radius], dim=-1)
