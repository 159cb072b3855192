"""The paper's Joint Reasoning across Multiple Views: one consistent set of poses for two and more images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations, permutations
from typing import NamedTuple

import torch
from torch import Tensor

from lp_framework.clock import now
from lp_framework.errors import UserError
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.base import (
    Cost,
    Pairs,
    Solution,
    Solver,
    ViewSets,
    ViewSolution,
    check_starts,
    choose,
)
from lp_framework.solvers.descent import Adam, Plateau, descend
from lp_framework.solvers.langevin import Langevin
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.pose_graph import fit_views
from lp_framework.solvers.twist import TanhRadius, TwistDescent, TwistPoses

NEAREST = 0.1  # distance to the truth (radians, scene units) below which the norm of a score does not tell it


class Joint(NamedTuple):
    """N answers to each of S sets: `poses` `[S, N, V - 1, 3]` relative to the first image, `energies`
    `[S, N, V, V]` of the ordered pairs (row: reference), `valid` `[S, N]`, and the passes they took.
    """

    poses: Tensor
    energies: Tensor
    valid: Tensor
    passes: int


@register("solver", "multiview")
class MultiView(Solver):
    """Joint reasoning over 2 to 8 images: pairwise first stage, a robust fit of absolute poses, joint refinement.

    First stage: `langevin` (`alpha`, `gamma`, `iterations`) on all ordered pairs, each from the starts of its query.
    All their ends are measurements for `fit_views`, weighted by 1 / (|s|^2 + 0.1^2): the norm of an exact score is the
    distance that is left to the truth. Second stage: as in `two_stage`, a twist for each image but the first, by
    Adam from the fitted poses, descends the sum of the prior's energies over all ordered pairs (paper, Eq. 5).

    Without `first_stage` the second descends from the starts themselves, number n of all images together, and the
    answer has the least energy on `rescoring` noises and timesteps, the same for all. Without `second_stage` the
    answer is the fit. A pair is a set of two; with the first stage it has one answer whatever the number of starts.
    """

    def __init__(
        self,
        model: PoseModel,
        prior: Prior,
        first_stage: bool = True,
        second_stage: bool = True,
        alpha: float = 0.1,
        gamma: float | Sequence[float] = (0.0, 0.3, 0.0),
        iterations: int = 50,
        refinement_steps: int = 50,
        learning_rate: float = 0.1,
        factor: float = 0.7,
        patience: int = 10,
        first_timestep: int = 99,
        last_timestep: int = 0,
        rescoring: int = 16,
    ) -> None:
        if not (first_stage or second_stage):
            raise UserError("solver.first_stage and solver.second_stage cannot both be false; nothing would be left")
        if refinement_steps < 1:
            raise UserError(f"solver.refinement_steps must be at least 1, got {refinement_steps}")
        self.model, self.prior = model, prior
        self.first_stage, self.second_stage = first_stage, second_stage
        self.first = Langevin(model, alpha, gamma, iterations)
        # Of the second stage of `two_stage` this is the schedule.
        self.second = TwistDescent(
            prior,
            TanhRadius(),
            refinement_steps,
            learning_rate,
            factor,
            patience,
            first_timestep,
            last_timestep,
            "rescored",
            rescoring,
            fresh_noise=True,
            trajectory=False,
        )

    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        """See `Solver.solve`: each pair as a set of two images; one pose a pair, or one a start without first stage."""
        check_starts(pairs, starts)
        began = now(starts.device)
        view_sets = ViewSets(pairs.images, torch.stack([pairs.reference, pairs.query], dim=1), pairs.ids)
        joint = self._solve(view_sets, starts[:, None], seed)
        energies = (joint.energies[..., 0, 1] + joint.energies[..., 1, 0]) / 2
        return Solution(
            poses=joint.poses[:, :, 0],
            energies=energies,
            valid=joint.valid,
            chosen=choose(energies.masked_fill(~joint.valid, torch.nan)),
            cost=Cost(joint.passes, now(starts.device) - began),
        )

    def solve_views(self, view_sets: ViewSets, starts: Tensor, seed: int) -> ViewSolution:
        """See `Solver.solve_views`. A set is invalid when model or prior failed so that an image's pose is unknown."""
        check_starts(view_sets, starts)
        began = now(starts.device)
        joint = self._solve(view_sets, starts, seed)
        chosen = choose(joint.energies.nansum(dim=(-2, -1)).masked_fill(~joint.valid, torch.nan))
        sets = torch.arange(len(view_sets), device=chosen.device)
        return ViewSolution(
            poses=joint.poses[sets, chosen],
            energies=joint.energies[sets, chosen],
            valid=joint.valid[sets, chosen],
            cost=Cost(joint.passes, now(starts.device) - began),
        )

    @torch.inference_mode(False)
    @torch.no_grad()
    def _solve(self, view_sets: ViewSets, starts: Tensor, seed: int) -> Joint:
        """All answers from starts `[S, V - 1, N, 3]`: one with the first stage, one a start without."""
        sets, others, count, _ = starts.shape
        initial = Joint(
            starts.transpose(1, 2).clone(),
            starts.new_full((sets, count, others + 1, others + 1), torch.nan),
            torch.ones(sets, count, dtype=torch.bool, device=starts.device),
            0,
        )
        if self.first_stage:
            initial = self._fitted(view_sets, starts, seed)
        return self._refined(view_sets, initial, seed) if self.second_stage else initial

    def _fitted(self, view_sets: ViewSets, starts: Tensor, seed: int) -> Joint:
        """The first stage on all ordered pairs and the fit of their ends."""
        sets, views = view_sets.views.shape
        reference, query = torch.tensor(list(permutations(range(views), 2))).T.tolist()
        back = torch.stack([-starts[..., 0], -starts[..., 1] % (2 * math.pi), -starts[..., 2]], dim=-1)
        pair_starts = [starts[:, j - 1] if j > 0 else back[:, i - 1] for i, j in zip(reference, query, strict=True)]
        pairs = view_sets.pairs(reference, query)
        solution = self.first.solve(pairs, torch.stack(pair_starts, dim=1).flatten(0, 1), seed)
        measured = starts.new_full((sets, views, views, starts.shape[2], 3), torch.nan)
        measured[:, reference, query] = solution.poses.unflatten(0, (sets, -1))
        weights = torch.zeros_like(measured[..., 0])
        weights[:, reference, query] = 1 / (solution.energies.unflatten(0, (sets, -1)).square() + NEAREST**2)
        weights = weights.masked_fill(~weights.isfinite(), 0.0)
        known = (weights > 0).any(dim=-1)
        return Joint(
            poses=fit_views(measured, weights)[:, None, 1:].to(starts.dtype),
            energies=starts.new_full((sets, 1, views, views), torch.nan),
            valid=(known | known.mT).any(dim=-1).all(dim=-1, keepdim=True),
            passes=solution.cost.network_passes,
        )

    def _refined(self, view_sets: ViewSets, initial: Joint, seed: int) -> Joint:
        """The second stage from N sets of poses at once."""
        sets, count, others, _ = initial.poses.shape
        ends = list(zip(*combinations(range(others + 1), 2), strict=True))
        energy = PairEnergy(self.prior, view_sets.pairs(*ends), seed)  # both directions of an unordered pair
        first, second = torch.tensor(ends, device=initial.poses.device)
        twist = initial.poses.new_zeros(sets, count, others * 6)
        to_poses = TwistPoses(initial.poses, self.second.radius_map)

        def pose_of(twist: Tensor) -> Tensor:
            return to_poses(twist.unflatten(-1, (others, 6))).flatten(-2)

        def relative(poses: Tensor) -> Tensor:
            """Relative poses `[S x pairs, N, 3]` of poses `[S, N, (V - 1) x 3]`."""
            poses = poses.unflatten(-1, (others, 3))
            poses = torch.cat([torch.zeros_like(poses[:, :, :1]), poses], dim=2)
            return (poses[:, :, second] - poses[:, :, first]).transpose(1, 2).flatten(0, 1)

        def of_step(poses: Tensor, step: int) -> Tensor:
            """The sum over ordered pairs, `[S, N]`."""
            timestep = self.second.timestep(step / self.second.steps)
            return 2 * energy(relative(poses), timestep, energy.noise(step)[:, 0]).unflatten(0, (sets, -1)).sum(dim=1)

        adam = Adam(twist, self.second.learning_rate)
        plateau = Plateau(adam, self.second.factor, self.second.patience)
        path, _, valid = descend(of_step, pose_of, twist, self.second.steps, adam, plateau)
        poses, rescoring = path[:, :, -1], self.second.rescoring
        noise = energy.noise(self.second.steps, rescoring)
        directed = torch.stack(
            [
                energy.residual(relative(poses), self.second.timestep((number + 0.5) / rescoring), noise[:, number])
                .square()
                .mean(dim=-1)
                for number in range(rescoring)
            ]
        ).mean(dim=0)  # [S x pairs, N, 2]
        energies = torch.full_like(initial.energies, torch.nan)
        energies[:, :, first, second], energies[:, :, second, first] = (
            directed.unflatten(0, (sets, -1)).transpose(1, 2).unbind(dim=-1)
        )
        finite = directed.isfinite().all(dim=-1).unflatten(0, (sets, -1)).all(dim=1)
        return Joint(
            poses=poses.unflatten(-1, (others, 3)),
            energies=energies,
            valid=initial.valid & valid & finite,
            passes=initial.passes + energy.passes,
        )
