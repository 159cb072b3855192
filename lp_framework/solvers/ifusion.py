"""iFusion (Wu et al. 2023): the pose of a query by inverting a pose-conditioned diffusion model."""

from __future__ import annotations

from lp_framework.errors import check_settings
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.twist import ChooseBy, DescentSettings, SineRadius, TwistDescent


@register("solver", "ifusion")
class IFusion(TwistDescent):
    """iFusion: Adam on a twist for each start, down the prior's energy in both directions.

    Defaults are the published settings; its starts are `ring`. The plateau schedule is fed with the accumulated loss,
    as in the published code: a sum of squares does not fall, so the rate is multiplied by `factor` after the first
    `patience` + 2 steps and then every `patience` + 1.

    `choose_by`: `accumulated`, the least sum of the losses on the way (published); `rescored`, the least mean error of
    the final poses on `rescoring` noises and timesteps that are the same for all starts of a pair.

    Left out: the published code drops each condition in 5% of the steps, a remainder of the training code.
    """

    def __init__(
        self,
        prior: Prior,
        steps: int = 100,
        learning_rate: float = 0.1,
        factor: float = 0.6,
        patience: int = 10,
        first_timestep: int = 999,
        last_timestep: int = 0,
        choose_by: ChooseBy = "accumulated",
        rescoring: int = 16,
        fresh_noise: bool = True,
        trajectory: bool = False,
    ) -> None:
        check_settings("solver", ("steps", steps, steps >= 1, "at least 1"))
        settings = DescentSettings(
            steps, learning_rate, factor, patience, first_timestep, last_timestep, choose_by, rescoring, fresh_noise
        )
        super().__init__(prior, SineRadius(), settings, trajectory)
