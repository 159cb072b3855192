"""The paper's method: a learned score leads every start to the right valley, the prior's energy to its bottom."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from lp_framework.errors import check_settings
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.base import Cost, Pairs, Solution, Solver, choose
from lp_framework.solvers.langevin import Langevin
from lp_framework.solvers.twist import ChooseBy, DescentSettings, TanhRadius, TwistDescent


@register("solver", "two_stage")
class TwoStage(Solver):
    """The paper's method: `langevin` on a score or energy model, then iFusion's descent of the prior from its ends.

    Defaults are the paper's (appendix, Two Stage Optimization); the second stage's settings are those of `ifusion`, its
    radii go by `TanhRadius`, since the first may end at any. Without refinement steps it is the first stage alone.
    """

    def __init__(
        self,
        model: PoseModel,
        prior: Prior,
        alpha: float = 0.1,
        gamma: float | Sequence[float] = (0.0, 0.3, 0.0),
        iterations: int = 50,
        refinement_steps: int = 50,
        learning_rate: float = 0.1,
        factor: float = 0.7,
        patience: int = 10,
        first_timestep: int = 99,
        last_timestep: int = 0,
        choose_by: ChooseBy = "accumulated",
        rescoring: int = 16,
        trajectory: bool = False,
    ) -> None:
        check_settings("solver", ("refinement_steps", refinement_steps, refinement_steps >= 0, "at least 0"))
        self.model, self.prior = model, prior
        self.first = Langevin(model, alpha, gamma, iterations, trajectory=trajectory)
        settings = DescentSettings(
            refinement_steps, learning_rate, factor, patience, first_timestep, last_timestep, choose_by, rescoring
        )
        self.second = TwistDescent(prior, TanhRadius(), settings, trajectory)

    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        """See `Solver.solve`. A start is invalid when the model or the prior failed on its way."""
        first = self.first.solve(pairs, starts, seed)
        if self.second.settings.steps == 0:
            return first
        return in_a_row(first, lambda ends: self.second.solve(pairs, ends, seed))


def in_a_row(first: Solution, second: Callable[[Tensor], Solution]) -> Solution:
    """The solution of `second` from the ends of `first` `[B, N, 3]`, with trajectory and cost of both.

    A start is invalid where either failed; where the first did, it stays there.
    """
    # A start that failed goes along at the origin, so that the others stay in their places.
    after = second(first.poses.masked_fill(~first.valid[..., None], 0.0))
    energies = after.energies.masked_fill(~first.valid, torch.nan)
    return Solution(
        poses=torch.where(first.valid[..., None], after.poses, first.poses),
        energies=energies,
        valid=first.valid & after.valid,
        chosen=choose(energies),
        cost=Cost(first.cost.network_passes + after.cost.network_passes, first.cost.seconds + after.cost.seconds),
        trajectory=_joined(first.trajectory, after.trajectory),
    )


def _joined(first: Tensor | None, second: Tensor | None) -> Tensor | None:
    """Both trajectories, the second's longitudes in the turn where the first ended; the hand-over counts once."""
    if first is None or second is None:
        return None
    after = second[:, :, 1:]
    turns = ((first[:, :, -1:, 1] - second[:, :, :1, 1]) / (2 * math.pi)).round()
    after = torch.stack([after[..., 0], after[..., 1] + 2 * math.pi * turns, after[..., 2]], dim=-1)
    return torch.cat([first, after], dim=2)  # where the first stage failed the turns are NaN
