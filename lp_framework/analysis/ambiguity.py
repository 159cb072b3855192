"""How well a prior's energy identifies the azimuth of an object, and how ambiguous its views leave it.

The *valley floor* is the lowest energy at each longitude, relative to the range of its landscape. Its mean over pairs,
each rotated so that the truth is at 0, shows the minima of the object itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lp_framework.analysis.fields import Draws, pose_energies, prior_landscapes
from lp_framework.analysis.landscapes import FLAT, Grid, Landscape, find_minima
from lp_framework.data.cache import tracked
from lp_framework.data.module import PairDataModule
from lp_framework.geometry import wrap_angle
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs, pairs_of

NEAR_DEGREES = 15.0
PROMINENCE = 0.1  # of a profile's range; shallower dips do not count as minima
EQUAL = 0.05  # of the floor's range; minima whose depths differ by less are equally good answers
HALF_TURN = 30.0  # degrees; tolerance around 180 for a second valley to count as half a turn away
PAIRS = 8  # per object, to compute its ambiguity

Verdict = Literal["unique", "twofold", "several", "continuous"]


def azimuth_energies(prior: Prior, pairs: Pairs, poses: Tensor, azimuths: Tensor, draws: Draws) -> Tensor:
    """Energies `[B, A]` of B pairs at relative longitudes `[A]` (radians); latitude and radius are those of `poses`."""
    around = poses[:, None].repeat(1, len(azimuths), 1)
    around[..., 1] = azimuths.to(poses)
    return pose_energies(prior, pairs, around, draws)


def within(energies: Tensor, azimuths: Tensor, truth: Tensor) -> Tensor:
    """Whether the azimuth of lowest energy is within `NEAR_DEGREES` of the truth, `[P]`."""
    best = azimuths[energies.argmin(dim=1)]
    return wrap_angle(best - truth).abs() <= math.radians(NEAR_DEGREES)


class Profile(NamedTuple):
    """Mean energy around an object `[A]` over the azimuth's offset from the truth `[A]` (degrees, from -180 up)."""

    degrees: Tensor
    energy: Tensor

    @property
    def relief(self) -> float:
        """Range divided by mean: close to 0 if the energy does not depend on the azimuth."""
        return ((self.energy.max() - self.energy.min()) / self.energy.mean()).item()

    def minima(self) -> list[dict[str, float]]:
        """Local minima, deepest first: `degrees` from the truth, and `height` within the profile's range."""
        found = find_minima(self.energy[None], PROMINENCE)
        return [{"degrees": self.degrees[cell].item(), "height": height} for cell, height, _ in found]


def profile(energies: Tensor, azimuths: Tensor, truth: Tensor) -> Profile:
    """Average `energies` `[P, A]` at evenly spaced `azimuths` `[A]` by their distance from `truth` `[P]`."""
    count = len(azimuths)
    offset = wrap_angle(azimuths - truth[:, None])
    place = (offset / (2 * math.pi / count)).round().long() % count
    total = torch.zeros(count, dtype=energies.dtype).index_add(0, place.flatten(), energies.flatten())
    mean = total / torch.bincount(place.flatten(), minlength=count)
    degrees = torch.arange(count) * 360.0 / count
    turned = (count + 1) // 2
    return Profile((degrees.roll(-turned) + 180) % 360 - 180, mean.roll(-turned))


class Ambiguity(NamedTuple):
    """An object's ambiguity. `flatness`, 1 minus the range of the `floor`, is 1 if all longitudes are equally good.

    `floor` is the mean valley floor over degrees from the truth; `minima` is the mean number of minima per landscape.
    """

    flatness: float
    floor: Profile
    minima: float

    @property
    def verdict(self) -> Verdict:
        """`continuous` if the floor is flat; else by its minima: one, two half a turn apart, or any others."""
        if self.flatness >= FLAT:
            return "continuous"
        places = [minimum["degrees"] for minimum in self.floor.minima()]
        if len(places) == 1:
            return "unique"
        apart = abs(places[1] - places[0])
        return "twofold" if len(places) == 2 and abs(apart - 180) <= HALF_TURN else "several"

    @property
    def unique_answer(self) -> bool:
        """Whether one longitude is best: the floor is not flat, and no other valley is as deep as the deepest."""
        return self.verdict != "continuous" and sum(each["height"] < EQUAL for each in self.floor.minima()) == 1

    def record(self) -> dict[str, object]:
        """Return plain values."""
        return {
            "verdict": self.verdict,
            "unique_answer": self.unique_answer,
            "flatness": self.flatness,
            "valleys": self.floor.minima() if self.flatness < FLAT else [],
            "minima": self.minima,
        }


def ambiguity(landscapes: Sequence[Landscape], truth: Tensor) -> Ambiguity:
    """Ambiguity of an object, from landscapes of P pairs on one grid and their true relative longitudes `[P]`."""
    floors = torch.stack([landscape.floor() for landscape in landscapes]).double()
    floor = profile(floors, landscapes[0].longitude.double(), truth.double())
    minima = sum(len(landscape.minima()) for landscape in landscapes) / len(landscapes)
    return Ambiguity(1 - (floor.energy.max() - floor.energy.min()).item(), floor, minima)


def overview(
    data: PairDataModule, prior: Prior, device: torch.device, draws: Draws, grid: Grid, azimuths: int, protocol: str
) -> dict[str, Any]:
    """One row per object (`objects`), and the share of pairs whose lowest energy is at the truth, as plain values.

    Each pair of `protocol` is evaluated at this many `azimuths`. The ambiguity comes from landscapes over `grid` of up
    to `PAIRS` pairs of the protocol `per_view`.
    """
    split = data.evaluation_split()
    table, views = data.table(split), data.data(split)
    places = torch.arange(azimuths) * (2 * math.pi / azimuths)
    every, per_view = (table.pairs(each, draws.seed) for each in (protocol, "per_view"))
    rows: list[dict[str, Any]] = []
    for number in tracked(range(len(table.names)), "energies around the objects"):
        batch = views[every[np.isin(every[:, 0], table.views_of(number))]]
        true = batch.relative_poses()
        energy = azimuth_energies(prior, pairs_of(batch, device), true.to(device), places, draws).cpu()
        curve, near = profile(energy, places, true[:, 1]), within(energy, places, true[:, 1])
        batch = views[per_view[table.views_of(number)[:PAIRS]]]  # one row per view
        true = batch.relative_poses()
        landscapes = prior_landscapes(prior, pairs_of(batch, device), true[:, 2], grid, draws)
        rows.append(
            {
                "object": table.names[number], "ambiguity": table.ambiguities[number],
                "unique_answer": table.unique_answer[number],
                "pairs": len(near), "within": near.double().mean().item(),
                "relief": curve.relief, "minima": curve.minima(),
                "degrees": curve.degrees.tolist(), "energy": curve.energy.tolist(),
                "ambiguity_score": ambiguity(landscapes, true[:, 1]).record(),
            }
        )  # fmt: skip

    def share(some: list[dict[str, Any]]) -> float | None:
        pairs = sum(row["pairs"] for row in some)
        return sum(row["within"] * row["pairs"] for row in some) / pairs if pairs else None

    unique = [row for row in rows if row["unique_answer"]]
    return {"objects": rows, "within": share(rows), "within_unique_answer": share(unique)}
