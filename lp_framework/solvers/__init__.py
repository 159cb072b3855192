"""Solvers: pairs of images and starting poses in, relative poses out. Importing this registers the built-in ones."""

from lp_framework.solvers import (  # noqa: F401
    features,
    feed_forward,
    gauss_newton,
    id_pose,
    langevin,
    multiview,
    starts,
    twist,
    two_stage,
)
