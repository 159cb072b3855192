"""Readers of `transforms.json` that demand what nerfstudio's `nerfstudio-data` parser, instant-ngp's loader and
iFusion's `load_frames` demand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image


class Read(NamedTuple):
    file: Path
    matrix: NDArray  # camera to world, OpenGL axes
    focal: tuple[float, float]
    middle: tuple[float, float]
    size: tuple[int, int]


def _content(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "transforms.json").read_text())


def as_nerfstudio(folder: Path) -> tuple[list[Read], trimesh.PointCloud]:
    """Each intrinsic is the file's or else every frame's; masks are for all frames or for none; images are opened;
    points come from `ply_file_path`."""
    content = _content(folder)
    frames = sorted(content["frames"], key=lambda frame: folder / frame["file_path"])
    assert len({"mask_path" in frame for frame in frames}) == 1
    assert content.get("camera_model", "OPENCV") == "OPENCV" and "applied_transform" not in content
    read = []
    for frame in frames:
        fx, fy, cx, cy, width, height = (
            float(content[key] if key in content else frame[key]) for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")
        )
        assert not {"k1", "k2", "k3", "k4", "p1", "p2"} & (content.keys() | frame.keys())
        with Image.open(folder / frame["file_path"]) as image:
            assert image.size == (width, height)  # as it lies on disk: EXIF's orientation is not looked at
        matrix = np.array(frame["transform_matrix"], dtype=np.float32)
        assert matrix.shape == (4, 4)
        read.append(Read(folder / frame["file_path"], matrix, (fx, fy), (cx, cy), (int(width), int(height))))
    points = trimesh.load(folder / content["ply_file_path"])
    return read, points


def as_instant_ngp(folder: Path) -> list[Read]:
    """Focal length by `fl_x`, else by `camera_angle_x`; the principal point needs `w` and `h` where it is; those of a
    frame come before those of the file; the size is the image's."""
    content, read = _content(folder), []
    assert isinstance(content["frames"], list) and content["frames"] and "camera" not in content
    for frame in content["frames"]:
        file = folder / frame["file_path"].replace("\\", "/")
        assert file.suffix[1:] in ("png", "jpg", "jpeg", "bmp", "gif", "tga", "pic", "pnm", "psd", "exr")
        with Image.open(file) as image:
            size = image.size
        focal, middle = None, (0.5, 0.5)
        for place in (content, frame):
            if "fl_x" in place:
                focal = place["fl_x"], place.get("fl_y", place["fl_x"])
            elif "camera_angle_x" in place:
                focal = (size[0] / 2 / np.tan(place["camera_angle_x"] / 2),) * 2
            if "cx" in place:
                middle = place["cx"] / place["w"], place["cy"] / place["h"]
        assert focal is not None and not {"latlong", "equirectangular", "is_fisheye"} & content.keys()
        matrix = np.array([row[:4] for row in frame["transform_matrix"][:3]], dtype=np.float32)
        read.append(Read(file, matrix, focal, (middle[0] * size[0], middle[1] * size[1]), size))
    return read


def as_ifusion(folder: Path) -> list[tuple[Path, NDArray, list[float]]]:
    """File, camera to world, and `latlon` of every frame; images are 256 pixels per side."""
    read = []
    for frame in _content(folder)["frames"]:
        with Image.open(folder / frame["file_path"]) as image:
            assert image.size == (256, 256)
        read.append((folder / frame["file_path"], np.array(frame["transform_matrix"]), frame["latlon"]))
    return read
