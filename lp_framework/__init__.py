"""Estimate the camera viewpoint between photographs of one object on learned landscapes of the relative pose.

    pose = lp_framework.estimate_pose("chair_front.png", "chair_left.png").answer()

    model = lp_framework.load_model("runs/train/2026-01-31_12-00-00")  # default: the bundled model
    solver = lp_framework.load_solver("two_stage", model=model, prior=lp_framework.load_prior("tiny"), gamma=0)
    starts = lp_framework.make_starts("grid")

Names and arguments are the same as on the command line. Importing the package is cheap: `lp_framework.api`, which
defines the functions, is imported on first use.
"""

from typing import TYPE_CHECKING, Any

from lp_framework import torchvision_ops

if TYPE_CHECKING:
    from lp_framework.api import estimate_pose, load_model, load_prior, load_solver, make_starts

__all__ = ["estimate_pose", "load_model", "load_prior", "load_solver", "make_starts"]

torchvision_ops.install()


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'lp_framework' has no attribute '{name}'")
    from lp_framework import api

    return getattr(api, name)
