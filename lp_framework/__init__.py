"""Camera viewpoint between photographs of one object, found on learned landscapes of the relative pose.

    pose = lp_framework.estimate_pose("chair_front.png", "chair_left.png").answer()

    model = lp_framework.load_model("runs/train/2026-01-31_12-00-00")  # without a run, the one that ships
    solver = lp_framework.load_solver("two_stage", model=model, prior=lp_framework.load_prior("tiny"), gamma=0)
    starts = lp_framework.make_starts("grid")

Names and arguments are those of the command line. Importing the package imports nothing heavy.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lp_framework import torchvision_ops

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from PIL import Image

    from lp_framework.models.pose_model import PoseModel
    from lp_framework.priors.base import Prior
    from lp_framework.solvers.base import Solution, Solver
    from lp_framework.solvers.starts import Starts

__all__ = ["estimate_pose", "load_model", "load_prior", "load_solver", "make_starts"]

torchvision_ops.install()


def estimate_pose(
    reference: str | Path | Image.Image | ArrayLike,
    query: str | Path | Image.Image | ArrayLike,
    solver: str | Solver = "two_stage",
    prior: str | Prior = "tiny",
    model: str | Path | PoseModel | None = None,
    starts: str | Starts = "grid",
    seed: int = 0,
    crop: bool = True,
    remove_background: bool = False,
) -> Solution:
    """The pose of `query` relative to `reference`, two pictures of one object; `.answer()` of the result is `[1, 3]`:
    latitude and longitude (radians, the latter in [0, 2 pi)) and radius (object sizes), query minus reference.

    A picture is a file, an image of Pillow or an array `[H, W, 3 | 4]` (uint8, or floats in [0, 1]). It is prepared as
    `data.photographs` says: cut out by its alpha channel, or by rembg with `remove_background`, centred and scaled.
    With `crop=False` it is a whole square view, on white where it has no alpha channel.

    `solver`, `prior` and `starts` are registered names or objects built by the functions below. A solver by name gets
    the prior and the model that it asks for (`model` is a checkpoint, a run's folder, or a model; None: the one that
    ships) on the GPU, where there is one; a built solver has its own.
    """
    from lp_framework.api import estimate_pose as estimate

    return estimate(reference, query, solver, prior, model, starts, seed, crop, remove_background)


def load_model(checkpoint: str | Path | None = None) -> PoseModel:
    """The trained model of a checkpoint file or of a training run's folder; None: the one that ships.

    Raises `UserError` where it cannot be had.
    """
    from lp_framework.models.checkpoints import SHIPPED
    from lp_framework.models.checkpoints import load_model as load

    return load(SHIPPED / "score" if checkpoint is None else checkpoint)


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
