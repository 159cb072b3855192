"""ID-Pose (Cheng et al. 2023): probe a grid of candidates, explore from the better half, refine the best.

Published code: `estimate_poses` and `find_optimal_poses` of github.com/xt4d/id-pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import one_hot, pad

from lp_framework.errors import at_least, check_settings, positive
from lp_framework.geometry import reduce_longitude
from lp_framework.keyed_random import keyed_uniform, on_cpu
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.base import Cost, Pairs, Solution, Solver, ViewSets, ViewSolution, choose, timed
from lp_framework.solvers.descent import GradientDescent, descend
from lp_framework.solvers.pair_energy import PairEnergy, keyed_noise

_REFINEMENT = 0x4944  # gives refinement and exploration independent draws under the same seed


@register("solver", "id_pose")
@dataclass(eq=False)
class IDPose(Solver):
    """ID-Pose: probe a grid of candidates, then plain gradient descent on the spherical pose, one direction per step.

    Defaults are the published settings. Unless `candidates=starts`, **starts are ignored**. All candidates are probed
    in both directions with `probes` fixed noises. The better half takes `exploration_steps` descent steps and is probed
    again; the `kept` best remain. The chosen ones take `refinement_steps` steps per unknown image with fresh noise at
    `timestep` (a fraction of the prior's range); the answer is the mean of an image's last `averaged` poses.

    The N answers of a `Solution` are the kept candidates: the chosen one is refined, the others are as explored, and
    energies are those before refinement. The published code reads a checkpoint's raw weights (`prior.weights=raw`). Its
    rates are tuned for Zero123's energy: plain gradient descent diverges where rate times curvature exceeds 2.
    """

    prior: Prior
    candidates: Literal["grid", "starts"] = "grid"
    longitudes: int = 8
    latitudes_degrees: Sequence[float] = (-120.0, -60.0, 0.0, 60.0, 120.0)
    timestep: float = 0.2
    timestep_span: float = 0.01
    probes: int = 16
    exploration_steps: int = 10
    exploration_rate: float = 10.0
    kept: int = 5
    refinement_steps: int = 600
    refinement_rate: float = 1.0
    averaged: int = 20
    trajectory: bool = False

    def __post_init__(self) -> None:
        at_least(1, "solver", longitudes=self.longitudes, probes=self.probes, kept=self.kept, averaged=self.averaged)
        at_least(0, "solver", exploration_steps=self.exploration_steps, refinement_steps=self.refinement_steps)
        positive("solver", exploration_rate=self.exploration_rate, refinement_rate=self.refinement_rate)
        latitudes, timestep, span = self.latitudes_degrees, self.timestep, self.timestep_span
        check_settings(
            "solver",
            ("latitudes_degrees", latitudes, len(latitudes) >= 1, "one angle or more"),
            ("timestep", timestep, 0 <= timestep < 1, "in [0, 1)"),
            ("timestep_span", span, 0 <= span <= 1 - timestep, "from 0 to 1 - timestep"),
        )
        around = [2 * math.pi * number / self.longitudes for number in range(self.longitudes)]
        self.grid = [(math.radians(each), longitude, 0.0) for longitude in around for each in latitudes]
        shares = [timestep + span * number / self.probes for number in range(self.probes)]
        self.probe_timesteps = [int(share * self.prior.num_timesteps) for share in shares]

    def samples_per_pair(self, starts: int) -> int:
        """See `Solver`; a compromise between the many candidates explored and the one refined."""
        return 2 * self.kept

    @timed
    @torch.inference_mode(False)
    @torch.no_grad()
    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        energy = PairEnergy(self.prior, pairs, seed)
        explored, energies = self.explore(energy, starts)
        chosen, row = choose(energies), torch.arange(len(pairs), device=starts.device)
        ends, valid = explored[:, :, -1].clone(), energies.isfinite()
        views = torch.stack([pairs.reference, pairs.query], dim=1)
        refined, sound, steps = self.refine(energy, views, pairs.ids, ends[row, chosen][:, None])
        ends[row, chosen] = refined[:, 0]
        valid[row, chosen] &= sound
        trajectory = None
        if self.trajectory:
            rest = explored[:, :, -1:].repeat(1, 1, steps.shape[1] - 1, 1)
            rest[row, chosen] = steps[:, 1:, 0]
            trajectory = torch.cat([explored, rest], dim=2)
        return Solution(reduce_longitude(ends), energies, valid, chosen, Cost(energy.passes), trajectory=trajectory)

    @timed
    @torch.inference_mode(False)
    @torch.no_grad()
    def solve_views(self, view_sets: ViewSets, starts: Tensor, seed: int) -> ViewSolution:
        """See `Solver.solve_views`: joint choice and refinement; energies are those of the chosen candidates."""
        sets, views = view_sets.views.shape
        energy = PairEnergy(self.prior, view_sets.with_first(), seed)
        explored, alone = self.explore(energy, starts.flatten(0, 1))
        poses, alone = (each.unflatten(0, (sets, views - 1)) for each in (explored[:, :, -1], alone))
        duos = list(combinations(range(views - 1), 2))
        between = self.energies_between(energy, view_sets, poses, duos)
        chosen = triangular_choice(alone, between, duos)
        selected = poses.take_along_dim(chosen[..., None, None], dim=2).squeeze(2)
        refined, valid, _ = self.refine(energy, view_sets.views, view_sets.ids, selected)
        energies = alone.new_full((sets, views, views), torch.nan)
        energies[:, 0, 1:] = alone.gather(2, chosen[..., None]).squeeze(-1)
        row = torch.arange(sets, device=chosen.device)
        for number, (i, j) in enumerate(duos):
            energies[:, i + 1, j + 1] = between[row, number, chosen[:, i], chosen[:, j]]
        valid = valid & energies[:, 0, 1:].isfinite().all(dim=1)
        energies = torch.where(energies.isnan(), energies.mT, energies)  # each averages both directions
        return ViewSolution(reduce_longitude(refined), energies, valid, Cost(energy.passes))

    def explore(self, energy: PairEnergy, starts: Tensor) -> tuple[Tensor, Tensor]:
        """Probe all candidates, descend from the better half for a few steps, and probe again: the trajectories
        `[B, K, steps, 3]` of the K best, best first, and their probed energies `[B, K]` (NaN if the prior failed)."""
        given = self.candidates == "starts"
        poses = starts.clone() if given else starts.new_tensor(self.grid).repeat(len(starts), 1, 1)
        noise = energy.noise(self.exploration_steps, len(self.probe_timesteps))
        probed = energy.mean(poses, self.probe_timesteps, noise)
        poses = poses.take_along_dim(_order(probed)[:, : max(1, poses.shape[1] // 2), None], dim=1)

        def one_direction(poses: Tensor, step: int) -> Tensor:
            pairs, noise = energy.pairs, energy.noise(step)[:, 0, step % 2]
            if step % 2 == 0:
                return self._errors(energy, pairs.query, pairs.reference, poses, noise)
            return self._errors(energy, pairs.reference, pairs.query, -poses, noise)

        steps, rate = self.exploration_steps, GradientDescent(poses, self.exploration_rate)
        trajectory, _, valid = descend(one_direction, lambda poses: poses, poses, steps, rate)
        trajectory = trajectory[:, :, : max(1, steps)]  # as published, the last pose before an update counts
        probed = energy.mean(trajectory[:, :, -1], self.probe_timesteps, noise).masked_fill(~valid, torch.nan)
        best = _order(probed)[:, : self.kept]
        return trajectory.take_along_dim(best[..., None, None], dim=1), probed.gather(1, best)

    def energies_between(
        self, energy: PairEnergy, view_sets: ViewSets, poses: Tensor, duos: Sequence[tuple[int, int]]
    ) -> Tensor:
        """Probed energies `[S, P, K, K]` of the relative poses implied by candidates `[S, V - 1, K, 3]` for P unordered
        pairs (`duos`) of the images after the first, numbered from 0."""
        sets, _, count, _ = poses.shape
        if not duos:
            return poses.new_empty(sets, 0, count, count)
        i, j = ([duo[end] for duo in duos] for end in (0, 1))
        pairs = view_sets.pairs([each + 1 for each in i], [each + 1 for each in j])
        probe = PairEnergy(self.prior, pairs, energy.seed, energy.codes)
        implied = poses[:, j][:, :, None] - poses[:, i][:, :, :, None]  # [S, P, K of i, K of j, 3]
        noise = probe.noise(self.exploration_steps, len(self.probe_timesteps))
        energies = probe.mean(implied.flatten(2, 3).flatten(0, 1), self.probe_timesteps, noise)
        energy.passes += probe.passes
        return energies.view(sets, len(duos), count, count)

    def refine(self, energy: PairEnergy, views: Tensor, ids: Tensor, selected: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Gradient descent on the poses `[S, V - 1, 3]` of sets of images `[S, V]`, one ordered pair per step: answers
        `[S, V - 1, 3]`, whether they are valid `[S]`, and trajectories `[S, steps + 1, V - 1, 3]`."""
        others, keys = selected.shape[1], on_cpu(ids)
        cycle = [pair for duo in combinations(range(others + 1), 2) for pair in (duo, duo[::-1])]  # (source, target)
        moved = self._moved(cycle, keys, energy.seed, others).to(ids.device)  # [steps, S, V]

        def one_pair(flat: Tensor, step: int) -> Tensor:
            source, target = cycle[step % len(cycle)]
            poses = pad(flat.unflatten(2, (others, 3)), (0, 0, 1, 0))[:, 0]  # [S, V, 3], 0 for the first image
            poses = torch.where(moved[step][..., None], poses, poses.detach())
            noise = keyed_noise(self.prior, ids.device, energy.seed, _REFINEMENT, keys, step)
            relative = (poses[:, target] - poses[:, source])[:, None]
            return self._errors(energy, views[:, target], views[:, source], relative, noise)

        flat = selected.flatten(1)[:, None]
        rate = GradientDescent(flat, self.refinement_rate)
        trajectory, _, valid = descend(one_pair, lambda poses: poses, flat, len(moved), rate)
        trajectory = trajectory[:, 0].unflatten(2, (others, 3))  # [S, steps + 1, V - 1, 3]
        # As published, a pose is recorded at the start of the step after its update, so the last step's never is.
        recorded = moved[:-1, :, 1:].transpose(0, 1)  # [S, steps - 1, V - 1]
        late = recorded & (recorded.flip(1).cumsum(1).flip(1) <= self.averaged)
        count = late.sum(dim=1)[..., None]
        mean = trajectory[:, 1:-1].masked_fill(~late[..., None], 0.0).sum(dim=1) / count
        return torch.where(count > 0, mean, selected), valid[:, 0], trajectory

    def _moved(self, cycle: Sequence[tuple[int, int]], ids: Tensor, seed: int, others: int) -> Tensor:
        """The image that each step moves, `[steps, S, V]`: never the first; random if neither is the first."""
        number = torch.arange(others * self.refinement_steps)[:, None]
        source, target = torch.tensor(cycle)[number % len(cycle)].unbind(-1)  # [steps, 1]
        coin = keyed_uniform(seed, _REFINEMENT, ids, number, count=1)[..., 0] < 0.5
        of_two = torch.where(coin, source, target)
        moved = torch.where(torch.minimum(source, target) > 0, of_two, torch.maximum(source, target))
        return one_hot(moved, others + 1).bool()

    def _errors(self, energy: PairEnergy, target: Tensor, source: Tensor, poses: Tensor, noise: Tensor) -> Tensor:
        """Denoising errors `[B, N]` of images `target` from `source` `[B]` at poses `[B, N, 3]`; one noise per row."""
        count, timestep = poses.shape[1], int(self.timestep * self.prior.num_timesteps)
        energy.passes += poses.shape[0] * count
        errors = self.prior.denoising_error(
            energy.codes[target.repeat_interleave(count)],
            energy.codes[source.repeat_interleave(count)],
            poses.flatten(0, 1),
            torch.full((len(target) * count,), timestep, device=poses.device),
            noise.repeat_interleave(count, dim=0),
        )
        return errors.view(-1, count)


def triangular_choice(alone: Tensor, between: Tensor, duos: Sequence[tuple[int, int]]) -> Tensor:
    """ID-Pose's joint selection of one of K candidates for each image after the first: indices `[S, V - 1]`.

    `alone` `[S, V - 1, K]` are the candidates' energies with the first image, `between` `[S, P, K, K]` those within
    the P `duos`. For every duo of its image, a candidate adds the minimum over partners of the sum of both `alone`
    energies and the one between, capped at three times its own so that an image without a good candidate does no harm.
    """
    alone, between = (each.nan_to_num(nan=torch.inf) for each in (alone, between))
    if not duos:
        return alone.argmin(dim=-1)
    total = torch.zeros_like(alone)
    for number, (i, j) in enumerate(duos):
        joint = alone[:, i, :, None] + alone[:, j, None, :] + between[:, number]
        total[:, i] += torch.minimum(joint.amin(dim=2), 3 * alone[:, i])
        total[:, j] += torch.minimum(joint.amin(dim=1), 3 * alone[:, j])
    return total.argmin(dim=-1)


def _order(energies: Tensor) -> Tensor:
    """Indices `[B, N]` that sort the energies `[B, N]` in ascending order, NaN last."""
    return energies.nan_to_num(nan=torch.inf).argsort(dim=1, stable=True)
