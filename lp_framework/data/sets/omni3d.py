"""Views in the layout of ID-Pose (Cheng et al. 2023): renderings of OmniObject3D with their cameras.

    <path>/<object>/images/011.png ...    RGBA, square, transparent background
    <path>/<object>/poses/011.npy ...     camera to world, 4 x 4 (OpenGL axes) in a world with +Z up

The cameras look at the centre and are upright; the object's size and the field of view are not recorded. The images are
therefore kept unchanged, and the scene is scaled so that the median radius of an object's cameras is 1.85, as in
ID-Pose (the mean radius in Zero123's training). Results then state "units in which the reference's radius is 1.85".
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lp_framework.data.files import check_upright, chosen, expecting, names_below, numbers
from lp_framework.data.photographs import read_image
from lp_framework.data.real_cameras import z_up_to_y_up
from lp_framework.data.sets.converted import ConvertedSource, frame
from lp_framework.data.views import ObjectViews, write_transforms
from lp_framework.errors import UserError
from lp_framework.geometry import rigid_transform
from lp_framework.registry import register

RADIUS = 1.85


@register("data", "omni3d")
class Omni3DData(ConvertedSource):
    """Views in ID-Pose's layout, all used as test views; converted into `views` on first use."""

    def __init__(self, path: str, views: str | None = None, objects: str | Sequence[str] | None = None) -> None:
        self.download, self.wanted = Path(path), objects
        self.path = Path(views or f"datasets/{self.download.resolve().name}")

    def names(self) -> list[str]:
        names = (folder.name for folder in self.download.glob("*") if (folder / "poses").is_dir())
        looked_for = f"{self.download}/OBJECT/poses/*.npy"
        return chosen(
            names_below(self.download, names, "views in ID-Pose's layout", looked_for), self.wanted, self.download
        )

    def views(self, name: str, split: str) -> ObjectViews:
        if split != "test":
            only = "data=omni3d has test views only, so there is nothing to train on"
            raise UserError(f"{self.download}: {only}; evaluate on it, or train on other data")
        return super().views(name, split)

    def convert(self, name: str, folder: Path) -> tuple[list[Path], dict[str, Any]]:
        (folder / "test" / "rgb").mkdir(parents=True)
        frames, files = [], []
        for view, camera in omni3d_cameras(self.download, name).items():
            file = self.download / name / "images" / f"{view}.png"
            image = read_image(file)
            if image.mode != "RGBA":
                raise UserError(f"{file}: has no transparent background (alpha channel)")
            if image.width != image.height:
                raise UserError(f"{file}: is {image.width} x {image.height} pixels; views must be square")
            shutil.copyfile(file, folder / "test" / "rgb" / file.name)
            frames.append(frame(file.name, camera))
            files += [file, self.download / name / "poses" / f"{view}.npy"]
        write_transforms(folder / "test", frames)
        return files, {}


def omni3d_cameras(root: str | Path, name: str) -> dict[str, Tensor]:
    """Cameras `[4, 4]` (float64) of an object by view, such as "011", with +Y up and a median radius of 1.85;
    `UserError` for a pose that is not an upright camera looking at the centre, and for fewer than two."""
    folder = Path(root) / name / "poses"
    files = sorted(folder.glob("*.npy"))
    if len(files) < 2:
        raise UserError(f"{folder}: two or more poses (*.npy) are needed, found {len(files)}")
    turned = []
    for file in files:
        with expecting(f"{file}: must be a 4 x 4 camera-to-world matrix of finite numbers"):
            rows = numbers(np.load(file).astype(np.float64, casting="same_kind")[:3], 3, 4)
        turned.append(z_up_to_y_up(rigid_transform(rows[:, :3], rows[:, 3])))
        check_upright(turned[-1], f"{file}: its camera", up="+Z")
    cameras = torch.stack(turned)
    scale = RADIUS / cameras[:, :3, 3].norm(dim=-1).median()
    scaled = rigid_transform(cameras[:, :3, :3], cameras[:, :3, 3] * scale)
    return {file.stem: camera for file, camera in zip(files, scaled, strict=True)}
