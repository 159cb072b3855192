"""Camera viewpoint between photographs of one object, found on learned landscapes of the relative pose.

    model = lp_framework.load_model("runs/train/2026-01-31_12-00-00")
    solver = lp_framework.load_solver("langevin", model=model, gamma=0)
    starts = lp_framework.make_starts("grid")

Names and arguments are those of the command line. Importing the package imports nothing heavy.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lp_framework import torchvision_ops

if TYPE_CHECKING:
    from lp_framework.models.pose_model import PoseModel
    from lp_framework.priors.base import Prior
    from lp_framework.solvers.base import Solver
    from lp_framework.solvers.starts import Starts

__all__ = ["load_model", "load_prior", "load_solver", "make_starts"]

torchvision_ops.install()


def load_model(checkpoint: str | Path) -> PoseModel:
    """The trained model of a checkpoint file or of a training run's folder; `UserError` where it cannot be had."""
    from lp_framework.models.checkpoints import load_model as load

    return load(checkpoint)


def load_prior(name: str, **arguments: Any) -> Prior:
    """A pose-conditioned diffusion prior by its registered name, frozen."""
    from lp_framework import registry

    prior: Prior = registry.build("prior", {"name": name, **arguments})
    return prior


def load_solver(name: str, model: PoseModel | None = None, prior: Prior | None = None, **arguments: Any) -> Solver:
    """A solver by its registered name, with the model and the prior that it asks for and its settings."""
    from lp_framework import registry

    solver: Solver = registry.build("solver", {"name": name, **arguments}, model=model, prior=prior)
    return solver


def make_starts(name: str, **arguments: Any) -> Starts:
    """Starts by their registered name; `.make(ids, seed)` gives `[B, N, 3]` relative poses."""
    from lp_framework import registry

    starts: Starts = registry.build("start", {"name": name, **arguments})
    return starts
