"""Gauss-Newton against Adam on the prior's energy: the passes that each needs to reach the same energy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from lp_framework.benchmarks.harness import Section
from lp_framework.benchmarks.zero123 import encoded
from lp_framework.data.module import PairDataModule
from lp_framework.data.pairs import PairData
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs, Solution, pairs_of
from lp_framework.solvers.langevin import Langevin
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.two_stage import GaussNewton, TwoStage

CONTENDERS = "second stage: Gauss-Newton and Adam", ("Gauss-Newton", "Adam")
# What both are judged by: the energy under timesteps and noises that neither descends.
PROBE_TIMESTEPS = (100, 300, 500, 700, 900)
PROBE_NOISES = 2  # a timestep
PROBE_SEED = 1  # the solvers' is 0


def some_pairs(views: PairData, count: int, device: torch.device) -> Pairs:
    """So many of the ordered pairs of views, spread evenly over the objects."""
    every = views.table.pairs("ordered")
    chosen = every[np.linspace(0, len(every), min(count, len(every)), endpoint=False, dtype=int)]
    return pairs_of(views[chosen], device)


def measure(
    section: Section, data: PairDataModule, model: PoseModel, prior: Prior, pairs: int, starts: int,
    gammas: Sequence[float], newton_steps: int, adam_steps: int,
) -> None:  # fmt: skip
    """Descents on `pairs` of the test views from where the first stage ends under each of `gammas`.

    A gamma is the noise of the first stage's longitudes; equal energy is the lowest that both reach.
    """
    chosen = some_pairs(data.data("test"), pairs, section.device)
    ready = encoded(prior, prior.encode(chosen.images))
    newton = GaussNewton(model, ready, refinement_steps=newton_steps, trajectory=True)
    adam = TwoStage(model, ready, refinement_steps=adam_steps, trajectory=True).second
    section.note = f"{len(chosen)} pairs of test views, {starts} starts"
    for gamma in gammas:
        poses = Ring(starts).make(chosen, seed=0)
        ends = Langevin(model, gamma=(0.0, gamma, 0.0)).solve(chosen, poses, seed=0).poses
        descents = (
            followed(ready, chosen, newton.refine(chosen, ends, 0), looks=1),
            followed(ready, chosen, adam.solve(chosen, ends, 0), looks=0),
        )
        level = max(min(energies) for energies, _ in descents)
        steps = [next(step for step, each in enumerate(energies) if each <= level) for energies, _ in descents]
        reached = [passes[step] for (_, passes), step in zip(descents, steps, strict=True)]
        section.add(f"gamma {gamma:g} before, to equal energy: passes a start", *reached)
        section.facts[f"gamma {gamma:g}"] = {
            "energy": {"start": descents[1][0][0], "equal": level},
            "steps": dict(zip(section.contenders, steps, strict=True)),
            "energies": {name: each for name, (each, _) in zip(section.contenders, descents, strict=True)},
        }
        section.changed()


def followed(prior: Prior, pairs: Pairs, solution: Solution, looks: int) -> tuple[list[float], list[float]]:
    """Of a solution with its trajectory, at the start and after each step: energies on the probe, the mean over pairs
    and starts, and the network passes a start so far. Before its first step it has passed the network `looks` times as
    often as in each.
    """
    path = solution.trajectory
    assert path is not None  # it was asked for
    energy = PairEnergy(prior, pairs, PROBE_SEED)
    timesteps = [timestep for timestep in PROBE_TIMESTEPS for _ in range(PROBE_NOISES)]
    noise = energy.noise(0, len(timesteps))
    energies = [energy.mean(poses, timesteps, noise).mean().item() for poses in path.unbind(dim=2)]
    steps, starts = path.shape[2] - 1, path.shape[0] * path.shape[1]
    passes = (solution.cost.network_passes - len(pairs.images)) / starts  # the images have been encoded before
    return energies, [passes * (step + looks) / (steps + looks) for step in range(steps + 1)]
