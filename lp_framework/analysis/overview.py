"""An overview of a data set: for every object the prior's energy around it, and how far it leaves the answer open."""

from __future__ import annotations

import math
from typing import Any

import torch

from lp_framework.analysis.ambiguity import ambiguity
from lp_framework.analysis.azimuth import azimuth_energies, profile, within
from lp_framework.analysis.fields import Draws, prior_landscapes
from lp_framework.analysis.landscapes import Grid
from lp_framework.data.cache import tracked
from lp_framework.data.module import PairDataModule
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import pairs_of

PAIRS = 8  # an object, for its ambiguity


def overview(
    data: PairDataModule, prior: Prior, device: torch.device, draws: Draws, grid: Grid, azimuths: int
) -> dict[str, Any]:
    """`objects`, a row an object, and the shares of pairs whose least energy is at the truth, as plain values.

    `azimuths` of them around each pair that the data were told to evaluate on (`evaluate_on`), with latitude and radius
    true; the ambiguity by landscapes over `grid` of up to `PAIRS` pairs of the protocol `per_view`.
    """
    split = data.evaluation_split()
    table, batches = data.table(split), data.data(split)
    places = torch.arange(azimuths) * (2 * math.pi / azimuths)
    energies, truth, objects = [], [], []
    for batch in tracked(list(data.test_dataloader()), "energies around the objects"):
        poses, pairs = batch.relative_poses(), pairs_of(batch, table, device)
        energies.append(azimuth_energies(prior, pairs, poses.to(device), places, draws).cpu())
        truth.append(poses[:, 1])
        objects.append(batch.objects[batch.reference])
    energy, longitude, index = torch.cat(energies), torch.cat(truth), torch.cat(objects)
    near = within(energy, places, longitude)
    per_view = table.pairs("per_view", draws.seed)  # a row a view
    rows: list[dict[str, Any]] = []
    for number in tracked(range(len(table.names)), "ambiguity of the objects"):
        mask = index == number
        curve = profile(energy[mask], places, longitude[mask])
        batch = batches[per_view[table.views_of(number)[:PAIRS]]]
        true = batch.relative_poses()
        landscapes = prior_landscapes(prior, pairs_of(batch, table, device), true[:, 2], grid, draws)
        rows.append(
            {
                "object": table.names[number], "ambiguity": table.ambiguities[number],
                "unique_answer": table.unique_answer[number],
                "pairs": int(mask.sum()), "within": near[mask].double().mean().item(),
                "relief": curve.relief, "minima": [minimum._asdict() for minimum in curve.minima()],
                "degrees": curve.degrees.tolist(), "energy": curve.energy.tolist(),
                "ambiguity_score": ambiguity(landscapes, true[:, 1]).record(),
            }
        )  # fmt: skip
    unique = [row for row in rows if row["unique_answer"]]
    return {"objects": rows, "within": _share(rows), "within_unique_answer": _share(unique)}


def _share(rows: list[dict[str, Any]]) -> float | None:
    """The share of pairs within the limit, over the objects of `rows`."""
    pairs = sum(row["pairs"] for row in rows)
    return sum(row["within"] * row["pairs"] for row in rows) / pairs if pairs else None
