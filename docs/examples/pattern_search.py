"""A solver to copy: pattern search on the prior's energy."""

from __future__ import annotations

import torch
from torch import Tensor

from lp_framework.clock import now
from lp_framework.errors import check_settings
from lp_framework.geometry import reduce_longitude
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.base import (
    Cost,
    Pairs,
    Solution,
    Solver,
    check_starts,
    choose,
)
from lp_framework.solvers.pair_energy import PairEnergy

# Stay, or move one way or the other along one coordinate.
DIRECTIONS = torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)])


@register("solver", "pattern_search")
class PatternSearch(Solver):
    """Pattern search (Hooke and Jeeves 1961) on the prior's energy; no gradients."""

    def __init__(
        self, prior: Prior, steps: int = 30, step_size: float = 0.5, timestep: int = 300
    ) -> None:
        check_settings("solver", ("steps", steps, steps >= 1, "at least 1"))
        self.prior = prior
        self.steps, self.step_size, self.timestep = steps, step_size, timestep

    @torch.no_grad()
    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        """See `Solver.solve`. A start that finds no better pose halves its step."""
        check_starts(pairs, starts)
        began = now(starts.device)
        energy = PairEnergy(self.prior, pairs, seed)
        noise = energy.noise(0)[:, 0]  # one draw per pair, for a fair comparison
        pose, size = starts, starts.new_full(starts.shape[:2], self.step_size)
        for _ in range(self.steps):
            moves = size[..., None, None] * DIRECTIONS.to(starts)
            around = pose[:, :, None] + moves  # [B, N, 7, 3]
            energies = energy(around.flatten(1, 2), self.timestep, noise)  # [B, 7 N]
            least, best = energies.view(around.shape[:3]).min(dim=2)  # [B, N]
            pose = torch.take_along_dim(around, best[..., None, None], dim=2).squeeze(2)
            size = torch.where(best == 0, size / 2, size)
        return Solution(
            poses=reduce_longitude(pose),
            energies=least,
            valid=least.isfinite(),
            chosen=choose(least),
            cost=Cost(energy.passes, now(starts.device) - began),
        )
