"""How well a prior's energy singles out the azimuth: the energy around the object, all else being true.

The first thing to know of a prior and an object. A narrow valley at the truth and nothing else: any start will do. A
second valley at half a turn: the shape looks the same from behind. No valley: no method can tell the longitude.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lp_framework.evaluation.landscape import BATCH, pose_energies
from lp_framework.geometry import wrap_angle
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs

NEAR_DEGREES = 15.0
PROMINENCE = 0.1  # of the profile's range; a shallower dent is no minimum


def azimuth_energies(
    prior: Prior,
    pairs: Pairs,
    poses: Tensor,
    azimuths: Tensor,
    timesteps: Sequence[int],
    noises: int,
    seed: int,
    batch: int = BATCH,
) -> Tensor:
    """Energies `[B, A]` at the relative longitudes `azimuths` `[A]` (radians), for B pairs of true `poses` `[B, 3]`.

    As `prior_landscapes`, but latitude and radius are the true ones.
    """
    around = poses[:, None].repeat(1, len(azimuths), 1)
    around[..., 1] = azimuths.to(poses)
    return pose_energies(prior, pairs, around, timesteps, noises, seed, batch)


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
        energy, degrees = self.energy.tolist(), self.degrees.tolist()
        count, low, high = len(energy), min(energy), max(energy)
        depth = high - low or 1.0
        found = []
        for place, value in enumerate(energy):
            if not (value < energy[place - 1] and value <= energy[(place + 1) % count]):  # the first of equal ones
                continue
            # The pass to lower ground on either side; of the deepest minimum, the highest point there is.
            passes = []
            for step in (-1, 1):
                highest = value
                for far in range(1, count):
                    other = energy[(place + step * far) % count]
                    if other < value:
                        passes.append(highest)
                        break
                    highest = max(highest, other)
            if (min(passes) if passes else high) - value >= PROMINENCE * depth:
                found.append(Minimum(degrees[place], (value - low) / depth))
        return sorted(found, key=lambda minimum: minimum.height)


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
