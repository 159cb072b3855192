"""Evaluation: run a solver on the pairs of a protocol and gather its errors into metrics."""

from __future__ import annotations

import torch
from lightning import LightningModule
from torch import Tensor

from lp_framework.data.module import PairDataModule
from lp_framework.data.pairs import PairBatch, ViewTable
from lp_framework.errors import UserError
from lp_framework.evaluation.journal import Journal
from lp_framework.evaluation.metrics import PoseMetrics, SolvedBatch
from lp_framework.geometry import (
    apply_relative_pose,
    at_optimal_scale,
    camera_to_world,
    relative_camera,
    rotation_error,
    translation_error,
)
from lp_framework.keyed_random import keyed_bits
from lp_framework.solvers.base import Solution, Solver, ViewSets, pairs_of
from lp_framework.solvers.starts import Starts


class Evaluation(LightningModule):
    """Runs a solver under `Trainer.test` with a `PairDataModule`, on any number of devices and processes.

    Afterwards `metrics.compute()` returns the metrics and `metrics.rows()` one row per pair. With a `journal`, each
    batch is saved when solved, and batches saved by an earlier run are not solved again.

    With `views`, `solve_views` is evaluated on sets of that many images, see `PairDataModule.evaluate_on`. Errors are
    those of the pairs of a set's first image (reference) with the others. A set has one answer, so SR equals R.
    """

    table: ViewTable
    metrics: PoseMetrics

    def __init__(
        self, solver: Solver, starts: Starts, seed: int, journal: Journal | None = None, views: int | None = None
    ) -> None:
        super().__init__()
        self.solver, self.starts, self.seed, self.journal, self.views = solver, starts, seed, journal, views
        # Registered so that Lightning moves the networks to the device.
        self.networks = torch.nn.ModuleList([*solver.networks(), *starts.networks()])

    def setup(self, stage: str) -> None:
        """Create the metrics, once the data and their objects are known, and read the journal."""
        data: PairDataModule = self.trainer.datamodule  # type: ignore[attr-defined]
        self.reset_metrics(data.table(data.evaluation_split()))
        found: list[SolvedBatch] | UserError = []
        # Only one process reads the journal, so that no other reads lines added by this run.
        if self.journal is not None and self.trainer.is_global_zero:
            try:
                found = self.journal.begin(data.fingerprint(data.evaluation_split()))
            except UserError as error:
                found = error
        found = self.trainer.strategy.broadcast(found)
        if isinstance(found, UserError):
            raise found if self.trainer.is_global_zero else SystemExit(1)  # report it once
        if not found:
            return
        pairs = torch.cat([batch.pair for batch in found])
        data.leave_out(pairs.tolist())
        self.print(f"resuming: {len(pairs.unique(dim=0))} pairs are already solved")
        # Each process needs some, because a metric without data cannot be gathered.
        for batch in found[self.trainer.global_rank :: self.trainer.world_size] or found[:1]:
            self.metrics.update(batch)

    def reset_metrics(self, table: ViewTable) -> None:
        """Reset the metrics, for pairs of the views in `table`."""
        self.table = table
        self.metrics = PoseMetrics(table, self.solver.one_answer)

    def solve(self, batch: PairBatch) -> Solution:
        """Solve a batch's pairs, or its sets; the solution of sets is returned as that of their pairs."""
        pairs = pairs_of(batch, self.device)
        starts = self.starts.make(pairs, self.seed)
        if self.views is None:
            return self.solver.solve(pairs, starts, self.seed)
        ids = pairs.ids.view(-1, self.views - 1)
        views = torch.cat([pairs.reference.view_as(ids)[:, :1], pairs.query.view_as(ids)], dim=1)
        set_ids = keyed_bits(*ids.unbind(dim=1), count=1)[:, 0].to(ids.device)
        view_sets = ViewSets(pairs.images, views, set_ids, pairs.field_of_view)
        solution = self.solver.solve_views(view_sets, starts.unflatten(0, ids.shape), self.seed)
        return Solution(
            poses=solution.poses.flatten(0, 1)[:, None],
            energies=solution.energies[:, 0, 1:].reshape(-1, 1),
            valid=solution.valid[:, None].expand_as(ids).reshape(-1, 1),
            chosen=torch.zeros_like(pairs.reference),
            cost=solution.cost,
            probability=None if solution.pairs is None else _chosen_probability(solution.pairs)[:, None],
        )

    def test_step(self, batch: PairBatch, batch_idx: int) -> None:
        solution = self.solve(batch)
        rotation, translation = errors(solution, batch)
        solved = SolvedBatch(
            pair=batch.pairs.cpu(),
            object=batch.objects[batch.reference].cpu(),
            rotation=rotation.double(),
            translation=translation.double(),
            chosen=solution.chosen.cpu(),
            answer=solution.answer().cpu().double(),
            probability=_chosen_probability(solution),
            seconds=solution.cost.seconds,
            passes=solution.cost.network_passes,
        )
        self.metrics.update(solved)
        if self.journal is not None:
            self.journal.append(solved, self.global_rank)


def _chosen_probability(solution: Solution) -> Tensor:
    """The probability of each answer `[P]`, float64 on the CPU; NaN if the model has none."""
    if solution.probability is None:
        return torch.full((len(solution.chosen),), torch.nan, dtype=torch.float64)
    return solution.probability.gather(1, solution.chosen[:, None])[:, 0].cpu().double()


def errors(solution: Solution, batch: PairBatch) -> tuple[Tensor, Tensor]:
    """Rotation (degrees) and translation errors `[P, N]` of the query's predicted camera, float64 on the CPU.

    Full cameras are evaluated at their optimal scale (the paper's Details of Baseline Settings). Invalid starts have
    NaN, which the metrics count as a failure.
    """
    reference, query = batch.reference.cpu(), batch.query.cpu()
    true = batch.cameras[query][:, None]
    if solution.cameras is None:
        pose = batch.poses[reference][:, None].double()
        predicted = camera_to_world(apply_relative_pose(pose, solution.poses.cpu().double()))
    else:
        camera = batch.cameras[reference][:, None]
        predicted = camera @ at_optimal_scale(solution.cameras.cpu().double(), relative_camera(camera, true))
    true, invalid = true.expand_as(predicted), ~solution.valid.cpu()
    rotation, translation = rotation_error(predicted, true), translation_error(predicted, true)
    return rotation.masked_fill(invalid, torch.nan), translation.masked_fill(invalid, torch.nan)
