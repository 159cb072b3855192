"""Solvers: pairs of images and starting poses in, relative poses out. Importing this registers the built-in ones."""

from lp_framework.solvers import features, feed_forward, id_pose, multiview, starts, two_stage  # noqa: F401
