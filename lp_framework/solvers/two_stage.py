"""The paper's method: a learned score leads every start to the right valley, the prior's energy to its bottom."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from lp_framework.errors import check_settings
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.base import Pairs, Solution, Solver
from lp_framework.solvers.langevin import Langevin
from lp_framework.solvers.stages import in_a_row
from lp_framework.solvers.twist import ChooseBy, TanhRadius, TwistDescent


@register("solver", "two_stage")
class TwoStage(Solver):
    """The paper's method: `langevin` on a score or energy model, then iFusion's descent of the prior from its ends.

    Defaults are the paper's (appendix, Two Stage Optimization). First stage: `alpha`, `gamma`, `iterations`, see
    `langevin`. Second stage: `refinement_steps` with `learning_rate`, `factor`, `patience` and timesteps that fall
    linearly from `first_timestep` to `last_timestep`, see `ifusion`; it hands radii over by `TanhRadius`, since the
    first stage may end at any. Without refinement steps it is the first stage alone.

    The answer is the start of least second-stage energy, `choose_by` as for `ifusion`.
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
        self.second = TwistDescent(
            prior,
            TanhRadius(),
            refinement_steps,
            learning_rate,
            factor,
            patience,
            first_timestep,
            last_timestep,
            choose_by,
            rescoring,
            fresh_noise=True,
            trajectory=trajectory,
        )

    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        """See `Solver.solve`. A start is invalid when the model or the prior failed on its way."""
        first = self.first.solve(pairs, starts, seed)
        if self.second.steps == 0:
            return first
        return in_a_row(first, lambda ends: self.second.solve(pairs, ends, seed))
