"""Views that a prior generates for a figure."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.priors.base import Prior, ViewCode
from lp_framework.solvers.progress import steps_of
from lp_framework.viz.pictures import as_pixels

AT_ONCE = 16  # views a batch


@torch.no_grad()
def generated_views(prior: Prior, source: ViewCode, poses: Tensor, steps: int, guidance: float, seed: int) -> NDArray:
    """Views `[N, H, W, 3]` in [0, 1] of one image's code under relative poses `[N, 3]`, by DDIM.

    All have the same draws, so that they differ by their poses alone.
    """
    views: list[NDArray] = []
    for number in steps_of(math.ceil(len(poses) / AT_ONCE), "generated views"):
        generator = torch.Generator().manual_seed(seed)  # on the CPU: a GPU gets the same draws
        pose = poses[number * AT_ONCE : (number + 1) * AT_ONCE].to(source.latent)
        repeated = source[torch.zeros(len(pose), dtype=torch.int64, device=pose.device)]
        views += map(as_pixels, prior.generate(repeated, pose, steps, guidance, generator))
    return np.stack(views)
