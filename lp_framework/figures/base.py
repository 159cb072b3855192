"""What every figure of the paper is: what it needs by name, what is analysed for it, and how that is drawn."""

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
    """A figure. A subclass's constructor declares what it needs by name (`data`, `prior`) and has its settings."""

    @abstractmethod
    def analyse(self, seed: int, device: torch.device) -> Any:
        """The arrays of the figure; the data are prepared, the networks are on the device. Draws follow `seed`."""

    @abstractmethod
    def draw(self, contents: Any) -> tuple[Figure, str]:
        """The figure of what was found, and a caption: its panels, and the settings that its numbers depend on."""


@dataclass(kw_only=True)
class PairsFigure(PaperFigure):
    """A figure of pairs: of each object two test views, by number."""

    data: PairDataModule
    reference: int = 0
    query: int = 1

    def pairs(self, objects: Sequence[str], device: torch.device) -> tuple[Pairs, list[ShownPair]]:
        """See `named_pairs`; `UserError` for no objects."""
        if not objects:
            raise UserError("figure.objects needs the name of at least one object")
        return named_pairs(self.data, objects, [(self.reference, self.query)] * len(objects), device)


@dataclass(kw_only=True)
class EnergyFigure(PairsFigure):
    """A figure of pairs and the prior's energy, which is the mean over `timesteps`, `noises` each."""

    prior: Prior
    timesteps: Sequence[int] = (100, 300, 500, 700, 900)
    noises: int = 1

    def __post_init__(self) -> None:
        self.draws = checked_draws(self.timesteps, self.noises, seed=0)


def figure_model(kind: Literal["score", "energy"], path: str | None) -> PoseModel:
    """The score or energy model of a training run or checkpoint; None: the score model that ships.

    `UserError` for a model of the other kind, and where there is none, with the command that trains one.
    """
    if path is None and kind == "energy":
        raise UserError(
            "this figure needs an energy model, and none ships: train one with `python -m lp_framework train "
            "model=energy hydra.run.dir=runs/energy`, then add figure.energy=runs/energy"
        )
    model = load_model(SHIPPED / "score" if path is None else path)
    if model.has_energy != (kind == "energy"):
        raise UserError(f"figure.{kind}={path}: holds no {kind} model")
    return model
