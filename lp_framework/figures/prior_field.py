"""The score field that a prior's energy stands for."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lp_framework.models.pose_model import FieldValue
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.progress import steps_of


def prior_field(
    prior: Prior, pairs: Pairs, poses: Tensor, timesteps: Sequence[int], noises: int, seed: int, batch: int = 8
) -> FieldValue:
    """A prior's field at relative poses `[B, N, 3]` of B pairs: minus its energy's gradient, likewise, and the energy.

    The energy `[B, N]` is that of `evaluation.landscape.prior_landscapes`: the mean over timesteps, over `noises` each
    and over both directions, under the same draws. No more than `batch` poses pass the prior at once.
    """
    energy = PairEnergy(prior, pairs, seed)
    steps = [timestep for timestep in timesteps for _ in range(noises)]
    noise = energy.noise(0, count=len(steps))
    parts = poses.split(max(1, batch // len(pairs)), dim=1)
    scores, energies = [], []
    for number in steps_of(len(parts), "gradients of the landscape"):
        variable = parts[number].detach().clone().requires_grad_()
        gradient = torch.zeros_like(variable)
        total = torch.zeros(variable.shape[:2], device=variable.device)
        for place, timestep in enumerate(steps):  # a graph of one at a time is kept
            with torch.enable_grad():
                value = energy(variable, timestep, noise[:, place])
                gradient += torch.autograd.grad(value.sum(), variable)[0]
            total += value.detach()
        scores.append(-gradient / len(steps))
        energies.append(total / len(steps))
    return FieldValue(torch.cat(scores, dim=1), torch.cat(energies, dim=1))
