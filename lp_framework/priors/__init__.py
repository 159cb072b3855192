"""Pose-conditioned diffusion priors; importing the package registers them."""

from lp_framework.priors.tiny import prior as tiny_prior
from lp_framework.priors.tiny import training as tiny_training
from lp_framework.priors.zero123 import prior as zero123_prior

__all__ = ["tiny_prior", "tiny_training", "zero123_prior"]
