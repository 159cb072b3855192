"""The first stage batched against a loop, and how cost and memory of both stages grow."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import permutations
from statistics import median

import numpy as np
import torch
from torch import Tensor

from lp_framework.benchmarks.harness import Section, Work, peak_bytes, timed, worth
from lp_framework.errors import UserError
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs, ViewSets
from lp_framework.solvers.langevin import Langevin
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.two_stage import TwoStage

FIRST_STAGE = "first stage: langevin", ("batched", "plain loop")
SCALING = "scaling: two_stage", ("most", "fewest")


@torch.no_grad()
def plain_loop(solver: Langevin, pairs: Pairs, starts: Tensor) -> Tensor:
    """`langevin` as a loop over pairs and starts `[B, N, 3]`; its final poses `[B, N, 3]`, longitudes unreduced."""
    model, ends = solver.model, torch.empty_like(starts)
    gamma = starts.new_tensor(solver.gamma)
    for pair in range(len(pairs)):
        features = model.encode(pairs.images[torch.stack([pairs.reference[pair], pairs.query[pair]])])
        condition = model.condition(features[:1], features[1:])
        for start in range(starts.shape[1]):
            pose = starts[pair, start : start + 1]
            for _ in range(solver.iterations):
                score = model.field(condition, pose).score
                pose = pose + solver.alpha * score + gamma * torch.randn_like(pose)
            ends[pair, start] = pose[0]
    return ends


def measure_first_stage(section: Section, model: PoseModel, views: int, starts: int, rounds: int) -> None:
    """On all ordered pairs of `views` random images, `starts` each, and on one of these pairs."""
    solver = Langevin(model)

    def works(pairs: Pairs) -> tuple[Work, Work]:
        poses, amount = Ring(starts).make(pairs, seed=0), len(pairs) * starts
        loop = partial(plain_loop, solver, pairs, poses)
        return worth(amount, partial(solver.solve, pairs, poses, 0)), worth(amount, loop)

    every = all_pairs(model.backbone.image_size, max(2, views), section.device)
    one = Pairs(every.images[:2], every.reference[:1], every.query[:1], every.ids[:1])
    named = {"1 pair": one, f"{len(every)} pairs of {len(every.images)} images": every}
    section.note = f"{solver.iterations} iterations from {starts} starts a pair; each encodes the images it needs"
    section.race({f"{label}, starts a second": works(pairs) for label, pairs in named.items()}, rounds, rate=True)


def all_pairs(side: int, views: int, device: torch.device) -> Pairs:
    """All ordered pairs of random images, `side` pixels a side."""
    reference, query = torch.tensor(list(permutations(range(views), 2)), device=device).T
    return Pairs(random_images(views, side, device), reference, query, torch.arange(len(reference), device=device))


def random_images(count: int, side: int, device: torch.device) -> Tensor:
    """Images `[count, 3, side, side]`, the same ones always."""
    return torch.rand(count, 3, side, side, generator=torch.Generator().manual_seed(0)).to(device) * 2 - 1


def measure_scaling(
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
