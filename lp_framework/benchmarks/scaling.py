"""How cost and memory grow with the numbers of pairs, starts and views."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any

import numpy as np
import torch

from lp_framework.benchmarks.contest import timed
from lp_framework.benchmarks.memory import peak_bytes
from lp_framework.benchmarks.section import Figure, Section
from lp_framework.errors import UserError
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs, ViewSets
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.two_stage import TwoStage

MOST, LEAST = "most", "fewest"


@dataclass
class Cost:
    """Of one size: seconds of every round, and the peak of memory in bytes."""

    seconds: list[float] = field(default_factory=list)
    peak: int = 0


@dataclass(frozen=True)
class Scaling:
    """The measurement: both stages, `steps` steps each, on random images; the numbers that stay are `fixed`.

    Pairs have two images each; a set of views is a first view and so many others, each paired with the first.
    """

    device: torch.device
    model: PoseModel
    prior: Prior
    pairs: Sequence[int]
    starts: Sequence[int]
    views: Sequence[int]
    fixed: Mapping[str, int]
    steps: int
    rounds: int

    def __post_init__(self) -> None:
        for name in ("pairs", "starts", "views"):
            sizes = getattr(self, name)
            listed = isinstance(sizes, Sequence) and all(isinstance(each, int) and each > 0 for each in sizes)
            if not listed or len(sizes) < 2 or list(sizes) != sorted(set(sizes)):
                raise UserError(f"scaling.{name} must list two or more ascending numbers, got {sizes}")

    def measure(self) -> Iterator[Section]:
        """The section after every size."""
        model, prior = self.model.to(self.device), self.prior.to(self.device)
        solver = TwoStage(model, prior, iterations=self.steps, refinement_steps=self.steps)
        works = {
            "pairs": lambda count: self.solved(solver, count, self.fixed["starts"]),
            "starts": lambda count: self.solved(solver, self.fixed["pairs"], count),
            "views": lambda count: self.solved_views(solver, count),
        }
        costs = {name: {size: Cost() for size in getattr(self, name)} for name in works}
        done, total = 0, sum(len(sizes) for sizes in costs.values()) * self.rounds
        for number in range(self.rounds):
            for name, work in works.items():
                for size, cost in costs[name].items():
                    run = work(size)
                    if number == 0:
                        cost.peak = peak_bytes(run, self.device)  # and a warm-up
                    cost.seconds.append(timed(run, self.device)[0])
                    done += 1
                    yield self.section(costs, done / total)

    def solved(self, solver: TwoStage, pairs: int, starts: int) -> Callable[[], float]:
        """Solves so many pairs from so many starts each."""
        index = torch.arange(pairs, device=self.device)
        problem = Pairs(self.images(2 * pairs), 2 * index, 2 * index + 1, ids=index)
        poses = Ring(starts).make(problem, seed=0)

        def work() -> float:
            solver.solve(problem, poses, seed=0)
            return pairs

        return work

    def solved_views(self, solver: TwoStage, views: int) -> Callable[[], float]:
        """Solves sets of a first view and so many others."""
        sets = self.fixed["sets"]
        places = torch.arange(sets * (views + 1), device=self.device).view(sets, views + 1)
        problem = ViewSets(self.images(places.numel()), places, ids=places[:, 0])
        poses = Ring(self.fixed["starts"]).make(problem.with_first(), seed=0).unflatten(0, (sets, views))

        def work() -> float:
            solver.solve_views(problem, poses, seed=0)
            return views

        return work

    def images(self, count: int) -> torch.Tensor:
        """Random images `[count, 3, H, W]` of the size that the prior sees."""
        side = self.prior.image_size
        images = torch.rand(count, 3, side, side, generator=torch.Generator().manual_seed(0)) * 2 - 1
        return images.to(self.device)

    def section(self, costs: Mapping[str, Mapping[int, Cost]], done: float) -> Section:
        """The figures of the quantities whose sizes have all been gone through."""
        figures: list[Figure] = []
        record: dict[str, Any] = {}
        for name, sizes in costs.items():
            if not all(cost.seconds for cost in sizes.values()):
                continue
            least, most = min(sizes), max(sizes)
            seconds = {size: median(cost.seconds) for size, cost in sizes.items()}
            peaks = {size: float(cost.peak) for size, cost in sizes.items()}
            slopes = exponent(seconds), exponent(peaks)
            label = f"{least} to {most} {name}"
            figures += [
                Figure(f"{label}: seconds, exponent {slopes[0]:.2f}", seconds[most], seconds[least]),
                Figure(f"{label}: peak memory, MB, exponent {slopes[1]:.2f}", peaks[most] / 1e6, peaks[least] / 1e6),
            ]
            record[name] = {
                "sizes": {
                    str(size): {"seconds": seconds[size], "peak_bytes": cost.peak} for size, cost in sizes.items()
                },
                "exponent": {"seconds": slopes[0], "peak_bytes": slopes[1]},
            }
        fixed = ", ".join(f"{value} {name}" for name, value in self.fixed.items())
        note = (
            f"both stages, {self.steps} steps each; what does not grow is {fixed}; cost ~ number^exponent, 1 is linear"
        )
        return Section("scaling: two_stage", (MOST, LEAST), figures, record, done, note)


def exponent(costs: Mapping[int, float]) -> float:
    """The slope of log cost over log size, least squares.

    >>> round(exponent({1: 3.0, 10: 30.0, 100: 300.0}), 6)
    1.0
    """
    sizes, values = zip(*costs.items(), strict=True)
    return float(np.polyfit([math.log(each) for each in sizes], [math.log(each) for each in values], 1)[0])
