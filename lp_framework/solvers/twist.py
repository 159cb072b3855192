"""iFusion (Wu et al. 2023): gradient descent on the energy of a pose-conditioned diffusion prior, over twists.

A relative pose is represented by a camera at (latitude, longitude, norm) around a canonical object; a *radius map*
converts between norm and relative radius. A twist xi `[..., 6]`, translation first, moves it: T = T_start exp(xi).
Latitude, longitude and norm are read back from the translation of T.
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
from lp_framework.solvers.descent import Adam, Descent, Energy, Plateau, descend, unwrapped
from lp_framework.solvers.pair_energy import PairEnergy

ChooseBy = Literal["accumulated", "rescored"]


class SineRadius:
    """iFusion's map: radius = 0.8 sin(norm - 1). Its maximum is 0.8, where the slope is 0; at norm 0 it is -0.67.

    For every radius map, `radius` is elementwise and differentiable, and `norm` is its inverse on the starts' radii.
    """

    REACH = 0.8
    LEAST = -REACH * math.sin(1)

    def radius(self, norm: Tensor) -> Tensor:
        return self.REACH * (norm - 1).sin()

    def norm(self, radius: Tensor) -> Tensor:
        """Raises `UserError` for a radius without a norm."""
        if ((radius <= self.LEAST) | (radius >= self.REACH)).any():
            raise UserError(f"this solver takes starts with relative radii between {self.LEAST:.2f} and {self.REACH}")
        return 1 + (radius / self.REACH).asin()


class TanhRadius:
    """radius = tanh(log norm) = (norm^2 - 1) / (norm^2 + 1): 0 at norm 1 like iFusion's, but invertible.

    Starts are clamped to within `LIMIT` of 0: the radii of views, 1.2 to 2.0, differ by no more than that.
    """

    LIMIT = 0.8

    def radius(self, norm: Tensor) -> Tensor:
        return norm.log().tanh()

    def norm(self, radius: Tensor) -> Tensor:
        return radius.clamp(-self.LIMIT, self.LIMIT).atanh().exp()


RadiusMap = SineRadius | TanhRadius


class TwistPoses:
    """Map twists `[..., 6]` to relative poses `[..., 3]`; a zero twist gives the start `[..., 3]`.

    A relative latitude can have any size, but a camera's cannot, and its longitude is ill-conditioned near the poles.
    The latitude of a start's camera is therefore clamped to `HIGHEST` (radians); the rest is added when reading back.
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
    """iFusion's descent on the prior's energy from every start: Adam on twists, with a decreasing timestep.

    `choose_by`: `accumulated`, the lowest sum of losses along the trajectory (published); `rescored`, the lowest mean
    error of the final pose over `rescoring` noises and timesteps shared by all starts of a pair.
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
        """See `Solver.solve`. A start with a non-finite energy or gradient stops at its last pose and is invalid."""
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
        """The timestep at fraction `done` in [0, 1) of the schedule from `first_timestep` to `last_timestep`."""
        span = self.first_timestep + 1 - self.last_timestep
        return min(round(self.last_timestep + (1 - done) * span), self.first_timestep)

    def rescoring_timesteps(self) -> list[int]:
        """The timesteps for comparing final poses, spread over the whole schedule."""
        return [self.timestep((number + 0.5) / self.rescoring) for number in range(self.rescoring)]

    def descend(self, energy: Energy, pose_of: Callable[[Tensor], Tensor], twist: Tensor) -> Descent:
        """Run `descent.descend` with Adam and the plateau schedule from twists `[B, N, D]`."""
        adam = Adam(twist, self.learning_rate)
        return descend(energy, pose_of, twist, self.steps, adam, Plateau(adam, self.factor, self.patience))


@register("solver", "ifusion")
class IFusion(TwistDescent):
    """iFusion: Adam on a twist for each start, minimizing the prior's energy in both directions.

    Defaults are the published settings; use with `start=ring`. As in the published code, the plateau schedule gets the
    accumulated loss, so the rate is multiplied by `factor` after the first `patience` + 2 steps and then every
    `patience` + 1. Unlike the published code, conditions are never dropped (there: each in 5% of the steps).
    """

    radius_map = SineRadius()

    def __post_init__(self) -> None:
        at_least(1, "solver", steps=self.steps)
        super().__post_init__()
