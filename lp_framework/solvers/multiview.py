"""The paper's Joint Reasoning across Multiple Views: one consistent set of poses for two or more images."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, permutations
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from lp_framework.errors import UserError, at_least
from lp_framework.geometry import relative_pose
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.base import Cost, Pairs, Solution, Solver, ViewSets, ViewSolution, choose, timed
from lp_framework.solvers.langevin import make_first_stage
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.pose_graph import fit_views
from lp_framework.solvers.twist import TwistDescent, TwistPoses

NEAREST = 0.1  # distance to the truth (radians, scene units) below which a model cannot resolve it


class Joint(NamedTuple):
    """N answers for each of S sets: `poses` `[S, N, V - 1, 3]` relative to the first image, `energies`
    `[S, N, V, V]` of the ordered pairs (NaN: not computed), `valid` `[S, N]`, and the number of network `passes`."""

    poses: Tensor
    energies: Tensor
    valid: Tensor
    passes: int


@register("solver", "multiview")
class MultiView(Solver):
    """Joint reasoning over 2 to 8 images: pairwise first stage, a robust fit of absolute poses, joint refinement.

    All final poses of the first stage are measurements for the fit, weighted by 1 / (d^2 + 0.1^2), where d is the
    model's estimate of the distance to the truth (`choose_by=distance` of `langevin`). If the model has densities,
    those of all pairs are combined instead, as `langevin` does for sets. Without `first_stage`, the second stage
    descends from the starts (the n-th start of every image together), and the answer has the lowest energy over
    `rescoring` noises and timesteps shared by all. A pair is a set of two.
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
        at_least(1, "solver", refinement_steps=refinement_steps)
        self.model, self.prior = model, prior
        self.first_stage, self.second_stage = first_stage, second_stage
        self.first = make_first_stage(model, alpha, gamma, iterations)
        schedule = (refinement_steps, learning_rate, factor, patience, first_timestep, last_timestep)
        self.second = TwistDescent(prior, *schedule, rescoring=rescoring)

    @timed
    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        """See `Solver.solve`: each pair is a set of two; one pose per pair, or per start without the first stage."""
        views = torch.stack([pairs.reference, pairs.query], dim=1)
        view_sets = ViewSets(pairs.images, views, pairs.ids, pairs.field_of_view)
        joint = self._solve(view_sets, starts[:, None], seed)
        energies = (joint.energies[..., 0, 1] + joint.energies[..., 1, 0]) / 2
        chosen = choose(energies.masked_fill(~joint.valid, torch.nan))
        return Solution(joint.poses[:, :, 0], energies, joint.valid, chosen, Cost(joint.passes))

    @timed
    def solve_views(self, view_sets: ViewSets, starts: Tensor, seed: int) -> ViewSolution:
        """See `Solver.solve_views`. A set is invalid if a failure of model or prior leaves an image's pose unknown."""
        joint = self._solve(view_sets, starts, seed)
        chosen = choose(joint.energies.nansum(dim=(-2, -1)).masked_fill(~joint.valid, torch.nan))
        sets = torch.arange(len(view_sets), device=chosen.device)
        poses, energies, valid = (each[sets, chosen] for each in (joint.poses, joint.energies, joint.valid))
        return ViewSolution(poses, energies, valid, Cost(joint.passes))

    @torch.inference_mode(False)
    @torch.no_grad()
    def _solve(self, view_sets: ViewSets, starts: Tensor, seed: int) -> Joint:
        """All answers from starts `[S, V - 1, N, 3]`: one with the first stage, one per start without it."""
        if self.first_stage and self.model.has_density:
            found = self.first.solve_views(view_sets, starts, seed)
            poses, valid, passes = found.poses[:, None], found.valid[:, None], found.cost.network_passes
        elif self.first_stage:
            measured, weights, passes = self.measure(view_sets, starts, seed)
            poses, valid = self.fit(measured, weights)
        else:
            poses, passes = starts.transpose(1, 2).clone(), 0
            valid = torch.ones_like(poses[:, :, 0, 0], dtype=torch.bool)
        sets, views = view_sets.views.shape
        joint = Joint(poses, poses.new_full((sets, poses.shape[1], views, views), torch.nan), valid, passes)
        return self.refine(view_sets, joint, seed) if self.second_stage else joint

    def measure(self, view_sets: ViewSets, starts: Tensor, seed: int) -> tuple[Tensor, Tensor, int]:
        """1. Run the first stage (Eq. 4) on all ordered pairs, each from the starts of its query relative to its
        reference: relative poses `[S, V, V, N, 3]` (row: reference, column: query), their weights `[S, V, V, N]` (0 if
        missing), and the number of network passes."""
        sets, views = view_sets.views.shape
        reference, query = torch.tensor(list(permutations(range(views), 2))).T.tolist()
        back = relative_pose(starts, torch.zeros_like(starts))
        from_starts = [starts[:, j - 1] if j > 0 else back[:, i - 1] for i, j in zip(reference, query, strict=True)]
        pairs = view_sets.pairs(reference, query)
        solution = self.first.solve(pairs, torch.stack(from_starts, dim=1).flatten(0, 1), seed)
        poses = starts.new_full((sets, views, views, starts.shape[2], 3), torch.nan)
        poses[:, reference, query] = solution.poses.unflatten(0, (sets, -1))
        weights = torch.zeros_like(poses[..., 0])
        distance = solution.energies.unflatten(0, (sets, -1))
        weights[:, reference, query] = 1 / (distance.square() + NEAREST**2)
        return poses, weights.masked_fill(~weights.isfinite(), 0.0), solution.cost.network_passes

    def fit(self, measured: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """2. Robust fit: one answer per set `[S, 1, V - 1, 3]`, valid `[S, 1]` if every image has measurements."""
        poses = fit_views(measured, weights)[:, None, 1:].to(measured)
        known = (weights > 0).any(dim=-1)
        return poses, (known | known.mT).any(dim=-1).all(dim=-1, keepdim=True)

    def refine(self, view_sets: ViewSets, initial: Joint, seed: int) -> Joint:
        """3. Joint descent (Eq. 5) from N sets of poses at once, over a twist for each image except the first."""
        sets, _, others, _ = initial.poses.shape
        ends = list(zip(*combinations(range(others + 1), 2), strict=True))
        energy = PairEnergy(self.prior, view_sets.pairs(*ends), seed)  # both directions of an unordered pair
        first, second = torch.tensor(ends, device=initial.poses.device)
        to_poses = TwistPoses(initial.poses, self.second.radius_map)

        def pose_of(twist: Tensor) -> Tensor:
            """Poses `[S, N, (V - 1) x 3]` of twists `[S, N, (V - 1) x 6]`."""
            return to_poses(twist.unflatten(-1, (others, 6))).flatten(-2)

        def relative(poses: Tensor) -> Tensor:
            """Relative poses `[S x pairs, N, 3]` of poses `[S, N, (V - 1) x 3]`."""
            poses = pad(poses.unflatten(-1, (others, 3)), (0, 0, 1, 0))  # 0 for the first image
            return (poses[:, :, second] - poses[:, :, first]).transpose(1, 2).flatten(0, 1)

        def of_step(poses: Tensor, step: int) -> Tensor:
            """The sum over ordered pairs, `[S, N]`."""
            energies = energy(relative(poses), self.second.timestep(step / self.second.steps), energy.noise(step)[:, 0])
            return 2 * energies.unflatten(0, (sets, -1)).sum(dim=1)

        twist = initial.poses.new_zeros(*initial.poses.shape[:2], others * 6)
        trajectory, _, valid = self.second.descend(of_step, pose_of, twist)
        ends_of_all, noise = trajectory[:, :, -1], energy.noise(self.second.steps, self.second.rescoring)
        residuals = (
            energy.residual(relative(ends_of_all), timestep, noise[:, number])
            for number, timestep in enumerate(self.second.rescoring_timesteps())
        )
        directed = torch.stack([each.square().mean(dim=-1) for each in residuals]).mean(dim=0)
        directed = directed.unflatten(0, (sets, -1)).transpose(1, 2)  # [S, N, pairs, 2]
        energies = torch.full_like(initial.energies, torch.nan)
        energies[:, :, first, second], energies[:, :, second, first] = directed.unbind(dim=-1)
        valid = initial.valid & valid & directed.isfinite().all(dim=-1).all(dim=-1)
        return Joint(ends_of_all.unflatten(-1, (others, 3)), energies, valid, initial.passes + energy.passes)
