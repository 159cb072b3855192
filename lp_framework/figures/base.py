"""Base classes of the paper's figures: the components a figure needs, its analysis, and its drawing."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from matplotlib.figure import Figure

from lp_framework.analysis.fields import checked_draws
from lp_framework.analysis.pairs import ShownPair, named_pairs
from lp_framework.data.module import PairDataModule
from lp_framework.errors import UserError
from lp_framework.models.checkpoints import SHIPPED, load_model
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import NetworkUser, Pairs


class PaperFigure(NetworkUser, ABC):
    """A figure. The constructor of a subclass declares components by name (`data`, `prior`) and its settings."""

    @abstractmethod
    def analyse(self, seed: int, device: torch.device) -> Any:
        """Compute the arrays of the figure, with data prepared and networks on the device. `seed` keys the draws."""

    @abstractmethod
    def draw(self, contents: Any) -> tuple[Figure, str]:
        """Draw the figure. Returns it with a caption: its panels, and the settings its numbers depend on."""


@dataclass(kw_only=True)
class PairsFigure(PaperFigure):
    """A figure of pairs: two test views of each object, by number."""

    data: PairDataModule
    reference: int = 0
    query: int = 1

    def pairs(self, objects: Sequence[str], device: torch.device) -> tuple[Pairs, list[ShownPair]]:
        """See `named_pairs`; `UserError` if there are no objects."""
        if not objects:
            raise UserError("figure.objects needs the name of at least one object")
        return named_pairs(self.data, objects, [(self.reference, self.query)] * len(objects), device)


@dataclass(kw_only=True)
class EnergyFigure(PairsFigure):
    """A figure of pairs and the prior's energy, averaged over `timesteps` with `noises` each."""

    prior: Prior
    timesteps: Sequence[int] = (100, 300, 500, 700, 900)
    noises: int = 1

    def __post_init__(self) -> None:
        self.draws = checked_draws(self.timesteps, self.noises, seed=0)


def figure_model(kind: Literal["score", "energy"], path: str | None) -> PoseModel:
    """Load the score or energy model of a training run or checkpoint; None for the bundled score model.

    `UserError` if the model is of the other kind, or if there is none; it then names the command to train one.
    """
    if path is None and kind == "energy":
        raise UserError(
            "this figure needs an energy model, and none is bundled: train one with `python -m lp_framework train "
            "model=energy hydra.run.dir=runs/energy`, then add figure.energy=runs/energy"
        )
    model = load_model(SHIPPED / "score" if path is None else path)
    if model.has_energy != (kind == "energy"):
        raise UserError(f"figure.{kind}={path}: contains no {kind} model")
    return model
