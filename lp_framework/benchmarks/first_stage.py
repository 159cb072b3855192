"""Starts a second of the first stage: all starts of all pairs together, against a plain loop over the starts."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations

import torch
from torch import Tensor

from lp_framework.benchmarks.contest import Match, Work, compete
from lp_framework.benchmarks.section import Section
from lp_framework.models.pose_model import PoseModel
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.langevin import Langevin
from lp_framework.solvers.starts import Ring

BATCHED, LOOP = "batched", "plain loop"


class PlainLoop:
    """`langevin` as a loop: a pair at a time, its two images encoded, then one start after the other."""

    def __init__(self, solver: Langevin) -> None:
        self.solver = solver

    @torch.no_grad()
    def solve(self, pairs: Pairs, starts: Tensor) -> Tensor:
        """Final poses `[B, N, 3]` from starts `[B, N, 3]`, longitudes unreduced."""
        model, ends = self.solver.model, torch.empty_like(starts)
        gamma = starts.new_tensor(self.solver.gamma)
        for pair in range(len(pairs)):
            features = model.encode(pairs.images[torch.stack([pairs.reference[pair], pairs.query[pair]])])
            condition = model.condition(features[:1], features[1:])
            for start in range(starts.shape[1]):
                pose = starts[pair, start : start + 1]
                for _ in range(self.solver.iterations):
                    score = model.field(condition, pose).score
                    pose = pose + self.solver.alpha * score + gamma * torch.randn_like(pose)
                ends[pair, start] = pose[0]
        return ends


def measure(model: PoseModel, views: int, starts: int, rounds: int, device: torch.device) -> Iterator[Section]:
    """On all ordered pairs of `views` random images, `starts` each, and on one of these pairs."""
    solver = Langevin(model.to(device))
    every = all_pairs(model.backbone.image_size, views, device)
    one = Pairs(every.images[:2], every.reference[:1], every.query[:1], every.ids[:1])
    matches = [
        Match(f"{len(pairs)}_pairs", f"{label}, starts a second", *_works(solver, pairs, starts))
        for pairs, label in ((one, "1 pair"), (every, f"{len(every)} pairs of {views} images"))
    ]
    note = f"{solver.iterations} iterations from {starts} starts a pair; each contender encodes the images it needs"
    return compete("first stage: langevin", (BATCHED, LOOP), matches, rounds, device, note)


def all_pairs(side: int, views: int, device: torch.device) -> Pairs:
    """All ordered pairs of random images, `side` pixels a side."""
    reference, query = torch.tensor(list(permutations(range(views), 2)), device=device).T
    images = torch.rand(views, 3, side, side, generator=torch.Generator().manual_seed(0)) * 2 - 1
    return Pairs(images.to(device), reference, query, torch.arange(len(reference), device=device))


def _works(solver: Langevin, pairs: Pairs, starts: int) -> tuple[Work, Work]:
    poses = Ring(starts).make(pairs, seed=0)

    def batched() -> float:
        solver.solve(pairs, poses, seed=0)
        return len(pairs) * starts

    def loop() -> float:
        PlainLoop(solver).solve(pairs, poses)
        return len(pairs) * starts

    return batched, loop
