"""The metrics against an independent implementation in plain Python and numpy; repeated pairs; two processes."""

from __future__ import annotations

import copy
import json
import math
import os
import pickle
import subprocess
import sys
import textwrap
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from lp_framework.evaluation.metrics import STATES, PoseMetrics, SolvedBatch, summarise
from lp_framework.evaluation.tables import summary_rows, write_json
from lp_framework.models.pair_mean import PairMean, first_of_each

NAMES = ["cup", "tram", "vase", "bowl"]
AMBIGUITIES = ["unique", "twofold", "continuous", "continuous"]
UNIQUE = [True, True, None, False]


def plain(rotation: NDArray, translation: NDArray, chosen: NDArray) -> dict[str, float]:
    """Recall, success rate and medians by loops; NaN compares false and is as far as can be."""
    metrics: dict[str, float] = {}
    pairs, starts = rotation.shape
    for degrees in (5, 15, 30):
        recall, recall_rotation, success, success_rotation = [], [], [], []
        for pair in range(pairs):
            turned = [bool(rotation[pair, start] <= degrees) for start in range(starts)]
            moved = [bool(translation[pair, start] <= 0.2) for start in range(starts)]
            both = [a and b for a, b in zip(turned, moved, strict=True)]
            recall.append(both[chosen[pair]])
            recall_rotation.append(turned[chosen[pair]])
            success += both
            success_rotation += turned
        metrics[f"R@{degrees}"], metrics[f"R(R)@{degrees}"] = np.mean(recall), np.mean(recall_rotation)
        metrics[f"SR@{degrees}"], metrics[f"SR(R)@{degrees}"] = np.mean(success), np.mean(success_rotation)
    for name, values in (("rotation_error", rotation), ("translation_error", translation)):
        picked = values[np.arange(pairs), chosen]
        metrics[name] = float(np.median(np.where(np.isnan(picked), np.inf, picked)))
    return {key: float(value) for key, value in metrics.items()}


def errors(pairs: int, starts: int, seed: int = 0, share_of_nan: float = 0.1) -> tuple[torch.Tensor, ...]:
    """Errors that pass and miss every threshold, and chosen starts."""
    random = np.random.default_rng(seed)
    rotation, translation = random.uniform(0, 45, (pairs, starts)), random.uniform(0, 0.4, (pairs, starts))
    failed = random.random((pairs, starts)) < share_of_nan
    rotation[failed] = translation[failed] = np.nan
    return (
        torch.from_numpy(rotation),
        torch.from_numpy(translation),
        torch.from_numpy(random.integers(starts, size=pairs)),
    )


@pytest.mark.parametrize(("pairs", "starts"), [(1, 1), (2, 3), (57, 4), (80, 9)])
@pytest.mark.parametrize("share_of_nan", [0.0, 0.3, 0.7])
def test_a_summary_is_that_of_the_plain_implementation(pairs, starts, share_of_nan):
    given = errors(pairs, starts, pairs, share_of_nan)
    assert summarise(*given) == pytest.approx(plain(*(each.numpy() for each in given)), rel=1e-12)


def test_thresholds_are_inclusive():
    rotation = torch.tensor([[5.0], [15.0], [30.0], [math.nextafter(30.0, 31.0)]], dtype=torch.float64)
    translation = torch.tensor([[0.2], [0.2], [math.nextafter(0.2, 1.0)], [0.0]], dtype=torch.float64)
    summary = summarise(rotation, translation, torch.zeros(4, dtype=torch.long))
    assert [summary[f"R(R)@{degrees}"] for degrees in (5, 15, 30)] == [0.25, 0.5, 0.75]
    assert [summary[f"R@{degrees}"] for degrees in (5, 15, 30)] == [0.25, 0.5, 0.5]


def test_recall_is_of_the_chosen_start_and_success_of_all():
    rotation, translation = torch.tensor([[1.0, 90.0, 90.0, 3.0]]), torch.tensor([[0.1, 2.0, 2.0, 0.5]])
    right, wrong = (summarise(rotation, translation, torch.tensor([start])) for start in (0, 1))
    assert (right["R@5"], wrong["R@5"]) == (1.0, 0.0)
    assert right["SR@5"] == wrong["SR@5"] == 0.25
    assert right["SR(R)@5"] == wrong["SR(R)@5"] == 0.5
    assert (right["rotation_error"], wrong["rotation_error"]) == (1.0, 90.0)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([1.0], 1.0),
        ([4.0, 1.0], 2.5),
        ([3.0, 9.0, 1.0], 3.0),
        ([1.0, 2.0, 3.0, 10.0], 2.5),
        ([1.0, math.inf, math.inf], math.inf),
        ([1.0, math.inf], math.inf),
        ([1.0, 2.0, math.inf], 2.0),
    ],
)
def test_the_median(values, expected):
    errors = torch.tensor([math.nan if math.isinf(each) else each for each in values])[:, None]  # as far as can be
    assert summarise(errors, errors, torch.zeros(len(values), dtype=torch.long))["rotation_error"] == expected


