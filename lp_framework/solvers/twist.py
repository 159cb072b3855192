"""iFusion (Wu et al. 2023): a query's pose by descending a pose-conditioned diffusion prior's energy over twists.

A relative pose is the camera at (latitude, longitude, norm) around a canonical object, whose norm stands for the
relative radius by a *radius map*. It moves by a twist xi `[..., 6]`, translation first: T = T_start exp(xi); latitude,
longitude and norm are read back from the translation of T.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from lp_framework.errors import UserError, at_least, check_settings, positive
from lp_framework.geometry import camera_to_world, se3_exp, view_pose
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.base import Cost, Pairs, Solution, Solver, choose, timed
from lp_framework.solvers.descent import Adam, Descended, Energy, Plateau, descend, unwrapped
from lp_framework.solvers.pair_energy import PairEnergy

ChooseBy = Literal["accumulated", "rescored"]


class SineRadius:
    """iFusion's: radius = 0.8 sin(norm - 1). It reaches 0.8, where its slope is 0, and at norm 0 down to -0.67.

    As of every radius map, `radius` is elementwise and differentiable, and `norm` is its inverse for starts' radii.
    """

    REACH = 0.8
    LEAST = -REACH * math.sin(1)

    def radius(self, norm: Tensor) -> Tensor:
        return self.REACH * (norm - 1).sin()

    def norm(self, radius: Tensor) -> Tensor:
        """`UserError` where no norm stands for it."""
        if ((radius <= self.LEAST) | (radius >= self.REACH)).any():
            raise UserError(f"this solver takes starts with relative radii between {self.LEAST:.2f} and {self.REACH}")
        return 1 + (radius / self.REACH).asin()


class TanhRadius:
    """radius = tanh(log norm) = (norm^2 - 1) / (norm^2 + 1): 0 at norm 1, as iFusion's, but with an inverse.

    Starts are brought within `LIMIT` of 0: views at radii from 1.2 to 2.0 differ by no more.
    """

    LIMIT = 0.8

    def radius(self, norm: Tensor) -> Tensor:
        return norm.log().tanh()

    def norm(self, radius: Tensor) -> Tensor:
        return radius.clamp(-self.LIMIT, self.LIMIT).atanh().exp()


RadiusMap = SineRadius | TanhRadius


class TwistPoses:
    """Relative poses `[..., 3]` of twists `[..., 6]` from starts `[..., 3]`, which are those of zero twists.

    A relative latitude may be of any size, a camera's may not, and near the poles its longitude is worth little: a
    start's camera is at most `HIGHEST` (radians) high, and the rest is added to what is read back.
    """

    HIGHEST = math.pi / 3

    def __init__(self, starts: Tensor, radius_map: RadiusMap) -> None:
        latitude, longitude, radius = starts.unbind(-1)
        within = latitude.clamp(-self.HIGHEST, self.HIGHEST)
        self.rest, self.radius_map = latitude - within, radius_map
        self.cameras = camera_to_world(torch.stack([within, longitude, radius_map.norm(radius)], dim=-1))

    def __call__(self, twist: Tensor) -> Tensor:
        """Longitudes are in [0, 2 pi)."""
        # Elementwise, as in `se3`: a matrix product would lose digits in TF32.
        moved = (self.cameras[..., :, :, None] * se3_exp(twist)[..., None, :, :]).sum(-2)
        latitude, longitude, norm = view_pose(moved).unbind(-1)
        return torch.stack([latitude + self.rest, longitude, self.radius_map.radius(norm)], dim=-1)


@dataclass(eq=False)
class TwistDescent(Solver):
    """iFusion's descent of the prior's energy from every start: twists by Adam, the timestep falling with the step.

    `choose_by`: `accumulated`, the least sum of the losses on the way (published); `rescored`, the least mean error of
    the final poses on `rescoring` noises and timesteps that are the same for all starts of a pair.
    """

    prior: Prior
    steps: int = 100
    learning_rate: float = 0.1
    factor: float = 0.6
    patience: int = 10
    first_timestep: int = 999
    last_timestep: int = 0
    choose_by: ChooseBy = "accumulated"
    rescoring: int = 16
    fresh_noise: bool = True
    trajectory: bool = False
    radius_map: ClassVar[RadiusMap] = TanhRadius()

    def __post_init__(self) -> None:
        first, last, known = self.first_timestep, self.last_timestep, self.prior.num_timesteps
        positive("solver", learning_rate=self.learning_rate)
        at_least(0, "solver", patience=self.patience)
        at_least(1, "solver", rescoring=self.rescoring)
        check_settings(
            "solver",
            ("factor", self.factor, 0 < self.factor <= 1, "above 0 and at most 1"),
            ("last_timestep", last, 0 <= last <= first, "from 0 to first_timestep"),
            ("first_timestep", first, first < known, f"below the prior's {known} timesteps"),
        )

    @timed
    @torch.inference_mode(False)
    @torch.no_grad()
    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        """See `Solver.solve`. A start whose energy or gradient is not finite stops at its last pose and is invalid."""
        energy = PairEnergy(self.prior, pairs, seed)

        def of_step(poses: Tensor, step: int) -> Tensor:
            noise = energy.noise(step if self.fresh_noise else 0)[:, 0]
            return energy(poses, self.timestep(step / self.steps), noise)

        to_poses = TwistPoses(starts.clone(), self.radius_map)
        trajectory, energies, valid = self.descend(of_step, to_poses, starts.new_zeros(*starts.shape[:2], 6))
        ends = trajectory[:, :, -1]
        if self.choose_by == "rescored":
            noise = energy.noise(self.steps, self.rescoring)
            energies = energy.mean(ends, self.rescoring_timesteps(), noise)
            valid = valid & energies.isfinite()
        energies = energies.masked_fill(~valid, torch.nan)
        path = unwrapped(trajectory) if self.trajectory else None
        return Solution(ends, energies, valid, choose(energies), Cost(energy.passes), trajectory=path)

    def timestep(self, done: float) -> int:
        """The timestep when a share `done` in [0, 1) of the way from the first to the last is behind."""
        span = self.first_timestep + 1 - self.last_timestep
        return min(round(self.last_timestep + (1 - done) * span), self.first_timestep)

    def rescoring_timesteps(self) -> list[int]:
        """Those on which final poses are compared, spread over the whole way."""
        return [self.timestep((number + 0.5) / self.rescoring) for number in range(self.rescoring)]

    def descend(self, energy: Energy, pose_of: Callable[[Tensor], Tensor], twist: Tensor) -> Descended:
        """`descent.descend` by Adam and the plateau schedule, from twists `[B, N, D]`."""
        adam = Adam(twist, self.learning_rate)
        return descend(energy, pose_of, twist, self.steps, adam, Plateau(adam, self.factor, self.patience))


@register("solver", "ifusion")
class IFusion(TwistDescent):
    """iFusion: Adam on a twist for each start, down the prior's energy in both directions.

    Defaults are the published settings; its starts are `ring`. The plateau schedule is fed with the accumulated loss,
    as in the published code, so the rate is multiplied by `factor` after the first `patience` + 2 steps and then every
    `patience` + 1. Left out: the published code drops each condition in 5% of the steps.
    """

    radius_map = SineRadius()

    def __post_init__(self) -> None:
        at_least(1, "solver", steps=self.steps)
        super().__post_init__()
