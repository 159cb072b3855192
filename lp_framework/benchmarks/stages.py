"""Both stages with the bundled models: the first batched against a loop, the second by Gauss-Newton against Adam."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import permutations

import numpy as np
import torch
from torch import Tensor

from lp_framework.benchmarks.harness import Section, Work, work_of
from lp_framework.data.module import PairDataModule
from lp_framework.data.pairs import PairData
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs, Solution, pairs_of
from lp_framework.solvers.langevin import Langevin
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.two_stage import GaussNewton, TwoStage

# Both are judged by the energy at timesteps and noises that neither of them minimizes.
PROBE_TIMESTEPS = (100, 300, 500, 700, 900)
PROBE_NOISES = 2  # per timestep
PROBE_SEED = 1  # the solvers' is 0


@torch.no_grad()
def plain_loop(solver: Langevin, pairs: Pairs, starts: Tensor) -> Tensor:
    """`langevin` as a loop over pairs and starts `[B, N, 3]`; returns poses `[B, N, 3]` with unwrapped longitudes."""
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
    """Solve all ordered pairs of `views` random images from `starts` each, and one of these pairs."""
    section.title, section.contenders = "first stage: langevin", ("batched", "plain loop")
    solver = Langevin(model)

    def works(pairs: Pairs) -> tuple[Work, Work]:
        poses, amount = Ring(starts).make(pairs, seed=0), len(pairs) * starts
        loop = partial(plain_loop, solver, pairs, poses)
        return work_of(amount, partial(solver.solve, pairs, poses, 0)), work_of(amount, loop)

    every = all_pairs(model.backbone.image_size, max(2, views), section.device)
    one = Pairs(every.images[:2], every.reference[:1], every.query[:1], every.ids[:1])
    named = {"1 pair": one, f"{len(every)} pairs of {len(every.images)} images": every}
    section.note = f"{solver.iterations} iterations from {starts} starts per pair; each encodes the images it needs"
    section.race({f"{label}, starts per second": works(pairs) for label, pairs in named.items()}, rounds, rate=True)


def all_pairs(side: int, views: int, device: torch.device) -> Pairs:
    """All ordered pairs of random images, `side` pixels per side."""
    reference, query = torch.tensor(list(permutations(range(views), 2)), device=device).T
    images = torch.rand(views, 3, side, side, device=device) * 2 - 1
    return Pairs(images, reference, query, torch.arange(len(reference), device=device))


def some_pairs(views: PairData, count: int, device: torch.device) -> Pairs:
    """Pick `count` of the ordered pairs of views, spread evenly over the objects."""
    every = views.table.pairs("ordered")
    chosen = every[np.linspace(0, len(every), min(count, len(every)), endpoint=False, dtype=int)]
    return pairs_of(views[chosen], device)


def measure_descent(
    section: Section, data: PairDataModule, model: PoseModel, prior: Prior, pairs: int, starts: int,
    gammas: Sequence[float], newton_steps: int, adam_steps: int,
) -> None:  # fmt: skip
    """Descend on `pairs` pairs of test views, starting where the first stage ends for each of `gammas`.

    A gamma is the first stage's noise in longitude; "equal energy" is the lowest energy that both reach.
    """
    section.title, section.contenders = "second stage: Gauss-Newton and Adam", ("Gauss-Newton", "Adam")
    chosen = some_pairs(data.data("test"), pairs, section.device)
    newton = GaussNewton(model, prior, refinement_steps=newton_steps, trajectory=True)
    adam = TwoStage(model, prior, refinement_steps=adam_steps, trajectory=True).second
    section.note = f"{len(chosen)} pairs of test views, {starts} starts"
    for gamma in gammas:
        poses = Ring(starts).make(chosen, seed=0)
        ends = Langevin(model, gamma=(0.0, gamma, 0.0)).solve(chosen, poses, seed=0).poses
        descents = (
            probe_energies(prior, chosen, newton.refine(chosen, ends, 0), extra_steps=1),
            probe_energies(prior, chosen, adam.solve(chosen, ends, 0), extra_steps=0),
        )
        level = max(min(energies) for energies, _ in descents)
        steps = [next(step for step, each in enumerate(energies) if each <= level) for energies, _ in descents]
        reached = [passes[step] for (_, passes), step in zip(descents, steps, strict=True)]
        section.add(f"gamma {gamma:g} before, to equal energy: passes per start", *reached)
        section.facts[f"gamma {gamma:g}"] = {
            "energy": {"start": descents[1][0][0], "equal": level},
            "steps": dict(zip(section.contenders, steps, strict=True)),
            "energies": {name: each for name, (each, _) in zip(section.contenders, descents, strict=True)},
        }


def probe_energies(prior: Prior, pairs: Pairs, solution: Solution, extra_steps: int) -> tuple[list[float], list[float]]:
    """Mean probe energies and cumulative network passes per start, at the start and after each step of a solution.

    Before its first step, the solver spends `extra_steps` times the passes of one step.
    """
    path = solution.trajectory
    assert path is not None  # it was requested
    energy = PairEnergy(prior, pairs, PROBE_SEED)
    timesteps = [timestep for timestep in PROBE_TIMESTEPS for _ in range(PROBE_NOISES)]
    noise = energy.noise(0, len(timesteps))
    energies = [energy.mean(poses, timesteps, noise).mean().item() for poses in path.unbind(dim=2)]
    steps, starts = path.shape[2] - 1, path.shape[0] * path.shape[1]
    passes = (solution.cost.network_passes - len(pairs.images)) / starts  # excludes the encoding of images
    return energies, [passes * (step + extra_steps) / (steps + extra_steps) for step in range(steps + 1)]
