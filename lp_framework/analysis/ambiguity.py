"""How well a prior's energy singles out the azimuth of an object, and how far its views leave it open.

The *valley floor* is the lowest ground at each longitude, in the range of its landscape; its mean over pairs, each
turned so that the truth is at 0, is what the object itself has of valleys.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lp_framework.analysis.fields import Draws, pose_energies, prior_landscapes
from lp_framework.analysis.landscapes import FLAT, Grid, Landscape, valleys
from lp_framework.data.cache import tracked
from lp_framework.data.module import PairDataModule
from lp_framework.geometry import wrap_angle
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs, pairs_of

NEAR_DEGREES = 15.0
PROMINENCE = 0.1  # of a profile's range; a shallower dent is no minimum
EQUAL = 0.05  # of the floor's range; valleys whose depths differ by less are equally good answers
HALF_TURN = 30.0  # degrees; so far from 180 a second valley may lie to be one of the other side
PAIRS = 8  # an object, for its ambiguity

Verdict = Literal["unique", "twofold", "several", "continuous"]


def azimuth_energies(prior: Prior, pairs: Pairs, poses: Tensor, azimuths: Tensor, draws: Draws) -> Tensor:
    """Energies `[B, A]` of B pairs at relative longitudes `[A]` (radians); latitude and radius are those of `poses`."""
    around = poses[:, None].repeat(1, len(azimuths), 1)
    around[..., 1] = azimuths.to(poses)
    return pose_energies(prior, pairs, around, draws)


def within(energies: Tensor, azimuths: Tensor, truth: Tensor) -> Tensor:
    """Whether the azimuth of least energy is within `NEAR_DEGREES` of the truth, `[P]`."""
    best = azimuths[energies.argmin(dim=1)]
    return wrap_angle(best - truth).abs() <= math.radians(NEAR_DEGREES)


class Profile(NamedTuple):
    """The mean energy around an object `[A]` over the azimuth's distance from the truth `[A]` (degrees, -180 first)."""

    degrees: Tensor
    energy: Tensor

    @property
    def relief(self) -> float:
        """Its range over its mean: next to 0 where the energy does not tell the azimuth."""
        return ((self.energy.max() - self.energy.min()) / self.energy.mean()).item()

    def minima(self) -> list[dict[str, float]]:
        """Its local minima, the deepest first: `degrees` from the truth, and `height` in the profile's range."""
        found = valleys(self.energy[None], PROMINENCE)
        return [{"degrees": self.degrees[cell].item(), "height": height} for cell, height, _ in found]


def profile(energies: Tensor, azimuths: Tensor, truth: Tensor) -> Profile:
    """The profile of pairs: `energies` `[P, A]` at evenly spaced `azimuths` `[A]`, by distance from `truth` `[P]`."""
    count = len(azimuths)
    offset = wrap_angle(azimuths - truth[:, None])
    place = (offset / (2 * math.pi / count)).round().long() % count
    total = torch.zeros(count, dtype=energies.dtype).index_add(0, place.flatten(), energies.flatten())
    mean = total / torch.bincount(place.flatten(), minlength=count)
    degrees = torch.arange(count) * 360.0 / count
    turned = (count + 1) // 2
    return Profile((degrees.roll(-turned) + 180) % 360 - 180, mean.roll(-turned))


class Ambiguity(NamedTuple):
    """An object's ambiguity: `flatness`, 1 less the range of the `floor`, is 1 where all longitudes are equally good.

    `floor` is the mean valley floor over degrees from the truth, `minima` the mean number of a pair's whole landscape.
    """

    flatness: float
    floor: Profile
    minima: float

    @property
    def verdict(self) -> Verdict:
        """`continuous`: the floor is flat. Else by its valleys: one, a second one half a turn away, or other ones."""
        if self.flatness >= FLAT:
            return "continuous"
        places = [minimum["degrees"] for minimum in self.floor.minima()]
        if len(places) == 1:
            return "unique"
        apart = abs(places[1] - places[0])
        return "twofold" if len(places) == 2 and abs(apart - 180) <= HALF_TURN else "several"

    @property
    def unique_answer(self) -> bool:
        """Whether one longitude is better than all others: the floor is not flat, and its valleys differ in depth."""
        return self.verdict != "continuous" and sum(each["height"] < EQUAL for each in self.floor.minima()) == 1

    def record(self) -> dict[str, object]:
        """As plain values."""
        return {
            "verdict": self.verdict,
            "unique_answer": self.unique_answer,
            "flatness": self.flatness,
            "valleys": self.floor.minima() if self.flatness < FLAT else [],
            "minima": self.minima,
        }


def ambiguity(landscapes: Sequence[Landscape], truth: Tensor) -> Ambiguity:
    """The ambiguity of an object, of some pairs' landscapes on one grid and their true relative longitudes `[P]`."""
    floors = torch.stack([landscape.floor() for landscape in landscapes]).double()
    floor = profile(floors, landscapes[0].longitude.double(), truth.double())
    minima = sum(len(landscape.minima()) for landscape in landscapes) / len(landscapes)
    return Ambiguity(1 - (floor.energy.max() - floor.energy.min()).item(), floor, minima)


def overview(
    data: PairDataModule, prior: Prior, device: torch.device, draws: Draws, grid: Grid, azimuths: int, protocol: str
) -> dict[str, Any]:
    """`objects`, a row an object, and the shares of pairs whose least energy is at the truth, as plain values.

    `azimuths` are tried around each pair of the protocol, on which the data evaluate; the ambiguity is by landscapes
    over `grid` of up to `PAIRS` pairs of the protocol `per_view`.
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
        batch = views[per_view[table.views_of(number)[:PAIRS]]]  # a row a view
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