# ---------------------------------------------------------------- the metric


def rows(pairs: int = 60, starts: int = 3, seed: int = 0) -> tuple[torch.Tensor, ...]:
    """What a batch has, for pairs of all four objects in a random order, not all that there are."""
    random = np.random.default_rng(seed)
    number = torch.from_numpy(random.permutation(1_000)[:pairs])
    pair = torch.stack([number // 32, number % 32], dim=1)
    rotation, translation, chosen = errors(pairs, starts, seed)
    answer = torch.from_numpy(random.normal(size=(pairs, 3)))
    probability = torch.from_numpy(random.uniform(size=pairs))
    return pair, torch.from_numpy(random.integers(4, size=pairs)), rotation, translation, chosen, answer, probability


def objects(names: list[str], ambiguities: list[str], unique_answer: list[bool | None]) -> SimpleNamespace:
    """What the metrics ask of a table of views."""
    return SimpleNamespace(names=names, ambiguities=ambiguities, unique_answer=unique_answer)


def solved(given: tuple[torch.Tensor, ...]) -> SolvedBatch:
    """A batch of these rows, each of which has taken half a second and three passes."""
    return SolvedBatch(*given, seconds=0.5 * len(given[0]), passes=3 * len(given[0]))


def fed(given: tuple[torch.Tensor, ...], batch: int = 7) -> PoseMetrics:
    """A metric that got the rows in batches."""
    metrics = PoseMetrics(objects(NAMES, AMBIGUITIES, UNIQUE))
    for start in range(0, len(given[0]), batch):
        metrics.update(solved(tuple(each[start : start + batch] for each in given)))
    return metrics


def expected(given: tuple[torch.Tensor, ...]) -> dict[str, Any]:
    pair, objects, rotation, translation, chosen, *_ = (each.numpy() for each in given)

    def over(members: list[int]) -> dict[str, float] | None:
        mask = np.isin(objects, members)
        return plain(rotation[mask], translation[mask], chosen[mask]) if mask.any() else None

    return {
        "metrics": over([0, 1, 2, 3]),
        "metrics_unique_answer": over([0, 1]),
        "per_object": {name: over([index]) for index, name in enumerate(NAMES)},
        "per_ambiguity": {"unique": over([0]), "twofold": over([1]), "continuous": over([2, 3])},
        "unanswered": float(np.isnan(rotation[np.arange(len(pair)), chosen]).mean()),
        "pairs": len(pair),
        "seconds_per_pair": 0.5,
        "network_passes_per_pair": 3.0,
    }


def same(found: Any, wanted: Any) -> bool:
    if isinstance(wanted, dict):
        return found.keys() == wanted.keys() and all(same(found[key], wanted[key]) for key in wanted)
    return wanted is found if wanted is None else found == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize("batch", [1, 7, 60])
def test_the_metric_is_the_plain_one_overall_and_by_group(batch):
    given = rows()
    assert same(fed(given, batch).compute(), expected(given))


def test_objects_without_pairs_and_sets_without_labels_have_none():
    given = rows(pairs=5)
    given[1][:] = 2
    result = fed(given).compute()
    assert result["metrics_unique_answer"] is None
    assert result["per_object"]["cup"] is None
    assert result["per_object"]["vase"] == result["metrics"]
    unlabelled = PoseMetrics(objects(["a"], ["unlabelled"], [None]))
    unlabelled.update(solved((given[0], torch.zeros(5, dtype=torch.long), *given[2:])))
    result = unlabelled.compute()
    assert result["metrics_unique_answer"] is None
    assert same(result["per_ambiguity"], {"unlabelled": result["metrics"]})


def test_a_repeated_pair_counts_once():
    given = rows()
    twice = tuple(torch.cat([each, each[10:25], each[:3]]) for each in given)
    assert same(fed(twice).compute(), expected(given))
    assert fed(twice).rows()["pair"].tolist() == sorted(given[0].tolist())


def test_rows_are_sorted_whole_and_up_to_date():
    given = rows()
    metrics = fed(given)
    order = (given[0] @ torch.tensor([32, 1])).argsort()
    metrics.compute()
    for state, value in zip(STATES, given, strict=True):
        torch.testing.assert_close(metrics.rows()[state], value[order], rtol=0, atol=0, equal_nan=True)
    more = rows(pairs=4)
    metrics.update(solved((more[0] + 5_000, *more[1:])))
    assert len(metrics.rows()["pair"]) == 64
    metrics.compute()
    metrics.reset()
    metrics.update(solved(more))
    assert len(metrics.rows()["pair"]) == 4


@pytest.mark.parametrize("copied", [lambda each: pickle.loads(pickle.dumps(each)), copy.deepcopy, PoseMetrics.clone])
def test_pickled_and_cloned_metrics_can_be_updated(copied):
    given = rows()
    metrics = copied(fed(tuple(each[:30] for each in given)))
    metrics.update(solved(tuple(each[30:] for each in given)))
    assert same(metrics.compute(), expected(given))


def test_the_mean_over_pairs_counts_a_pair_once_in_double_precision():
    pair, value = torch.tensor([4, 2, 4, 9]), torch.tensor([1.0, 2.0, 1.0, 6.0])
    mean = PairMean()
    mean.update(pair[:3], value[:3])
    mean.update(pair[3:], value[3:])
    assert mean.compute() == 3.0
    assert torch.equal(first_of_each(pair), torch.tensor([1, 0, 3]))
    rows = torch.tensor([[2, 1], [0, 7], [2, 0], [0, 7]])
    assert torch.equal(first_of_each(rows), torch.tensor([1, 2, 0]))


# ---------------------------------------------------------------- two processes

SHARE = """
    import json, pickle, sys
    from pathlib import Path
    from types import SimpleNamespace
    from lp_framework import torchvision_ops
    torchvision_ops.install()
    import torch
    from lp_framework.evaluation.metrics import PoseMetrics, SolvedBatch
    from lp_framework.models.backbones import Standardise
    from lp_framework.models.pair_mean import PairMean

    folder, rank = Path(sys.argv[1]), int(sys.argv[2])
    names, ambiguities, unique, given = pickle.loads((folder / "given.pickle").read_bytes())
    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=2)
    table = SimpleNamespace(names=names, ambiguities=ambiguities, unique_answer=unique)
    metrics, mean = PoseMetrics(table), PairMean()
    batches = [tuple(each[start : start + 8] for each in given) for start in range(0, len(given[0]), 8)]
    assert len(batches) % 2  # so one batch is met twice
    for step in range((len(batches) + 1) // 2):
        batch = batches[(2 * step + rank) % len(batches)]
        metrics.update(SolvedBatch(*batch, seconds=0.5 * len(batch[0]), passes=3 * len(batch[0])))
        mean.update(batch[0], batch[2].nan_to_num(nan=100.0).mean(dim=1))
    result = metrics.compute()
    result = {**result, "mean": mean.compute().item(), "rows": metrics.rows()["pair"].tolist()}
    layer = Standardise(2).train()
    for part in torch.arange(24.0).square().view(2, 6, 2):  # each process meets half of each part
        layer(part[3 * rank : 3 * rank + 3])
    result["standardised"] = [layer.mean.tolist(), layer.variance.tolist()]
    (folder / f"result_{rank}.json").write_text(json.dumps(result))
    torch.distributed.barrier()
    torch.distributed.destroy_process_group()
"""


@pytest.mark.heavy
def test_two_processes_give_the_result_of_one_and_count_padding_once(tmp_path):
    given = rows(pairs=53)
    (tmp_path / "given.pickle").write_bytes(pickle.dumps((NAMES, AMBIGUITIES, UNIQUE, given)))
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1]), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", textwrap.dedent(SHARE), str(tmp_path)]
    processes = [
        subprocess.Popen([*command, str(rank)], env=environment, stderr=subprocess.PIPE, text=True) for rank in (0, 1)
    ]
    printed = [process.communicate(timeout=100)[1] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], printed
    one = PairMean()
    one.update(given[0], given[2].nan_to_num(nan=100.0).mean(dim=1))
    for rank in (0, 1):
        result = json.loads((tmp_path / f"result_{rank}.json").read_text())
        assert result.pop("mean") == one.compute().item()
        features = torch.arange(24.0).square().view(12, 2)
        moments = [features.mean(dim=0).tolist(), features.var(dim=0, unbiased=False).tolist()]
        np.testing.assert_allclose(result.pop("standardised"), moments, rtol=1e-5)
        assert result.pop("rows") == sorted(given[0].tolist())
        assert same(result, expected(given))


# ---------------------------------------------------------------- on disk


def test_non_finite_values_are_null_on_disk(tmp_path):
    write_json(tmp_path / "results.json", {"a": math.inf, "b": [math.nan, 1.0], "c": {"d": None, "e": "x"}})
    assert json.loads((tmp_path / "results.json").read_text()) == {
        "a": None,
        "b": [None, 1.0],
        "c": {"d": None, "e": "x"},
    }


def test_the_summary_has_the_classes_below_all_and_unique():
    result = fed(rows()).compute()
    assert [name.strip() for name, _ in summary_rows(result)] == [
        "all objects", "unique answer", "unique", "twofold", "continuous",
    ]  # fmt: skip
    result["metrics_unique_answer"] = None
    result["per_ambiguity"] = {"unlabelled": result["metrics"]}
    assert [name for name, _ in summary_rows(result)] == ["all objects"]
