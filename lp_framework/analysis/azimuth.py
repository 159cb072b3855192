"""How well a prior's energy singles out the azimuth: the energy around the object, all else being true.

The first thing to know of a prior and an object. A narrow valley at the truth and nothing else: any start will do. A
second valley at half a turn: the shape looks the same from behind. No valley: no method can tell the longitude.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lp_framework.analysis.fields import Draws, pose_energies
from lp_framework.analysis.landscapes import valleys
from lp_framework.geometry import wrap_angle
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs

NEAR_DEGREES = 15.0
PROMINENCE = 0.1  # of the profile's range; a shallower dent is no minimum


def azimuth_energies(prior: Prior, pairs: Pairs, poses: Tensor, azimuths: Tensor, draws: Draws) -> Tensor:
    """Energies `[B, A]` at the relative longitudes `azimuths` `[A]` (radians), for B pairs of true `poses` `[B, 3]`.

    As `prior_landscapes`, but latitude and radius are the true ones.
    """
    around = poses[:, None].repeat(1, len(azimuths), 1)
    around[..., 1] = azimuths.to(poses)
    return pose_energies(prior, pairs, around, draws)


class Minimum(NamedTuple):
    """A local minimum of a profile: its place (degrees from the truth) and its height in the profile's range."""

    degrees: float
    height: float


class Profile(NamedTuple):
    """The mean energy around an object `[A]` over the azimuth's distance from the truth `[A]` (degrees, -180 first)."""

    degrees: Tensor
    energy: Tensor

    @property
    def relief(self) -> float:
        """Its range over its mean: next to 0 where the energy does not tell the azimuth."""
        return ((self.energy.max() - self.energy.min()) / self.energy.mean()).item()

    def minima(self) -> list[Minimum]:
        """Its local minima, the deepest first; a dent of less than `PROMINENCE` of the range does not count."""
        return [
            Minimum(self.degrees[valley.cell].item(), valley.height)
            for valley in valleys(self.energy[None], PROMINENCE)
        ]


def profile(energies: Tensor, azimuths: Tensor, truth: Tensor) -> Profile:
    """The profile of pairs: `energies` `[P, A]` at evenly spaced `azimuths` `[A]`, by distance from `truth` `[P]`."""
    count = len(azimuths)
    offset = wrap_angle(azimuths - truth[:, None])
    place = (offset / (2 * math.pi / count)).round().long() % count
    total = torch.zeros(count, dtype=energies.dtype).index_add(0, place.flatten(), energies.flatten())
    mean = total / torch.bincount(place.flatten(), minlength=count)
    degrees = torch.arange(count) * 360.0 / count
    turned = (count + 1) // 2
    return Profile((degrees.roll(-turned) + 180) % 360 - 180, mean.roll(-turned))


def within(energies: Tensor, azimuths: Tensor, truth: Tensor) -> Tensor:
    """Whether the azimuth of least energy is within `NEAR_DEGREES` of the truth, `[P]`."""
    best = azimuths[energies.argmin(dim=1)]
    return wrap_angle(best - truth).abs() <= math.radians(NEAR_DEGREES)
