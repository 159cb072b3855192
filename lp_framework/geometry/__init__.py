"""Spherical poses, SE(3) and pose errors: pure functions on tensors of any batch shape, no I/O."""

from lp_framework.geometry.pose_errors import PoseErrors, pose_errors, rotation_error, translation_error
from lp_framework.geometry.se3 import (
    geodesic_angle,
    hat,
    inverse,
    is_rotation,
    rigid_transform,
    se3_exp,
    se3_log,
    so3_exp,
    so3_log,
)
from lp_framework.geometry.spherical import (
    apply_relative_pose,
    camera_to_world,
    from_ifusion,
    reduce_longitude,
    relative_pose,
    spherical_residual,
    to_ifusion,
    view_pose,
    wrap_angle,
)
from lp_framework.geometry.two_view import at_optimal_scale, from_opencv, pose_of_relative_camera, relative_camera

__all__ = [
    "PoseErrors",
    "apply_relative_pose",
    "at_optimal_scale",
    "camera_to_world",
    "from_ifusion",
    "from_opencv",
    "geodesic_angle",
    "hat",
    "inverse",
    "is_rotation",
    "pose_errors",
    "pose_of_relative_camera",
    "reduce_longitude",
    "relative_camera",
    "relative_pose",
    "rigid_transform",
    "rotation_error",
    "se3_exp",
    "se3_log",
    "so3_exp",
    "so3_log",
    "spherical_residual",
    "to_ifusion",
    "translation_error",
    "view_pose",
    "wrap_angle",
]
