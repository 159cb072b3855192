"""Views that a prior generates for a figure."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.priors.base import Prior, ViewCode
from lp_framework.solvers.progress import steps_of
from lp_framework.viz.pictures import as_pixels


@torch.no_grad()
def generated_views(prior: Prior, source: ViewCode, poses: Tensor, steps: int, guidance: float, seed: int) -> NDArray:
    """Views `[N, H, W, 3]` in [0, 1] of one image's code under relative poses `[N, 3]`, by DDIM.

    Every view has the same draws, so that they differ by their poses alone.
    """
    views = []
    for number in steps_of(len(poses), "generated views"):
        generator = torch.Generator().manual_seed(seed)  # on the CPU: a GPU gets the same draws
        pose = poses[number : number + 1].to(source.latent)
        views.append(as_pixels(prior.generate(source, pose, steps, guidance, generator)[0]))
    return np.stack(views)
