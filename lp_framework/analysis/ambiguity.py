"""How far the views of an object leave their relative longitude open, told by a prior before anything is trained.

From landscapes of a few pairs. The *valley floor* is the lowest ground at each longitude, in the range of its
landscape; its mean over the pairs, each turned so that the truth is at 0, is what the object itself has of valleys.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from lp_framework.analysis.azimuth import Profile, profile
from lp_framework.analysis.landscapes import FLAT, Landscape

EQUAL = 0.05  # of the floor's range; valleys whose depths differ by less are equally good answers
HALF_TURN = 30.0  # degrees; so far from 180 a second valley may lie to be one of the other side

Verdict = Literal["unique", "twofold", "several", "continuous"]


class Ambiguity(NamedTuple):
    """An object's ambiguity score: `flatness` and the `floor`'s valleys.

    `flatness` is 1 less the range of the mean valley floor: 1 where all longitudes are equally good. `floor` is that
    floor over degrees from the truth; `minima` the mean number of minima of a pair's whole landscape.
    """

    flatness: float
    floor: Profile
    minima: float

    @property
    def verdict(self) -> Verdict:
        """`continuous`: the floor is flat. Else by its valleys: one, a second one half a turn away, or other ones."""
        if self.flatness >= FLAT:
            return "continuous"
        valleys = [minimum.degrees for minimum in self.floor.minima()]
        if len(valleys) == 1:
            return "unique"
        apart = abs(valleys[1] - valleys[0])
        return "twofold" if len(valleys) == 2 and abs(apart - 180) <= HALF_TURN else "several"

    @property
    def unique_answer(self) -> bool:
        """Whether one longitude is better than all others: the floor is not flat, and its valleys differ in depth."""
        return self.verdict != "continuous" and sum(each.height < EQUAL for each in self.floor.minima()) == 1

    def record(self) -> dict[str, object]:
        """As plain values."""
        return {
            "verdict": self.verdict,
            "unique_answer": self.unique_answer,
            "flatness": self.flatness,
            "valleys": [minimum._asdict() for minimum in self.floor.minima()] if self.flatness < FLAT else [],
            "minima": self.minima,
        }


def ambiguity(landscapes: Sequence[Landscape], truth: Tensor) -> Ambiguity:
    """The ambiguity of an object, of some pairs' landscapes on one grid and their true relative longitudes `[P]`."""
    floors = torch.stack([landscape.floor() for landscape in landscapes]).double()
    floor = profile(floors, landscapes[0].longitude.double(), truth.double())
    minima = sum(len(landscape.minima()) for landscape in landscapes) / len(landscapes)
    return Ambiguity(1 - (floor.energy.max() - floor.energy.min()).item(), floor, minima)
