"""Evaluation: a solver on the pairs of a protocol, its errors gathered into metrics."""

from __future__ import annotations

from typing import Any

import torch
from lightning import LightningModule
from torch import Tensor
from torchmetrics import SumMetric

from lp_framework.data.module import PairDataModule
from lp_framework.data.pairs import PairBatch, ViewTable
from lp_framework.evaluation.metrics import PoseMetrics
from lp_framework.geometry import (
    apply_relative_pose,
    at_optimal_scale,
    camera_to_world,
    relative_camera,
    rotation_error,
    translation_error,
)
from lp_framework.solvers.base import Pairs, Solution, Solver
from lp_framework.solvers.starts import Starts


class Evaluation(LightningModule):
    """Runs a solver under `Trainer.test` with a `PairDataModule`, so on any number of devices and processes.

    Afterwards `result` gives the metrics (see `PoseMetrics`), `metrics.rows()` a row a pair.
    """

    table: ViewTable
    metrics: PoseMetrics

    def __init__(self, solver: Solver, starts: Starts, seed: int) -> None:
        super().__init__()
        self.solver, self.starts, self.seed = solver, starts, seed
        # Registered, so that Lightning moves the networks of the solver to the device.
        self.networks = torch.nn.ModuleList(solver.networks())
        self.solved, self.seconds, self.passes = SumMetric(), SumMetric(), SumMetric()

    def setup(self, stage: str) -> None:
        """The objects are known once the data are prepared."""
        data: PairDataModule = self.trainer.datamodule  # type: ignore[attr-defined]
        self.gather_for(data.table(data.evaluation_split()))

    def gather_for(self, table: ViewTable) -> None:
        """Start with no results, for pairs of the views in `table`."""
        self.table = table
        self.metrics = PoseMetrics(table.names, table.ambiguities, table.unique_answer)

    def solve(self, batch: PairBatch) -> Solution:
        """The solver's solution of a batch's pairs."""
        assert batch.images is not None  # evaluation never caches features
        ids = self.table.pair_ids(batch.pairs).to(self.device)
        pairs = Pairs(batch.images, batch.reference, batch.query, ids)
        return self.solver.solve(pairs, self.starts.make(ids, self.seed), self.seed)

    def test_step(self, batch: PairBatch, batch_idx: int) -> None:
        solution = self.solve(batch)
        rotation, translation = errors(solution, batch)
        poses = solution.answer().double()
        self.metrics.update(batch.pairs, batch.objects[batch.reference], rotation, translation, solution.chosen, poses)
        self.solved.update(len(batch))
        self.seconds.update(solution.cost.seconds)
        self.passes.update(solution.cost.network_passes)

    def result(self) -> dict[str, Any]:
        """The metrics with the cost: seconds and network passes a pair."""
        solved = self.solved.compute()
        return {
            **self.metrics.compute(),
            "seconds_per_pair": (self.seconds.compute() / solved).item(),
            "network_passes_per_pair": (self.passes.compute() / solved).item(),
        }


def errors(solution: Solution, batch: PairBatch) -> tuple[Tensor, Tensor]:
    """Rotation (degrees) and translation errors `[P, N]` of the query's predicted camera against its true one.

    Full cameras are taken at the scale that suits each best (the paper's Details of Baseline Settings).
    """
    true = batch.cameras[batch.query][:, None]
    if solution.cameras is None:
        reference = batch.poses[batch.reference][:, None].double()
        predicted = camera_to_world(apply_relative_pose(reference, solution.poses.double()))
    else:
        camera = batch.cameras[batch.reference][:, None]
        predicted = camera @ at_optimal_scale(solution.cameras.double(), relative_camera(camera, true))
    true = true.expand_as(predicted)
    return rotation_error(predicted, true), translation_error(predicted, true)
