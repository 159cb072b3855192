"""Views that a prior generates."""

from __future__ import annotations

import math

import torch
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.priors.base import Prior, ViewCode
from lp_framework.solvers.progress import steps_of


@torch.no_grad()
def generated_views(
    prior: Prior,
    source: ViewCode,
    poses: Tensor,
    steps: int,
    guidance: float,
    seed: int,
    eta: float = 1.0,
    batch: int = 16,
) -> NDArray:
    """Views `[N, H, W, 3]` in [0, 1] of one image's code under relative poses `[N, 3]`, by DDIM, `batch` at once.

    All have the same draws, so that they differ by their poses alone.
    """
    parts = []
    for number in steps_of(math.ceil(len(poses) / batch), "generated views"):
        generator = torch.Generator().manual_seed(seed)  # on the CPU: a GPU gets the same draws
        pose = poses[number * batch : (number + 1) * batch].to(source.latent)
        repeated = source[torch.zeros(len(pose), dtype=torch.int64, device=pose.device)]
        parts.append(prior.generate(repeated, pose, steps, guidance, generator, eta).float().cpu())
    views: NDArray = ((torch.cat(parts) + 1) / 2).clamp(0, 1).permute(0, 2, 3, 1).numpy()
    return views
