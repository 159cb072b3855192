"""The ambiguity of objects whose landscapes are known in closed form."""

from __future__ import annotations

import math

import pytest
import torch
from exact_prior import ExactPrior, image_of

from lp_framework.analysis.ambiguity import Ambiguity, ambiguity
from lp_framework.analysis.fields import Draws, prior_landscapes
from lp_framework.analysis.landscapes import Landscape, landscape_grid
from lp_framework.priors.base import ViewCode
from lp_framework.solvers.base import Pairs

HALF, THIRD = math.pi, 2 * math.pi / 3


class Turned(ExactPrior):
    """A body of revolution: apart from `ripple`, the energy does not depend on the longitude."""

    def __init__(self, ripple: float) -> None:
        super().__init__()
        self.ripple = ripple

    def residual(self, target: ViewCode, source: ViewCode, pose, timestep, noise):
        residual = super().residual(target, source, pose, timestep, noise)
        return residual * torch.tensor([1.0, self.ripple, 1.0])[:, None, None]


def score(prior: ExactPrior, count: int = 6) -> Ambiguity:
    """The ambiguity of an object whose views are at random poses."""
    views = torch.rand(2 * count, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.8, 6.0, 0.5])
    pairs = Pairs(image_of(views), torch.arange(count), torch.arange(count, 2 * count), torch.arange(count))
    truth = views[count:] - views[:count]
    landscapes = prior_landscapes(prior, pairs, truth[:, 2], landscape_grid(), Draws([500], 1, seed=0))
    return ambiguity(landscapes, truth[:, 1] % (2 * math.pi))


@pytest.mark.parametrize(
    ("prior", "verdict", "unique_answer", "valleys"),
    [
        (ExactPrior(), "unique", True, [0]),
        (ExactPrior(offsets=(0.0, HALF), depths=(0.0, 0.3)), "twofold", True, [0, 180]),
        (ExactPrior(offsets=(0.0, HALF)), "twofold", False, [0, 180]),
        (ExactPrior(offsets=(0.0, THIRD, 2 * THIRD), depths=(0.0, 0.2, 0.2)), "several", True, [0, 120, 120]),
        (ExactPrior(offsets=(0.0, THIRD, 2 * THIRD)), "several", False, [0, 120, 120]),
        (Turned(0.0), "continuous", False, []),
        (Turned(0.2), "continuous", False, []),
    ],
)
def test_verdicts(prior, verdict, unique_answer, valleys):
    found = score(prior)
    assert found.verdict == verdict and found.unique_answer is unique_answer
    record = found.record()
    assert sorted(abs(round(valley["degrees"] / 12) * 12) for valley in record["valleys"]) == valleys
    assert record["verdict"] == verdict and record["flatness"] == found.flatness


def test_flatness_runs_from_wall_to_plain():
    flatness = [score(Turned(ripple)).flatness for ripple in (1.0, 0.5, 0.2, 0.0)]
    assert flatness == sorted(flatness) and flatness[0] < 0.7 and flatness[-1] == pytest.approx(1, abs=1e-6)


def test_minima_are_the_mean_count_of_the_pairs():
    grid = landscape_grid()
    one, two = ((-torch.cos(count * grid[1])).expand(16, -1) + grid[0][:, None] ** 2 for count in (1, 2))
    found = ambiguity([Landscape(*grid, 0.0, one), Landscape(*grid, 0.0, two)], torch.zeros(2))
    assert found.minima == 1.5
