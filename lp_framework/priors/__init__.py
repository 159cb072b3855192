"""Pose-conditioned diffusion priors. Importing this registers the built-in ones."""

from lp_framework.priors.tiny import prior as _tiny  # noqa: F401
from lp_framework.priors.zero123 import prior as _zero123  # noqa: F401
