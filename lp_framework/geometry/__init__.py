"""Spherical poses, SE(3) and pose errors: pure functions on tensors of any batch shape, no I/O."""

from lp_framework.geometry.se3 import geodesic_angle, hat, inverse, is_rotation, rigid_transform, se3_exp, so3_exp
from lp_framework.geometry.spherical import (
    apply_relative_pose,
    camera_to_world,
    level_camera,
    reduce_longitude,
    relative_pose,
    rotation_error,
    spherical_residual,
    to_ifusion,
    translation_error,
    view_pose,
    wrap_angle,
)
from lp_framework.geometry.two_view import at_optimal_scale, from_opencv, pose_of_relative_camera, relative_camera

__all__ = [
    "apply_relative_pose",
    "at_optimal_scale",
    "camera_to_world",
    "from_opencv",
    "geodesic_angle",
    "hat",
    "inverse",
    "is_rotation",
    "level_camera",
    "pose_of_relative_camera",
    "reduce_longitude",
    "relative_camera",
    "relative_pose",
    "rigid_transform",
    "rotation_error",
    "se3_exp",
    "so3_exp",
    "spherical_residual",
    "to_ifusion",
    "translation_error",
    "view_pose",
    "wrap_angle",
]
