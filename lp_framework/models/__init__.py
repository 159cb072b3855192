"""Models of the relative pose and the backbones that they see with; importing the package registers them."""

from lp_framework.models import backbones, pose_model

__all__ = ["backbones", "pose_model"]
