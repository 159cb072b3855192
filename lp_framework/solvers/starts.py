"""Starts: the initial relative poses from which a solver descends."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor

from lp_framework.errors import UserError, at_least, check_settings
from lp_framework.keyed_random import keyed_uniform
from lp_framework.models.pose_model import PoseModel
from lp_framework.registry import register
from lp_framework.solvers.base import NetworkUser, Pairs

_STARTS = 0x5747  # gives starts and solvers independent draws under the same seed


class Starts(NetworkUser, ABC):
    """Makes `count` initial poses per pair. The constructor may take a `model` or a `prior`, as for a solver."""

    count: int

    @abstractmethod
    def make(self, pairs: Pairs, seed: int) -> Tensor:
        """Relative poses `[B, count, 3]` (radians, radians, scene units), float32, on the device of the pairs.

        The starts of a pair depend only on its images, its id and `seed`.
        """


@register("start", "ring")
class Ring(Starts):
    """`count` evenly spaced longitudes at one latitude (radians); iFusion uses 0, 90, 180, 270 degrees."""

    def __init__(self, count: int = 4, latitude: float = 0.0) -> None:
        at_least(1, "start", count=count)
        self.count, self.latitude = count, latitude

    def make(self, pairs: Pairs, seed: int) -> Tensor:
        longitude = torch.arange(self.count, device=pairs.ids.device) * (2 * math.pi / self.count)
        poses = torch.stack([torch.full_like(longitude, self.latitude), longitude, torch.zeros_like(longitude)], dim=-1)
        return poses.expand(len(pairs), -1, -1)


@register("start", "grid")
class Grid(Starts):
    """A grid of latitudes and longitudes (degrees); the paper's nine are -30, 0, 30 times 0, 120, 240."""

    def __init__(
        self,
        latitudes_degrees: Sequence[float] = (-30.0, 0.0, 30.0),
        longitudes_degrees: Sequence[float] = (0.0, 120.0, 240.0),
    ) -> None:
        if not latitudes_degrees or not longitudes_degrees:
            raise UserError("start.latitudes_degrees and start.longitudes_degrees need at least one angle each")
        self.poses = [(math.radians(a), math.radians(b), 0.0) for a in latitudes_degrees for b in longitudes_degrees]
        self.count = len(self.poses)

    def make(self, pairs: Pairs, seed: int) -> Tensor:
        return torch.tensor(self.poses, device=pairs.ids.device).expand(len(pairs), -1, -1)


@register("start", "random")
class Random(Starts):
    """`count` starts drawn uniformly: latitude within `latitude` (radians) of 0, any longitude, relative radius 0."""

    def __init__(self, count: int = 4, latitude: float = math.pi / 6) -> None:
        at_least(1, "start", count=count)
        check_settings("start", ("latitude", latitude, 0 <= latitude < math.pi / 2, "in [0, pi/2)"))
        self.count, self.latitude = count, latitude

    def make(self, pairs: Pairs, seed: int) -> Tensor:
        uniform = keyed_uniform(seed, _STARTS, pairs.ids[:, None], torch.arange(self.count), count=2)
        latitude, longitude = (2 * uniform[..., 0] - 1) * self.latitude, uniform[..., 1] * 2 * math.pi
        return torch.stack([latitude, longitude, torch.zeros_like(latitude)], dim=-1).float().to(pairs.ids.device)


@register("start", "modes")
class Modes(Starts):
    """The `count` most likely relative poses under the model's density, best first (`model=matching`)."""

    def __init__(self, model: PoseModel, count: int = 4) -> None:
        at_least(1, "start", count=count)
        self.model, self.count = model, count

    @torch.no_grad()
    def make(self, pairs: Pairs, seed: int) -> Tensor:
        codes = self.model.encode(pairs.images)
        return self.model.modes(self.model.condition(codes[pairs.reference], codes[pairs.query]), self.count)
