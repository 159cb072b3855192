"""Gauss-Newton against Adam on the prior's energy: what each needs to reach the same energy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from lp_framework.benchmarks.harness import Contest, Section, worth
from lp_framework.benchmarks.second_stage import encoded
from lp_framework.data.module import PairDataModule
from lp_framework.data.pairs import PairData
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs, Solution, pairs_of
from lp_framework.solvers.gauss_newton import GaussNewton
from lp_framework.solvers.langevin import Langevin
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.two_stage import TwoStage

NEWTON, ADAM = "Gauss-Newton", "Adam"
# What both are judged by: the energy under timesteps and noises that neither descends.
PROBE_TIMESTEPS = (100, 300, 500, 700, 900)
PROBE_NOISES = 2  # a timestep
PROBE_SEED = 1  # the solvers' is 0


@dataclass(frozen=True)
class Descent:
    """At the start and after each step: `energies` on the probe, the mean over pairs and starts, and the network
    `passes` a start so far."""

    energies: Sequence[float]
    passes: Sequence[float]

    def reached(self, level: float) -> int:
        """The first step after which the energy is no higher."""
        return next(step for step, energy in enumerate(self.energies) if energy <= level)


def some_pairs(views: PairData, count: int, device: torch.device) -> Pairs:
    """So many of the ordered pairs of views, spread evenly over the objects."""
    every = views.table.pairs("ordered")
    chosen = every[np.linspace(0, len(every), min(count, len(every)), endpoint=False, dtype=int)]
    return pairs_of(views[chosen], device)


def measure(
    data: PairDataModule,
    model: PoseModel,
    prior: Prior,
    names: Mapping[str, str],
    pairs: int,
    starts: int,
    gammas: Sequence[float],
    newton_steps: int,
    adam_steps: int,
    rounds: int,
    device: torch.device,
) -> Iterator[Section]:
    """Descents on `pairs` of the test views from where the first stage ends under each of `gammas`.

    A gamma is the noise of the first stage's longitudes; equal energy is the lowest that both reach. Seconds are those
    of a whole descent, by the share of its passes.
    """
    model, prior, chosen = model.to(device), prior.to(device), some_pairs(data.data("test"), pairs, device)
    ready = encoded(prior, prior.encode(chosen.images))
    newton = GaussNewton(model, ready, refinement_steps=newton_steps, trajectory=True)
    adam = TwoStage(model, ready, refinement_steps=adam_steps, trajectory=True).second
    section = Section("second stage: Gauss-Newton and Adam", (NEWTON, ADAM))
    section.note = f"{len(chosen)} pairs of {names['data']}'s test views, {starts} starts, prior={names['prior']}"
    contests = []
    for gamma in gammas:
        poses = Ring(starts).make(chosen, seed=0)
        ends = Langevin(model, gamma=(0.0, gamma, 0.0)).solve(chosen, poses, seed=0).poses
        descents = {
            NEWTON: followed(ready, chosen, newton.refine(chosen, ends, 0), looks=1),
            ADAM: followed(ready, chosen, adam.solve(chosen, ends, 0), looks=0),
        }
        level = max(min(descent.energies) for descent in descents.values())
        steps = {name: descent.reached(level) for name, descent in descents.items()}
        passes = [descent.passes[steps[name]] for name, descent in descents.items()]
        shares = [its / descent.passes[-1] for its, descent in zip(passes, descents.values(), strict=True)]
        label = f"gamma {gamma:g} before, to equal energy"
        section.add(f"{label}: passes a start", *passes)
        section.facts[f"gamma {gamma:g}"] = {
            "energy": {"start": descents[ADAM].energies[0], "equal": level},
            "steps": steps,
            "energies": {name: list(descent.energies) for name, descent in descents.items()},
        }
        # A whole descent is worth more starts than it has where a share of it is enough.
        first, second = (
            worth(len(chosen) * starts / 1000 / share, partial(solve, chosen, ends, 0))
            for solve, share in zip((newton.refine, adam.solve), shares, strict=True)
        )
        contests.append(Contest(f"{label}: seconds a 1000 starts", first, second))
    return section.race(contests, rounds, device)


def followed(prior: Prior, pairs: Pairs, solution: Solution, looks: int) -> Descent:
    """The descent of a solution with its trajectory; before its first step it has passed the network `looks` times as
    often as in each."""
    path = solution.trajectory
    assert path is not None  # it was asked for
    energy = PairEnergy(prior, pairs, PROBE_SEED)
    timesteps = [timestep for timestep in PROBE_TIMESTEPS for _ in range(PROBE_NOISES)]
    noise = energy.noise(0, len(timesteps))
    energies = [energy.mean(poses, timesteps, noise).mean().item() for poses in path.unbind(dim=2)]
    steps, starts = path.shape[2] - 1, path.shape[0] * path.shape[1]
    passes = (solution.cost.network_passes - len(pairs.images)) / starts  # the images have been encoded before
    return Descent(energies, [passes * (step + looks) / (steps + looks) for step in range(steps + 1)])
