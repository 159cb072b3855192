"""How cost and memory grow with the numbers of pairs, starts and views."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from statistics import median

import numpy as np
import torch

from lp_framework.benchmarks.counting import peak_bytes
from lp_framework.benchmarks.first_stage import random_images
from lp_framework.benchmarks.harness import Section, timed
from lp_framework.errors import UserError
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import ViewSets
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.two_stage import TwoStage

CONTENDERS = "scaling: two_stage", ("most", "fewest")


def measure(
    section: Section, model: PoseModel, prior: Prior, pairs: Sequence[int], starts: Sequence[int],
    views: Sequence[int], fixed: Mapping[str, int], steps: int, rounds: int,
) -> None:  # fmt: skip
    """Both stages, `steps` steps each, on random images; of pairs, starts and views those that do not grow are `fixed`.

    A set of views is a first view and so many others, each paired with the first; pairs are sets with one other.
    """
    solver = TwoStage(model, prior, iterations=steps, refinement_steps=steps)
    solving = partial(_solving, solver, section.device)
    works: dict[str, dict[int, Callable[[], object]]] = {
        "pairs": {size: solving(size, 1, fixed["starts"]) for size in pairs},
        "starts": {size: solving(fixed["pairs"], 1, size) for size in starts},
        "views": {size: solving(fixed["sets"], size, fixed["starts"]) for size in views},
    }
    for name, sizes in works.items():
        if len(sizes) < 2:
            raise UserError(f"scaling.{name} must list two or more numbers, got {list(sizes)}")
    section.note = f"both stages, {steps} steps each; what does not grow is "
    section.note += ", ".join(f"{value} {name}" for name, value in fixed.items())
    section.note += "; cost ~ number^exponent, 1 is linear"
    for name, sizes in works.items():
        peaks = {size: peak_bytes(work, section.device) for size, work in sizes.items()}
        seconds: dict[int, list[float]] = {size: [] for size in sizes}
        for _ in range(rounds):
            for size, work in sizes.items():
                seconds[size].append(timed(work, section.device)[0])
        medians = {size: median(each) for size, each in seconds.items()}
        slopes = {"seconds": exponent(medians), "peak_bytes": exponent(peaks)}
        least, most = min(sizes), max(sizes)
        label = f"{least} to {most} {name}"
        section.rows[f"{label}: seconds, exponent {slopes['seconds']:.2f}"] = seconds[most], seconds[least]
        memory = f"{label}: peak memory, MB, exponent {slopes['peak_bytes']:.2f}"
        section.add(memory, peaks[most] / 1e6, peaks[least] / 1e6)
        costs = {size: {"seconds": medians[size], "peak_bytes": peaks[size]} for size in sizes}
        section.facts[name] = {"sizes": costs, "exponent": slopes}
        section.changed()


def _solving(solver: TwoStage, device: torch.device, sets: int, views: int, starts: int) -> Callable[[], object]:
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
    return float(np.polyfit([math.log(size) for size in costs], [math.log(cost) for cost in costs.values()], 1)[0])
