"""Pose-conditioned diffusion priors; importing the package registers them."""

from lp_framework.priors.tiny import prior as tiny
from lp_framework.priors.tiny import training
from lp_framework.priors.zero123 import prior as zero123

__all__ = ["tiny", "training", "zero123"]
