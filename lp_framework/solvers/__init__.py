"""Solvers and the starts that they descend from; importing the package registers them."""

from lp_framework.solvers import (
    features,
    feed_forward,
    gauss_newton,
    id_pose,
    ifusion,
    langevin,
    multiview,
    starts,
    two_stage,
)

__all__ = [
    "features",
    "feed_forward",
    "gauss_newton",
    "id_pose",
    "ifusion",
    "langevin",
    "multiview",
    "starts",
    "two_stage",
]
