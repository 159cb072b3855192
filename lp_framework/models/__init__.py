"""Models of the relative pose and their backbones. Importing this registers the built-in ones."""

from lp_framework.models import backbones, matching, pose_model  # noqa: F401
