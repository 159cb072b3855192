"""Recall, success rate and median errors (paper, Evaluation Metrics), correct across processes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from lp_framework.data.pairs import ViewTable
from lp_framework.models.pair_mean import HostMetric, first_of_each

ROTATION_THRESHOLDS = (5, 15, 30)  # degrees
TRANSLATION_THRESHOLD = 0.2  # in units of the object's longest side
STATES = ("pair", "object", "rotation", "translation", "chosen", "answer", "probability")


class SolvedBatch(NamedTuple):
    """Results of a batch of P pairs from N starts, and its cost."""

    pair: Tensor  # [P, 2] int64, rows of reference and query in the view table
    object: Tensor  # [P] int64
    rotation: Tensor  # [P, N] float64, degrees
    translation: Tensor  # [P, N] float64, scene units
    chosen: Tensor  # [P] int64
    answer: Tensor  # [P, 3] float64
    probability: Tensor  # [P] float64, that the answer is within 30 degrees; NaN if the model has none
    seconds: float
    passes: int


def summarise(rotation: Tensor, translation: Tensor, chosen: Tensor) -> dict[str, float]:
    """The metrics of P pairs with N starts: errors `[P, N]` (degrees, scene units), chosen start `[P]`.

    R@d: share of pairs whose chosen start is within d degrees and 0.2; R(R)@d: by rotation only; SR, SR(R): the same
    over all starts. The errors are medians over the chosen starts. NaN counts as a failure.

    >>> summary = summarise(torch.tensor([[4.0, 90.0]]), torch.tensor([[0.3, 2.0]]), torch.tensor([0]))
    >>> summary["R@5"], summary["R(R)@5"], summary["SR(R)@5"]
    (0.0, 1.0, 0.5)
    """
    rotation, translation = rotation.nan_to_num(nan=torch.inf), translation.nan_to_num(nan=torch.inf)
    pick = chosen[:, None]
    metrics: dict[str, float] = {}
    for prefix, degrees, distance in (
        ("R", rotation.gather(1, pick), translation.gather(1, pick)),
        ("SR", rotation, translation),
    ):
        for threshold in ROTATION_THRESHOLDS:
            turned = degrees <= threshold
            metrics[f"{prefix}@{threshold}"] = (turned & (distance <= TRANSLATION_THRESHOLD)).double().mean().item()
            metrics[f"{prefix}(R)@{threshold}"] = turned.double().mean().item()
    for name, values in (("rotation_error", rotation), ("translation_error", translation)):
        # For an even count, the mean of the middle two; torch's median takes the lower one.
        metrics[name] = float(np.median(values.gather(1, pick).double().numpy()))
    return metrics


class PoseMetrics(HostMetric):
    """Gathers one row per pair of the views in `table`; solvers with `one_answer` per pair have no success rates over
    starts."""

    batch: list[Tensor]  # the first pair of each batch
    cost: list[Tensor]  # pairs, seconds, passes of each batch

    def __init__(self, table: ViewTable, one_answer: bool = False) -> None:
        super().__init__()
        self.table, self.one_answer = table, one_answer
        for state in (*STATES, "batch", "cost"):
            self.add_state(state, [], dist_reduce_fx="cat")
        self._rows: dict[str, Tensor] = {}

    def update(self, solved: SolvedBatch) -> None:
        """Add the pairs of a batch."""
        for state in STATES:
            getattr(self, state).append(getattr(solved, state))
        self.batch.append(solved.pair[:1])
        self.cost.append(torch.tensor([[len(solved.pair), solved.seconds, solved.passes]], dtype=torch.float64))

    def rows(self) -> dict[str, Tensor]:
        """One row per pair, from all processes, without duplicates, sorted by reference and query."""
        self.compute()  # cached until the next update
        return self._rows

    def compute(self) -> dict[str, Any]:
        """The metrics over all pairs, over objects with a unique answer (None if there are none), per object and per
        ambiguity class; `unanswered`, the share of pairs without an answer; number of pairs and cost per pair."""
        # Only here does torchmetrics provide the states of all processes.
        gathered = {state: dim_zero_cat(getattr(self, state)) for state in STATES}
        order = first_of_each(gathered["pair"])
        self._rows = rows = {state: value[order] for state, value in gathered.items()}
        # A batch counts once, even if several processes solved it.
        cost = dim_zero_cat(self.cost)[first_of_each(dim_zero_cat(self.batch))].sum(dim=0)

        def over(chosen: Tensor) -> dict[str, float] | None:
            if not len(chosen):
                return None
            summary = summarise(rows["rotation"][chosen], rows["translation"][chosen], rows["chosen"][chosen])
            return {key: value for key, value in summary.items() if not (self.one_answer and key.startswith("SR"))}

        def rows_of(objects: list[bool]) -> Tensor:
            return torch.tensor(objects)[rows["object"]].nonzero().flatten()

        counts = torch.bincount(rows["object"], minlength=len(self.table.names))
        of_each = rows["object"].argsort(stable=True).split(counts.tolist())  # the rows of each object
        classes = sorted(set(self.table.ambiguities), key=["unique", "twofold", "continuous", "unlabelled"].index)
        return {
            "metrics": over(torch.arange(len(rows["pair"]))),
            "metrics_unique_answer": over(rows_of([answer is True for answer in self.table.unique_answer])),
            "per_object": {name: over(chosen) for name, chosen in zip(self.table.names, of_each, strict=True)},
            "per_ambiguity": {
                name: over(rows_of([ambiguity == name for ambiguity in self.table.ambiguities])) for name in classes
            },
            "unanswered": rows["rotation"].gather(1, rows["chosen"][:, None]).isnan().double().mean().item(),
            "pairs": len(rows["pair"]),
            "seconds_per_pair": (cost[1] / cost[0]).item(),
            "network_passes_per_pair": (cost[2] / cost[0]).item(),
        }
