"""Gauss-Newton against Adam on the prior's energy: what each needs to reach the same energy."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lp_framework.benchmarks.contest import Match, Work, compete
from lp_framework.benchmarks.section import Figure, Section
from lp_framework.data.pairs import PairData
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior, ViewCode
from lp_framework.solvers.base import Pairs, Solution, pairs_of
from lp_framework.solvers.gauss_newton import GaussNewton
from lp_framework.solvers.langevin import Langevin
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.two_stage import TwoStage

NEWTON, ADAM = "Gauss-Newton", "Adam"
# What both are judged by: the energy under timesteps and noises that neither descends.
PROBE_TIMESTEPS = (100, 300, 500, 700, 900)
PROBE_NOISES = 2  # a timestep
PROBE_SEED = 1  # the solvers' is 0

Solve = Callable[[Pairs, Tensor, int], Solution]


class Encoded(Prior):
    """A prior whose images have been encoded: both contenders need their codes, so neither is charged for them."""

    def __init__(self, prior: Prior, images: Tensor) -> None:
        super().__init__()
        self.prior, self.codes = prior, prior.encode(images)
        self.num_timesteps, self.latent_shape, self.image_size = (
            prior.num_timesteps, prior.latent_shape, prior.image_size,
        )  # fmt: skip

    def encode(self, images: Tensor) -> ViewCode:
        return self.codes

    def residual(self, target: ViewCode, source: ViewCode, pose: Tensor, timestep: Tensor, noise: Tensor) -> Tensor:
        return self.prior.residual(target, source, pose, timestep, noise)

    def denoising_error(
        self, target: ViewCode, source: ViewCode, pose: Tensor, timestep: Tensor, noise: Tensor
    ) -> Tensor:
        return self.prior.denoising_error(target, source, pose, timestep, noise)

    def generate(
        self,
        source: ViewCode,
        pose: Tensor,
        steps: int = 50,
        guidance: float = 3.0,
        generator: torch.Generator | None = None,
        eta: float = 1.0,
    ) -> Tensor:
        return self.prior.generate(source, pose, steps, guidance, generator, eta)


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
    return pairs_of(views[chosen], views.table, device)


def measure(
    pairs: Pairs,
    starts: Tensor,
    model: PoseModel,
    prior: Prior,
    gammas: Sequence[float],
    newton_steps: int,
    adam_steps: int,
    rounds: int,
    device: torch.device,
    note: str = "",
) -> Iterator[Section]:
    """Descents from where the first stage ends under each of `gammas`, the noise of its longitudes.

    Equal energy is the lowest that both reach. Seconds are those of a whole descent, by the share of its passes.
    """
    model, encoded = model.to(device), Encoded(prior.to(device), pairs.images)
    newton = GaussNewton(model, encoded, refinement_steps=newton_steps, trajectory=True)
    adam = TwoStage(model, encoded, refinement_steps=adam_steps, trajectory=True).second
    solve = {NEWTON: newton.refine, ADAM: adam.solve}
    looks = {NEWTON: 1, ADAM: 0}  # passes at the start itself, in steps
    figures: list[Figure] = []
    records: dict[str, Any] = {}
    matches = []
    for gamma in gammas:
        ends = Langevin(model, gamma=(0.0, gamma, 0.0)).solve(pairs, starts, seed=0).poses
        descents = {name: followed(encoded, pairs, solve[name](pairs, ends, 0), looks[name]) for name in (NEWTON, ADAM)}
        level = max(min(descent.energies) for descent in descents.values())
        steps = {name: descent.reached(level) for name, descent in descents.items()}
        passes = {name: descents[name].passes[steps[name]] for name in descents}
        shares = {name: passes[name] / descents[name].passes[-1] for name in descents}
        key, label = f"gamma_{gamma:g}", f"gamma {gamma:g} before, to equal energy"
        figures.append(Figure(f"{label}: passes a start", passes[NEWTON], passes[ADAM]))
        records[key] = {
            "energy": {"start": descents[ADAM].energies[0], "equal": level},
            "steps": steps,
            "passes_per_start": {**passes, "ratio": figures[-1].ratio},
            "energies": {name: list(descent.energies) for name, descent in descents.items()},
        }
        first, second = (_work(solve[name], pairs, ends, shares[name]) for name in (NEWTON, ADAM))
        matches.append(Match(key, f"{label}: seconds a 1000 starts", first, second, rate=False))
    title = "second stage: Gauss-Newton and Adam"
    for section in compete(title, (NEWTON, ADAM), matches, rounds, device, note):
        record = {key: {**records[key], "seconds_per_1000_starts": seconds} for key, seconds in section.record.items()}
        yield replace(section, figures=[*figures, *section.figures], record=record)


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


def _work(solve: Solve, pairs: Pairs, starts: Tensor, share: float) -> Work:
    """A whole descent, worth more starts than it has, because a `share` of it is enough."""

    def work() -> float:
        solve(pairs, starts, 0)
        return starts.shape[0] * starts.shape[1] / 1000 / share

    return work
