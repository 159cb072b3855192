"""Starts a second of the first stage: all starts of all pairs together, against a plain loop over the starts."""

from __future__ import annotations

from functools import partial
from itertools import permutations

import torch
from torch import Tensor

from lp_framework.benchmarks.harness import Section, Work, worth
from lp_framework.models.pose_model import PoseModel
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.langevin import Langevin
from lp_framework.solvers.starts import Ring

CONTENDERS = "first stage: langevin", ("batched", "plain loop")


@torch.no_grad()
def plain_loop(solver: Langevin, pairs: Pairs, starts: Tensor) -> Tensor:
    """`langevin` as a loop: a pair at a time, its two images encoded, then one start after the other.

    Final poses `[B, N, 3]` from starts `[B, N, 3]`, longitudes unreduced.
    """
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


def measure(section: Section, model: PoseModel, views: int, starts: int, rounds: int) -> None:
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
