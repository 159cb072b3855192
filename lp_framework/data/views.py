"""Views on disk, in iFusion's layout, and their sources (the choices of `data=`).

    <root>/<object>/{train,test}/transform.json     camera_angle_x, frames: file_path, transform_matrix, latlon
    <root>/<object>/{train,test}/rgb/000.png ...    RGBA with a transparent background
    <root>/<object>/{train,test}/depth/000.png ...  optional, 16 bits: `DEPTH_UNIT`s along the optical axis, 0: nothing

`transform_matrix` is the camera-to-world matrix (OpenGL axes) and the ground truth. iFusion's `latlon`, whose latitude
is positive downwards, is not read. `file_path` is relative to `rgb` or to the folder of `transform.json`. `fl_x` and
`w` (pixels) may replace `camera_angle_x`, and each frame may have its own field of view. `ambiguity`, `unique_answer`
and the depths are our optional additions.
"""

from __future__ import annotations

import json
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lp_framework.data.files import check_upright, chosen, expecting, names_below, numbers, read_json
from lp_framework.errors import UserError
from lp_framework.geometry import view_pose
from lp_framework.registry import register

AMBIGUITIES = ("unique", "twofold", "continuous", "unlabelled")
TRANSFORMS = "transform.json"
FIELD_OF_VIEW_DEGREES = 49.1  # of the priors and of rendered views
LARGEST_OFFSET = 0.01  # radians, or fraction of a side: deviations of a view's intrinsics treated as rounding
DEPTH_UNIT = 1e-4  # scene units per level of a depth image


@dataclass(frozen=True)
class ObjectViews:
    """The V views of one object in one split.

    `ambiguity` is one of `AMBIGUITIES`; `unique_answer` says whether a view has one correct longitude (None: unknown).
    `cameras` `[V, 4, 4]` are camera-to-world, `field_of_view` `[V]` is in radians.
    """

    name: str
    split: str
    ambiguity: str
    unique_answer: bool | None
    files: list[Path]
    cameras: Tensor = field(repr=False)  # [V, 4, 4], camera to world, float64
    field_of_view: Tensor = field(repr=False)  # [V], radians, float64

    def __len__(self) -> int:
        return len(self.files)

    @property
    def poses(self) -> Tensor:
        """View poses `[V, 3]`, float64."""
        return view_pose(self.cameras)


def read_views(root: str | Path, name: str, split: str) -> ObjectViews:
    """Read the views of an object in a split ("train" or "test").

    Raises `UserError`, naming the file, for a missing or malformed `transform.json`, a missing image, a matrix that is
    not a camera looking at the origin, non-square pixels and an off-centre principal point.
    """
    path = Path(root) / name / split / TRANSFORMS
    content = read_json(path)
    with expecting(f"{path}: needs camera_angle_x and frames with file_path and transform_matrix"):
        frames = [(str(frame["file_path"]), frame["transform_matrix"]) for frame in content["frames"]]
        angles = [_field_of_view(content, frame, path) for frame in content["frames"] or [{}]]
    ambiguity, unique_answer = content.get("ambiguity", "unlabelled"), content.get("unique_answer")
    if ambiguity not in AMBIGUITIES:
        raise UserError(f"{path}: ambiguity {ambiguity!r} is not one of {', '.join(AMBIGUITIES)}")
    if unique_answer is not None and not isinstance(unique_answer, bool):
        raise UserError(f"{path}: unique_answer must be true, false or null, got {unique_answer!r}")
    if not frames:
        raise UserError(f"{path}: has no frames")
    files, cameras = [], []
    for index, (file_path, matrix) in enumerate(frames):
        places = [folder / file_path for folder in (path.parent / "rgb", path.parent)]
        files += [place for place in places if os.path.isfile(place)][:1]  # Path.is_file raises for an invalid name
        if len(files) == index:
            raise UserError(f"{path}: the image {file_path!r} is neither in rgb/ nor beside this file")
        with expecting(f"{path}: transform_matrix of frame {index} is not a 4 x 4 matrix of finite numbers"):
            camera = numbers(matrix, 4, 4)
        check_upright(camera, f"{path}: the camera of frame {index}")
        cameras.append(camera)
    field_of_view = torch.tensor(angles, dtype=torch.float64)
    return ObjectViews(name, split, ambiguity, unique_answer, files, torch.stack(cameras), field_of_view)


def _field_of_view(content: dict[str, Any], frame: dict[str, Any], path: Path) -> float:
    """Field of view (radians) of a frame, from its own intrinsics or else the file's; may raise any exception."""
    every = {**content, **frame}
    own = frame if {"camera_angle_x", "fl_x"} & frame.keys() else content
    if "fl_x" not in own:
        angle = float(own["camera_angle_x"])
    else:
        focal, width = float(own["fl_x"]), float(every["w"])
        height = float(every.get("h", width))
        stretched = float(own.get("fl_y", focal)) / focal - 1
        aside = (float(every.get("cx", width / 2)) / width - 0.5, float(every.get("cy", height / 2)) / height - 0.5)
        if not all(abs(each) <= LARGEST_OFFSET for each in (stretched, *aside)):
            wanted = "fl_x and fl_y must be equal, and cx and cy the image's middle"
            raise UserError(f"{path}: the views' pixels must be square and their cameras centred: {wanted}")
        angle = 2 * math.atan(width / 2 / focal)
        stated = float(own.get("camera_angle_x", angle))
        if not abs(stated - angle) <= LARGEST_OFFSET:
            raise UserError(f"{path}: camera_angle_x is {stated:.4g}, but fl_x and w give {angle:.4g} radians")
    if not 0 < angle < math.pi:
        raise UserError(f"{path}: camera_angle_x must be an angle in radians between 0 and pi, got {angle}")
    return angle


def write_transforms(folder: Path, frames: list[dict[str, Any]], **more: Any) -> None:
    """Write the `transform.json` of a split; `more` are further entries, such as another `camera_angle_x` (radians)."""
    content = {"camera_angle_x": math.radians(FIELD_OF_VIEW_DEGREES), **more, "frames": frames}
    (folder / TRANSFORMS).write_text(json.dumps(content, indent=1))


class ViewSource(ABC):
    """A set of objects whose views are in the folder `path` after `prepare`."""

    path: Path

    @abstractmethod
    def names(self) -> list[str]:
        """The names of the objects, sorted."""

    def prepare(self) -> None:  # noqa: B027
        """Create the missing views in `path`, in one process; an interrupted call can be resumed."""

    def views(self, name: str, split: str) -> ObjectViews:
        """The views of an object in a split ("train" or "test")."""
        return read_views(self.path, name, split)


@register("data", "renderings")
class RenderingsData(ViewSource):
    """A folder of views in iFusion's layout, such as its published renderings of GSO and OO3D."""

    def __init__(self, path: str, objects: str | Sequence[str] | None = None) -> None:
        self.path, self.wanted = Path(path), objects

    def names(self) -> list[str]:
        """The chosen folders among those that contain a `train` or `test` folder."""
        splits = (split for split in self.path.glob("*/*") if split.name in ("train", "test") and split.is_dir())
        names = (split.parent.name for split in splits if not split.parent.name.startswith("."))
        looked_for = f"{self.path}/OBJECT/train/{TRANSFORMS} and rgb/*.png beside it"
        return chosen(names_below(self.path, names, "views", looked_for), self.wanted, self.path)
