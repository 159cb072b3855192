"""Evaluation of a solver on sets of several images, a row for each image but the first."""

from __future__ import annotations

import torch

from lp_framework.data.pairs import PairBatch
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.evaluation.journal import Journal
from lp_framework.keyed_random import keyed_bits
from lp_framework.solvers.base import Solution, Solver, ViewSets, pairs_of
from lp_framework.solvers.starts import Starts


class ViewSetEvaluation(Evaluation):
    """`Evaluation` of `solve_views` on sets of `views` images, with the batches of `PairDataModule.evaluate_on_sets`.

    Metrics and rows are those of pairs: the first image of a set is the reference of each of its others, whose pose
    relative to it is judged. A set has one answer, so SR equals R.
    """

    def __init__(self, solver: Solver, starts: Starts, seed: int, views: int, journal: Journal | None = None) -> None:
        super().__init__(solver, starts, seed, journal)
        self.others = views - 1

    def solve(self, batch: PairBatch) -> Solution:
        """The sets' solution, as one of the pairs of each first image with the others."""
        pairs = pairs_of(batch, self.device)
        ids = pairs.ids.view(-1, self.others)
        views = torch.cat([pairs.reference.view_as(ids)[:, :1], pairs.query.view_as(ids)], dim=1)
        view_sets = ViewSets(pairs.images, views, keyed_bits(*ids.unbind(dim=1), count=1)[:, 0].to(ids.device))
        starts = self.starts.make(pairs, self.seed).unflatten(0, (-1, self.others))
        solution = self.solver.solve_views(view_sets, starts, self.seed)
        poses = solution.poses.flatten(0, 1)[:, None]
        return Solution(
            poses=poses,
            energies=solution.energies[:, 0, 1:].reshape(-1, 1),
            valid=solution.valid[:, None].expand(-1, self.others).reshape(-1, 1),
            chosen=torch.zeros(len(poses), dtype=torch.int64, device=poses.device),
            cost=solution.cost,
        )
