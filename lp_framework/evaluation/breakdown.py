"""Details behind the rates of an evaluation: by longitude and start, confidence intervals, and calibration."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.data.pairs import ViewTable
from lp_framework.geometry.spherical import wrap_angle

THRESHOLDS = (15, 30)  # degrees, for the rotation error
SURE_DEGREES = 30  # a model's probability is that of an error of at most this many degrees
LONGITUDE_EDGES = (0, 45, 90, 135, 180)  # degrees
STARTS = (1, 2, 4)
CONFIDENCE_BINS = 10
RESAMPLES = 2000


def breakdown(rows: Mapping[str, Tensor], table: ViewTable) -> dict[str, Any]:
    """Break down the rows of `PoseMetrics` for objects that have a unique answer or are unlabelled.

    R(R) at 15 and 30 degrees: `by_longitude`, by true longitude difference; `best_of`, for the best of the first starts
    (with `start=modes`, the highest modes); `interval`, a 95% bootstrap interval over objects, for the variation due to
    the choice of objects. `calibration`, if the model predicts probabilities, otherwise None: for ten equal bins, the
    mean probability and the share of pairs within 30 degrees, and `error`, the mean gap between the two (expected
    calibration error, Guo et al. 2017). Empty if there are no such pairs.
    """
    counts = [answer is not False for answer in table.unique_answer]
    kept = np.array(counts)[rows["object"].numpy()]
    if not kept.any():
        return {}
    rotation = np.nan_to_num(rows["rotation"].numpy()[kept], nan=np.inf)
    error = np.take_along_axis(rotation, rows["chosen"].numpy()[kept, None], axis=1)[:, 0]
    longitude = table.poses[rows["pair"][kept], 1]
    apart = np.degrees(np.abs(wrap_angle(longitude[:, 1] - longitude[:, 0]).numpy()))
    return {
        "pairs": int(kept.sum()),
        "by_longitude": [
            {"from": low, "to": high, **_recall(error[(apart >= low) & ((apart < high) | (high == 180))])}
            for low, high in pairwise(LONGITUDE_EDGES)
        ],
        "best_of": [
            {"starts": count, **_recall(rotation[:, :count].min(axis=1))}
            for count in STARTS
            if count <= rotation.shape[1]
        ],
        "interval": _intervals(error, rows["object"].numpy()[kept]),
        "calibration": calibration(rows["probability"].numpy()[kept], error <= SURE_DEGREES),
    }


def calibration(probability: NDArray, right: NDArray) -> dict[str, Any] | None:
    """Calibration of probabilities `[P]` (NaN: none) given whether the answers are right `[P]`; see `breakdown`."""
    known = np.isfinite(probability)
    if not known.any():
        return None
    probability, right = probability[known], right[known]
    place = np.minimum((probability * CONFIDENCE_BINS).astype(int), CONFIDENCE_BINS - 1)
    bins = [
        {
            "pairs": int((place == each).sum()),
            "probability": float(probability[place == each].mean()),
            "right": float(right[place == each].mean()),
        }
        for each in np.unique(place)
    ]
    gap = sum(each["pairs"] * abs(each["probability"] - each["right"]) for each in bins) / len(right)
    return {"bins": bins, "error": gap, "mean_probability": float(probability.mean())}


def _recall(error: NDArray) -> dict[str, Any]:
    rates = {f"R(R)@{degrees}": float((error <= degrees).mean()) if len(error) else None for degrees in THRESHOLDS}
    return {"pairs": len(error), **rates}


def _intervals(error: NDArray, objects: NDArray) -> dict[str, list[float]]:
    """The 2.5% and 97.5% quantiles of the rates under resampling of objects with replacement."""
    names, place = np.unique(objects, return_inverse=True)
    drawn = np.random.default_rng(0).integers(len(names), size=(RESAMPLES, len(names)))
    pairs = np.bincount(place)[drawn].sum(axis=1)
    found = {}
    for degrees in THRESHOLDS:
        right = np.bincount(place, error <= degrees)[drawn].sum(axis=1)
        found[f"R(R)@{degrees}"] = [float(each) for each in np.quantile(right / pairs, (0.025, 0.975))]
    return found


def lines(details: Mapping[str, Any]) -> list[str]:
    """Format the breakdown for the terminal."""

    def rates(row: Mapping[str, Any]) -> str:
        shares = (row[f"R(R)@{degrees}"] for degrees in THRESHOLDS)
        return "/".join("-" if share is None else f"{share:.2f}".removeprefix("0") for share in shares)

    by_longitude = ", ".join(f"{row['from']}-{row['to']}° {rates(row)}" for row in details["by_longitude"])
    best_of = ", ".join(f"{row['starts']}: {rates(row)}" for row in details["best_of"])
    low, high = details["interval"]["R(R)@30"]
    text = [
        f"unique answer, {details['pairs']} pairs, R(R)@15/R(R)@30 by longitude difference: {by_longitude}",
        f"  best of the first starts, {best_of}; 95% interval of R(R)@30 over objects: {low:.2f} to {high:.2f}",
    ]
    if details["calibration"]:
        mean, gap = details["calibration"]["mean_probability"], details["calibration"]["error"]
        text.append(f"  mean probability of an error within 30°: {mean:.2f}, expected calibration error {gap:.3f}")
    return text
