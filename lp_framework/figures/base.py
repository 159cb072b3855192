"""What every figure of the paper is: what it needs by name, what is analysed for it, and how that is drawn."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Generic, TypeVar

import torch
from matplotlib.figure import Figure
from torch import nn

from lp_framework.analysis.fields import Draws
from lp_framework.errors import UserError
from lp_framework.models.checkpoints import SHIPPED, load_model
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior

Contents = TypeVar("Contents")


class PaperFigure(ABC, Generic[Contents]):
    """A figure. A subclass's constructor declares what it needs by name (`data`, `prior`) and has its settings."""

    def networks(self) -> list[nn.Module]:
        """The networks that it was given or has loaded, to be moved to a device."""
        return [part for part in vars(self).values() if isinstance(part, nn.Module)]

    @abstractmethod
    def analyse(self, seed: int, device: torch.device) -> Contents:
        """The arrays of the figure; the data are prepared, the networks are on the device. Draws follow `seed`."""

    @abstractmethod
    def draw(self, contents: Contents) -> Figure:
        """The figure of what was found."""

    @abstractmethod
    def caption(self, contents: Contents) -> str:
        """What to print below the figure: its panels, and the settings that its numbers depend on."""


def checked_draws(prior: Prior, timesteps: Sequence[int], noises: int) -> Draws:
    """The draws of a figure; `UserError` unless the prior has all of the timesteps, and there is one noise at least."""
    if not timesteps or not all(0 <= each < prior.num_timesteps for each in timesteps):
        raise UserError(
            f"figure.timesteps must list some of 0 to {prior.num_timesteps - 1}, which this prior has; "
            f"got {list(timesteps)}"
        )
    if noises < 1:
        raise UserError(f"figure.noises must be at least 1, got {noises}")
    return Draws(list(timesteps), noises, seed=0)


def checked_objects(objects: Sequence[str]) -> list[str]:
    """The names of objects; `UserError` for none."""
    if not objects:
        raise UserError("figure.objects needs the name of an object")
    return list(objects)


def score_model(path: str | None) -> PoseModel:
    """The score model of a training run or checkpoint; None: the one that ships."""
    model = load_model(SHIPPED / "score" if path is None else path)
    if model.has_energy:
        raise UserError(f"figure.score={path}: holds an energy model, a score model is wanted")
    return model


def energy_model(path: str | None) -> PoseModel:
    """The energy model of a training run or checkpoint; `UserError` with the command that trains one for None."""
    if path is None:
        raise UserError(
            "this figure needs an energy model, and none ships: train one with `python -m lp_framework train "
            "model=energy hydra.run.dir=runs/energy`, then add figure.energy=runs/energy"
        )
    model = load_model(path)
    if not model.has_energy:
        raise UserError(f"figure.energy={path}: holds a score model, an energy model is wanted")
    return model
