"""How reliable an answer is: its probability, a second plausible answer, and a verdict in words.

Models with a density give a probability. For a prior, the denoising error shows whether it knows such objects at all;
a wrong local minimum of a familiar object may still have a low error.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lp_framework.geometry import wrap_angle
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs, Solution
from lp_framework.solvers.pair_energy import PairEnergy

TIMESTEPS, NOISES = range(50, 1000, 100), 2  # in thousandths of the prior's timesteps; noises per timestep
FAMILIAR, STRANGE = 2.0, 3.0  # multiples of the usual error: upper limits for `trust` and `doubtful`
NEAR_DEGREES = 30.0  # of `Solution.probability`
TRUST, DOUBT = 0.8, 0.5  # lowest probabilities for `trust` and for `doubtful`
SECOND_ANSWER = 0.05  # lowest probability at which a second answer is reported


class Answer(NamedTuple):
    """The answer to a pair: latitude and longitude relative to the reference (radians), the `probability` that the true
    rotation is within 30 degrees of it (NaN without a density model), and a `second` answer, if any. `strangeness` is
    the prior's denoising error divided by its usual error."""

    latitude: float
    longitude: float
    probability: float
    second: Answer | None = None
    strangeness: float = math.nan

    @property
    def words(self) -> str:
        """How the camera moves from the reference; see `in_words`."""
        return in_words(self.latitude, self.longitude)

    @property
    def verdict(self) -> str:
        """`trust`, `doubtful` or `do not trust`; empty if no pose was found or nothing is known."""
        if math.isfinite(self.probability):
            grade = (self.probability < TRUST) + (self.probability < DOUBT)
        elif math.isfinite(self.strangeness):
            grade = (self.strangeness > FAMILIAR) + (self.strangeness > STRANGE)
        else:
            return ""
        return ("trust", "doubtful", "do not trust")[grade]

    @property
    def reason(self) -> str:
        """Why the verdict was given."""
        if math.isfinite(self.probability):
            return f"probability {self.probability:.2f} to be within {NEAR_DEGREES:.0f}\N{DEGREE SIGN}"
        return f"denoising error {self.strangeness:.1f} times what it is for objects that the prior knows"

    @property
    def second_words(self) -> str:
        """The second answer and its likely cause; empty if there is none."""
        if self.second is None:
            return ""
        turn = abs(math.degrees(_turn(self.second.longitude - self.longitude)))
        why = " (about half a turn away: front and back look alike)" if turn > 180 - NEAR_DEGREES else ""
        return f"{self.second.words}, probability {self.second.probability:.2f}{why}"


def answers(solution: Solution | None) -> list[Answer]:
    """The answer to every pair. The second answer is the most probable end whose rotations within 30 degrees do not
    overlap the first one's. Empty if no model gave a probability."""
    if solution is None or solution.probability is None:
        return []
    found = []
    for poses, shares, first in zip(
        solution.poses.detach().cpu(), solution.probability.detach().cpu(), solution.chosen.tolist(), strict=True
    ):
        # The combined angle of latitude and longitude is an upper bound on the rotation angle.
        angles = torch.hypot(poses[:, 0] - poses[first, 0], wrap_angle(poses[:, 1] - poses[first, 1]))
        apart = angles > math.radians(2 * NEAR_DEGREES)
        other = int(shares.masked_fill(~apart, -1.0).nan_to_num(nan=-1.0).argmax())
        second = _answer(poses[other], shares[other]) if apart[other] and shares[other] >= SECOND_ANSWER else None
        found.append(_answer(poses[first], shares[first])._replace(second=second))
    return found


def answers_by_prior(prior: Prior, pairs: Pairs, poses: Tensor) -> list[Answer]:
    """Answers for `poses` `[B, 3]` with their strangeness to the prior; empty if its usual error is unknown."""
    if prior.usual_error is None:
        return []
    strangeness = (denoising_errors(prior, pairs, poses) / prior.usual_error).tolist()
    return [
        Answer(latitude, longitude, math.nan, strangeness=times)
        for (latitude, longitude, _), times in zip(poses.tolist(), strangeness, strict=True)
    ]


@torch.no_grad()
def denoising_errors(prior: Prior, pairs: Pairs, poses: Tensor) -> Tensor:
    """A prior's mean squared denoising errors `[B]` at relative poses `[B, 3]`, over all timesteps and both directions.

    The mean over true poses of objects that the prior knows is its `usual_error`.
    """
    energy = PairEnergy(prior, pairs, seed=0)
    timesteps = [timestep * prior.num_timesteps // 1000 for timestep in TIMESTEPS for _ in range(NOISES)]
    return energy.mean(poses[:, None], timesteps, energy.noise(0, len(timesteps)))[:, 0]


def in_words(latitude: float, longitude: float) -> str:
    """Describe a relative pose (radians) as a motion of the camera facing the object; longitude grows to the right.

    >>> in_words(math.radians(10), math.radians(330)), in_words(0.0, math.pi), in_words(0.0, 0.001)
    ('30° to the left, 10° up', '180° round', 'the same viewpoint')
    """
    if not math.isfinite(latitude + longitude):
        return "no pose"
    up, right = round(math.degrees(latitude)), round(math.degrees(_turn(longitude)))
    side = "round" if abs(right) == 180 else "to the right" if right > 0 else "to the left"
    parts = [f"{abs(right)}° {side}"] if right else []
    parts += [f"{abs(up)}° {'up' if up > 0 else 'down'}"] if up else []
    return ", ".join(parts) or "the same viewpoint"


def _answer(pose: Tensor, probability: Tensor) -> Answer:
    return Answer(pose[0].item(), pose[1].item(), probability.item())


def _turn(longitude: float) -> float:
    """Wrap an angle to [-pi, pi]."""
    return math.remainder(longitude, 2 * math.pi)
