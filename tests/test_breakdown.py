"""Breakdown of an evaluation's rates, against counts by hand and a known calibration."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lp_framework.evaluation.breakdown import breakdown, calibration, lines


def table(*unique, longitudes=(0, 40, 100, 300)):
    poses = torch.zeros(len(unique) * len(longitudes), 3, dtype=torch.float64)
    poses[:, 1] = torch.deg2rad(torch.tensor(longitudes, dtype=torch.float64)).repeat(len(unique))
    return SimpleNamespace(unique_answer=list(unique), poses=poses)


def rows(pairs, objects, rotation, chosen, probability=None):
    return {
        "pair": torch.tensor(pairs),
        "object": torch.tensor(objects),
        "rotation": torch.tensor(rotation, dtype=torch.float64),
        "chosen": torch.tensor(chosen),
        "probability": torch.tensor(probability or [math.nan] * len(pairs), dtype=torch.float64),
    }


def test_pairs_are_counted_by_the_difference_of_their_longitudes():
    details = breakdown(
        rows([[0, 1], [1, 0], [0, 2], [0, 3], [1, 3]], [0] * 5, [[10.0], [20.0], [40.0], [5.0], [math.nan]], [0] * 5),
        table(True),
    )
    found = [(row["pairs"], row["R(R)@15"], row["R(R)@30"]) for row in details["by_longitude"]]
    assert found == [(2, 0.5, 1.0), (1, 1.0, 1.0), (2, 0.0, 0.0), (0, None, None)]  # 40, 60 (over 0), 100 degrees
    assert details["calibration"] is None
    assert "135-180° -/-" in lines(details)[0]


def test_the_best_of_the_first_starts_whichever_is_chosen():
    details = breakdown(rows([[0, 1], [0, 2]], [0, 0], [[90.0, 10.0, 1.0], [90.0, 90.0, 12.0]], [0, 2]), table(True))
    assert [(row["starts"], row["R(R)@15"]) for row in details["best_of"]] == [(1, 0.0), (2, 0.5)]
    assert details["by_longitude"][0]["R(R)@15"] == 0.0  # by what was chosen


def test_objects_without_a_unique_answer_are_left_out_and_unlabelled_ones_are_not():
    several = rows([[0, 1], [4, 5], [8, 9]], [0, 1, 2], [[5.0], [90.0], [5.0]], [0, 0, 0])
    assert breakdown(several, table(True, False, None))["pairs"] == 2
    assert breakdown(several, table(False, False, False)) == {}


def test_the_interval_resamples_objects_not_pairs():
    """Ten objects of 50 pairs, half of them always right: as uncertain as ten draws of a coin."""
    objects = np.repeat(np.arange(10), 50)
    error = np.where(objects < 5, 5.0, 90.0)[:, None].tolist()
    views = [[4 * each, 4 * each + 1] for each in objects.tolist()]
    low, high = breakdown(rows(views, objects.tolist(), error, [0] * 500), table(*[True] * 10))["interval"]["R(R)@15"]
    assert low == pytest.approx(0.2, abs=0.05) and high == pytest.approx(0.8, abs=0.05)  # binomial, 10 draws


def test_calibrated_and_overconfident_probabilities():
    random = np.random.default_rng(0)
    probability = random.uniform(size=20_000)
    right = random.uniform(size=20_000) < probability
    assert calibration(probability, right)["error"] < 0.02
    boast = calibration(np.full(20_000, 0.95), right)
    assert boast["error"] == pytest.approx(0.45, abs=0.02)
    assert boast["mean_probability"] == pytest.approx(0.95)
    some = np.where(np.arange(20_000) < 10_000, probability, np.nan)
    assert sum(each["pairs"] for each in calibration(some, right)["bins"]) == 10_000
