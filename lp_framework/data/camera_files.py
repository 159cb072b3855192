"""Cameras for other programs: NeRF-style transforms, a COLMAP text model, rows of a table.

All are of view poses `[V, 3]` (see `geometry.spherical`) and of square images with one field of view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from scipy.spatial.transform import Rotation
from torch import Tensor

from lp_framework.geometry import camera_to_world, from_opencv, inverse, to_ifusion


def nerf_transforms(files: Sequence[str], poses: Tensor, field_of_view_degrees: float) -> dict[str, Any]:
    """The contents of a `transforms.json` as iFusion writes it, which NeRF programs read as well.

    `files` are paths relative to it. `transform_matrix` is camera-to-world (OpenGL axes, +Y up), `latlon` iFusion's:
    down-positive latitude and longitude in degrees, radius.
    """
    poses = poses.double()
    frames = [
        {"file_path": file, "transform_matrix": matrix, "latlon": latlon}
        for file, matrix, latlon in zip(files, camera_to_world(poses).tolist(), to_ifusion(poses).tolist(), strict=True)
    ]
    return {"camera_angle_x": math.radians(field_of_view_degrees), "frames": frames}


def colmap_model(files: Sequence[str], poses: Tensor, size: int, field_of_view_degrees: float) -> dict[str, str]:
    """A COLMAP sparse model as text: file name to contents, for images of `size` pixels a side.

    One camera (PINHOLE), the images (world to camera: a quaternion, scalar first, and a translation; COLMAP's axes, x
    right, y down, z forward), and no points. The world is ours, with +Y up.
    """
    focal = size / 2 / math.tan(math.radians(field_of_view_degrees) / 2)  # pixels
    matrices = inverse(
        from_opencv(camera_to_world(poses.double()))
    )  # COLMAP has OpenCV's axes; the change is its own inverse
    quaternions = Rotation.from_matrix(matrices[:, :3, :3].numpy()).as_quat(canonical=True)  # scalar last
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for number, (file, (x, y, z, w), matrix) in enumerate(zip(files, quaternions, matrices, strict=True), start=1):
        values = " ".join(f"{round(value, 12) + 0.0:.12g}" for value in (w, x, y, z, *matrix[:3, 3].tolist()))
        lines += [f"{number} {values} 1 {file}", ""]  # the second line is for image points, of which there are none
    return {
        "cameras.txt": "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 PINHOLE {size} {size} {focal:.12g} {focal:.12g} {size / 2:g} {size / 2:g}\n",
        "images.txt": "\n".join(lines) + "\n",
        "points3D.txt": "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n",
    }
