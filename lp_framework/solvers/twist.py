"""Poses by twist, and iFusion's descent of a prior's energy over them.

A relative pose is the camera at (latitude, longitude, norm) around a canonical object, whose norm stands for the
relative radius by a *radius map*. It moves by a twist xi `[..., 6]`, translation first: T = T_start exp(xi); latitude,
longitude and norm are read back from the translation of T.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Literal

import torch
from torch import Tensor

from lp_framework.clock import now
from lp_framework.errors import UserError
from lp_framework.geometry import camera_to_world, se3_exp, view_pose
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Cost, Pairs, Solution, Solver, check_starts, choose
from lp_framework.solvers.descent import Adam, Plateau, descend, unwrapped
from lp_framework.solvers.pair_energy import PairEnergy

ChooseBy = Literal["accumulated", "rescored"]


class RadiusMap(ABC):
    """Relative radius of a camera at some distance from the canonical object; both functions are elementwise."""

    @abstractmethod
    def radius(self, norm: Tensor) -> Tensor:
        """The relative radius, differentiable."""

    @abstractmethod
    def norm(self, radius: Tensor) -> Tensor:
        """The norm of a start's relative radius."""


class SineRadius(RadiusMap):
    """iFusion's: radius = 0.8 sin(norm - 1). It reaches 0.8, where its slope is 0, and at norm 0 down to -0.67."""

    REACH = 0.8
    LEAST = -REACH * math.sin(1)

    def radius(self, norm: Tensor) -> Tensor:
        return self.REACH * (norm - 1).sin()

    def norm(self, radius: Tensor) -> Tensor:
        """`UserError` where no norm stands for it."""
        if ((radius <= self.LEAST) | (radius >= self.REACH)).any():
            raise UserError(f"this solver takes starts with relative radii between {self.LEAST:.2f} and {self.REACH}")
        return 1 + (radius / self.REACH).asin()


class TanhRadius(RadiusMap):
    """radius = tanh(log norm) = (norm^2 - 1) / (norm^2 + 1): 0 at norm 1, as iFusion's, but with an inverse.

    Its slope 1 - radius^2 in log norm is positive everywhere, and it keeps within (-1, 1). Starts are brought within
    `LIMIT` of 0: views at radii from 1.2 to 2.0 differ by no more.
    """

    LIMIT = 0.8

    def radius(self, norm: Tensor) -> Tensor:
        return norm.log().tanh()

    def norm(self, radius: Tensor) -> Tensor:
        return radius.clamp(-self.LIMIT, self.LIMIT).atanh().exp()


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


class TwistDescent(Solver):
    """iFusion's descent of the prior's energy from every start: twists by Adam, the timestep falling with the step."""

    def __init__(
        self,
        prior: Prior,
        radius_map: RadiusMap,
        steps: int,
        learning_rate: float,
        factor: float,
        patience: int,
        first_timestep: int,
        last_timestep: int,
        choose_by: ChooseBy,
        rescoring: int,
        fresh_noise: bool,
        trajectory: bool,
    ) -> None:
        for name, value, fits, wanted in (
            ("learning_rate", learning_rate, learning_rate > 0, "positive"),
            ("factor", factor, 0 < factor <= 1, "above 0 and at most 1"),
            ("patience", patience, patience >= 0, "at least 0"),
            ("rescoring", rescoring, rescoring >= 1, "at least 1"),
            ("last_timestep", last_timestep, 0 <= last_timestep <= first_timestep, "from 0 to first_timestep"),
            (
                "first_timestep",
                first_timestep,
                first_timestep < prior.num_timesteps,
                f"below the prior's {prior.num_timesteps} timesteps",
            ),
        ):
            if not fits:
                raise UserError(f"solver.{name} must be {wanted}, got {value}")
        self.prior, self.radius_map = prior, radius_map
        self.steps, self.learning_rate, self.factor, self.patience = steps, learning_rate, factor, patience
        self.first_timestep, self.last_timestep = first_timestep, last_timestep
        self.choose_by, self.rescoring = choose_by, rescoring
        self.fresh_noise, self.trajectory = fresh_noise, trajectory

    def timestep(self, done: float) -> int:
        """The timestep when a share `done` in [0, 1) of the way from the first to the last is behind."""
        span = self.first_timestep + 1 - self.last_timestep
        return min(round(self.last_timestep + (1 - done) * span), self.first_timestep)

    @torch.inference_mode(False)
    @torch.no_grad()
    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        """See `Solver.solve`. A start whose energy or gradient is not finite stops at its last pose and is invalid."""
        check_starts(pairs, starts)
        began = now(starts.device)
        energy = PairEnergy(self.prior, pairs, seed)
        twist = starts.new_zeros(*starts.shape[:2], 6)
        adam = Adam(twist, self.learning_rate)

        def of_step(poses: Tensor, step: int) -> Tensor:
            noise = energy.noise(step if self.fresh_noise else 0)[:, 0]
            return energy(poses, self.timestep(step / self.steps), noise)

        path, energies, valid = descend(
            of_step,
            TwistPoses(starts.clone(), self.radius_map),
            twist,
            self.steps,
            adam,
            Plateau(adam, self.factor, self.patience),
        )
        poses = path[:, :, -1]
        if self.choose_by == "rescored":
            timesteps = [self.timestep((number + 0.5) / self.rescoring) for number in range(self.rescoring)]
            energies = energy.mean(poses, timesteps, energy.noise(self.steps, self.rescoring))
            valid = valid & energies.isfinite()
        energies = energies.masked_fill(~valid, torch.nan)
        return Solution(
            poses=poses,
            energies=energies,
            valid=valid,
            chosen=choose(energies),
            cost=Cost(network_passes=energy.passes, seconds=now(starts.device) - began),
            trajectory=unwrapped(path) if self.trajectory else None,
        )
