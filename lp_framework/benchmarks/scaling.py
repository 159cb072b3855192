"""How cost and memory grow with the numbers of pairs, starts and views."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from statistics import median

import numpy as np
import torch

from lp_framework.benchmarks.first_stage import random_images
from lp_framework.benchmarks.harness import Row, Section, timed
from lp_framework.benchmarks.memory import peak_bytes
from lp_framework.errors import UserError
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs, ViewSets
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.two_stage import TwoStage

MOST, LEAST = "most", "fewest"


def measure(
    model: PoseModel,
    prior: Prior,
    pairs: Sequence[int],
    starts: Sequence[int],
    views: Sequence[int],
    fixed: Mapping[str, int],
    steps: int,
    rounds: int,
    device: torch.device,
) -> Iterator[Section]:
    """The section after every size: both stages, `steps` steps each, on random images; what does not grow is `fixed`.

    Pairs have two images each; a set of views is a first view and so many others, each paired with the first.
    """
    for name, listed in (("pairs", pairs), ("starts", starts), ("views", views)):
        if len(listed) < 2 or list(listed) != sorted(set(listed)):
            raise UserError(f"scaling.{name} must list two or more ascending numbers, got {list(listed)}")
    solver = TwoStage(model.to(device), prior.to(device), iterations=steps, refinement_steps=steps)
    works = {
        "pairs": {size: _solving(solver, size, fixed["starts"], device) for size in pairs},
        "starts": {size: _solving(solver, fixed["pairs"], size, device) for size in starts},
        "views": {size: _solving_views(solver, fixed["sets"], size, fixed["starts"], device) for size in views},
    }
    section = Section("scaling: two_stage", (MOST, LEAST))
    section.note = f"both stages, {steps} steps each; what does not grow is "
    section.note += ", ".join(f"{value} {name}" for name, value in fixed.items())
    section.note += "; cost ~ number^exponent, 1 is linear"
    peaks = {name: {size: peak_bytes(work, device) for size, work in sizes.items()} for name, sizes in works.items()}
    seconds: dict[str, dict[int, list[float]]] = {name: {size: [] for size in sizes} for name, sizes in works.items()}
    for _ in range(rounds):
        for name, sizes in works.items():
            for size, work in sizes.items():
                seconds[name][size].append(timed(work, device)[0])
                section.done += 1 / (rounds * sum(map(len, works.values())))
                yield section
    for name, sizes in works.items():
        least, most, costs = min(sizes), max(sizes), seconds[name]
        slopes = exponent({size: median(each) for size, each in costs.items()}), exponent(peaks[name])
        label = f"{least} to {most} {name}"
        section.rows.append(Row(f"{label}: seconds, exponent {slopes[0]:.2f}", costs[most], costs[least]))
        memory = peaks[name][most] / 1e6, peaks[name][least] / 1e6
        section.add(f"{label}: peak memory, MB, exponent {slopes[1]:.2f}", *memory)
        section.facts[name] = {
            "sizes": {size: {"seconds": median(costs[size]), "peak_bytes": peaks[name][size]} for size in sizes},
            "exponent": {"seconds": slopes[0], "peak_bytes": slopes[1]},
        }
    yield section


def _solving(solver: TwoStage, pairs: int, starts: int, device: torch.device) -> Callable[[], object]:
    """Solves so many pairs from so many starts each."""
    index = torch.arange(pairs, device=device)
    images = random_images(2 * pairs, solver.prior.image_size, device)
    problem = Pairs(images, 2 * index, 2 * index + 1, ids=index)
    poses = Ring(starts).make(problem, seed=0)
    return partial(solver.solve, problem, poses, 0)


def _solving_views(solver: TwoStage, sets: int, views: int, starts: int, device: torch.device) -> Callable[[], object]:
    """Solves sets of a first view and so many others."""
    places = torch.arange(sets * (views + 1), device=device).view(sets, views + 1)
    images = random_images(places.numel(), solver.prior.image_size, device)
    problem = ViewSets(images, places, ids=places[:, 0])
    poses = Ring(starts).make(problem.with_first(), seed=0).unflatten(0, (sets, views))
    return partial(solver.solve_views, problem, poses, 0)


def exponent(costs: Mapping[int, float]) -> float:
    """The slope of log cost over log size, least squares.

    >>> round(exponent({1: 3.0, 10: 30.0, 100: 300.0}), 6)
    1.0
    """
    sizes, values = zip(*costs.items(), strict=True)
    return float(np.polyfit([math.log(each) for each in sizes], [math.log(each) for each in values], 1)[0])
