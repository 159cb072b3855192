"""A pair of views with all that is shown of it, as plain arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lp_framework.analysis.landscapes import Arrows, Landscape
from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS

PRIOR_ENERGY = "energy of the prior"


@dataclass(frozen=True)
class View:
    """One image of a pair: its file, its pixels `[H, W, 3]` (uint8) and its true view pose `[3]`."""

    file: Path
    image: NDArray
    pose: NDArray

    @property
    def name(self) -> str:
        """The file's name."""
        return self.file.name


@dataclass(frozen=True)
class ShownPair:
    """A pair and what a solver did with it, for N starts; radians and object sizes, NaN where there is no number.

    `truth` `[3]`, `ends` `[N, 3]` and `starts` `[N, 3]` are relative poses, `trajectories` `[N, S + 1, 3]` have
    longitudes unreduced; solvers that keep no trajectory, or make candidates of their own, have None, and so has the
    truth of photographs. `energies` `[N]` are the solver's, `chosen` is its answer, None where that is no pose;
    `rotation_errors` (degrees) and `translation_errors` are `[N]`. A pair that was not solved has no ends.
    `landscapes` are those that the solver walked on, by name, at the true relative radius; `maps` are drawn beside the
    images.
    """

    object: str
    ambiguity: str
    reason: str
    reference: View
    query: View
    truth: NDArray | None = None
    starts: NDArray | None = None
    trajectories: NDArray | None = None
    ends: NDArray = field(default_factory=lambda: np.empty((0, 3)))
    energies: NDArray = field(default_factory=lambda: np.empty(0))
    chosen: int | None = None
    rotation_errors: NDArray = field(default_factory=lambda: np.empty(0))
    translation_errors: NDArray = field(default_factory=lambda: np.empty(0))
    landscapes: Mapping[str, Landscape] = field(default_factory=dict)
    maps: Sequence[PoseMap] = ()

    @property
    def title(self) -> str:
        """The object's name as it is read."""
        return words(self.object)

    @property
    def failed(self) -> bool:
        """Whether the answer is known to be further off than the widest threshold; without an answer it is."""
        if self.truth is None:
            return False
        return self.chosen is None or not self.rotation_errors[self.chosen] <= ROTATION_THRESHOLDS[-1]

    @property
    def prior_energy(self) -> Landscape:
        """The landscape of the prior."""
        return self.landscapes[PRIOR_ENERGY]

    def start_longitudes(self) -> list[float] | list[None]:
        """Of each end the longitude of its start, degrees in [0, 360); None where the solver made its own."""
        if self.starts is None:
            return [None] * len(self.ends)
        longitudes: list[float] = (np.rad2deg(self.starts[:, 1]) % 360).tolist()
        return longitudes

    def arrived(self) -> ShownPair:
        """The pair with those starts alone that came to a pose."""
        sound = np.isfinite(self.ends).all(axis=-1)
        lost = self.chosen is None or not sound[self.chosen]
        names = ("starts", "trajectories", "ends", "energies", "rotation_errors", "translation_errors")
        known = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        kept: dict[str, Any] = {name: each[sound] for name, each in known.items()}
        return replace(self, chosen=None if lost else int(sound[: self.chosen].sum()), **kept)


class PoseMap(NamedTuple):
    """A map of relative latitude and longitude: its title and what is on it, from the ground up.

    An energy as `relief`, or exp(-E) as `density`; a score as `arrows`; the `ways` that a solver took in a pair.
    """

    title: str = ""
    relief: Landscape | None = None
    density: Landscape | None = None
    arrows: Arrows | None = None
    ways: ShownPair | None = None


def words(name: str) -> str:
    """An object's or a solver's name as it is read.

    >>> words("two_stage")
    'two stage'
    """
    return name.replace("_", " ")
