"""The score and the energy model that a figure asks for."""

from __future__ import annotations

from lp_framework.errors import UserError
from lp_framework.models.checkpoints import SHIPPED, load_model
from lp_framework.models.pose_model import PoseModel


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
