"""Views on disk, in iFusion's layout, and their cameras.

    <root>/<object>/{train,test}/transform.json     camera_angle_x, frames: file_path, transform_matrix, latlon
    <root>/<object>/{train,test}/rgb/000.png ...    RGBA with a transparent background

`transform_matrix` is camera-to-world (OpenGL) and is the truth; iFusion's `latlon` counts latitude downwards and is
not read. `file_path` is relative to `rgb`, or to the folder of `transform.json`. `ambiguity` is our own optional key.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lp_framework.errors import UserError
from lp_framework.geometry import is_rotation, spherical_residual, view_pose

AMBIGUITIES = ("unique", "twofold", "continuous", "unlabelled")
TRANSFORMS = "transform.json"
LARGEST_RESIDUAL = 1.0  # degrees; a camera further from a spherical one is refused


@dataclass(frozen=True)
class ObjectViews:
    """The views of one object in one split: V image files and cameras `[V, 4, 4]` (camera to world, float64).

    `unique_answer`: whether a view has one right longitude, None where unknown.
    """

    name: str
    split: str
    ambiguity: str
    unique_answer: bool | None
    files: list[Path]
    cameras: Tensor = field(repr=False)
    field_of_view: float  # radians

    def __len__(self) -> int:
        return len(self.files)

    @property
    def poses(self) -> Tensor:
        """View poses `[V, 3]`, float64."""
        return view_pose(self.cameras)


def object_names(root: str | Path) -> list[str]:
    """Names of the objects below `root`, sorted; an object is a folder with a `train` or a `test` folder."""
    root = Path(root)
    if not root.is_dir():
        raise UserError(f"{root}: there is no such folder of views; give data.path=FOLDER with one folder an object")
    names = sorted(folder.name for folder in root.iterdir() if _is_object(folder))
    if not names:
        raise UserError(f"{root}: holds no views; expected {root}/OBJECT/train/{TRANSFORMS} and rgb/*.png beside it")
    return names


def _is_object(folder: Path) -> bool:
    return not folder.name.startswith(".") and any((folder / split).is_dir() for split in ("train", "test"))


def read_views(root: str | Path, name: str, split: str) -> ObjectViews:
    """The views of an object in a split ("train" or "test").

    Raises `UserError` naming the file for a missing or malformed `transform.json`, a missing image, and a matrix that
    is not a camera that looks at the origin.
    """
    path = Path(root) / name / split / TRANSFORMS
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise UserError(f"{path}: there is no such file; every split of an object needs one") from None
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{path}: is not readable JSON ({error})") from error
    try:
        field_of_view = float(content["camera_angle_x"])
        frames = [(str(frame["file_path"]), frame["transform_matrix"]) for frame in content["frames"]]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(
            f"{path}: needs camera_angle_x and frames with file_path and transform_matrix ({type(error).__name__}: "
            f"{error})"
        ) from error
    ambiguity = content.get("ambiguity", "unlabelled")
    if ambiguity not in AMBIGUITIES:
        raise UserError(f"{path}: ambiguity {ambiguity!r} is none of {', '.join(AMBIGUITIES)}")
    unique_answer = content.get("unique_answer")
    if unique_answer is not None and not isinstance(unique_answer, bool):
        raise UserError(f"{path}: unique_answer must be true, false or null, got {unique_answer!r}")
    if not frames:
        raise UserError(f"{path}: has no frames")
    if not 0 < field_of_view < math.pi:
        raise UserError(f"{path}: camera_angle_x must be an angle in radians between 0 and pi, got {field_of_view}")
    files = [_image_file(path, file_path) for file_path, _ in frames]
    cameras = torch.stack([_camera(path, index, matrix) for index, (_, matrix) in enumerate(frames)])
    return ObjectViews(name, split, ambiguity, unique_answer, files, cameras, field_of_view)


def _image_file(transforms: Path, file_path: str) -> Path:
    for folder in (transforms.parent / "rgb", transforms.parent):
        if os.path.isfile(folder / file_path):  # unlike Path.is_file, False for an impossible name
            return folder / file_path
    raise UserError(f"{transforms}: the image {file_path!r} is neither in rgb/ nor beside this file")


def _camera(path: Path, index: int, matrix: Any) -> Tensor:
    try:
        camera = torch.tensor(matrix, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        camera = torch.empty(0)
    if camera.shape != (4, 4) or not camera.isfinite().all():
        raise UserError(f"{path}: transform_matrix of frame {index} is not a 4 x 4 matrix of finite numbers")
    last_row = (camera[3] - camera.new_tensor([0, 0, 0, 1])).abs().max()
    if not (is_rotation(camera[:3, :3]) and last_row < 1e-3):
        raise UserError(f"{path}: transform_matrix of frame {index} is not a rigid camera-to-world transform")
    distance = camera[:3, 3].norm().item()
    if not 1e-6 < distance < math.inf:
        raise UserError(f"{path}: the camera of frame {index} must stand off the origin; its distance is {distance:g}")
    residual = spherical_residual(camera).item()
    if not residual <= LARGEST_RESIDUAL:
        raise UserError(
            f"{path}: the camera of frame {index} does not look at the origin with +Y up (it is {residual:.1f} degrees "
            f"off, {LARGEST_RESIDUAL:g} are allowed)"
        )
    return camera
