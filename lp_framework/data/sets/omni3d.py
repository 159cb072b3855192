"""Views in the layout of ID-Pose (Cheng et al. 2023): renderings of OmniObject3D with their cameras.

    <path>/<object>/images/011.png ...    RGBA, square, transparent background
    <path>/<object>/poses/011.npy ...     camera to world, 4 x 4 (OpenGL axes) in a world with +Z up

The cameras look at the centre and stand upright; the object's size and the field of view are not on record. So the
images stay as they are, and the scene is scaled until the median radius of an object's cameras is 1.85, as ID-Pose does
(the mean of the radii on which Zero123 was trained). Results say then "units in which the reference's radius is 1.85".
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lp_framework.data.module import PairDataModule
from lp_framework.data.photographs import read_image
from lp_framework.data.real_cameras import z_up_to_y_up
from lp_framework.data.sets.converted import convert_objects, write_converted, write_transforms
from lp_framework.data.views import LARGEST_RESIDUAL, ObjectViews
from lp_framework.errors import UserError
from lp_framework.geometry import is_rotation, rigid_transform, spherical_residual, to_ifusion, view_pose
from lp_framework.registry import register

RADIUS = 1.85


@register("data", "omni3d")
class Omni3DData(PairDataModule):
    """Views in ID-Pose's layout, all of them test views; converted into `views` on first use."""

    def __init__(
        self,
        path: str,
        views: str | None = None,
        cache: str = "datasets/cache",
        image_size: int = 256,
        batch_pairs: int = 1024,
        block: int = 8,
        validation_views: int = 8,
        seed: int = 0,
    ) -> None:
        self.source = Path(path)
        folder = views if views is not None else f"datasets/{self.source.resolve().name}"
        super().__init__(folder, cache, image_size, batch_pairs, block, validation_views, seed)

    def names(self) -> list[str]:
        """The objects of the download, sorted."""
        return omni3d_objects(self.source)

    def prepare_data(self) -> None:
        """Convert what is not there yet, then as every data set."""
        convert_objects(self.path, self.names, self._demands(), self._convert)
        super().prepare_data()

    def _demands(self) -> dict[str, Any]:
        return {"source": self.source.resolve().name}

    def _on_disk(self, split: str) -> list[ObjectViews]:
        if split != "test":
            raise UserError(
                f"{self.source}: data=omni3d has test views only, so there is nothing to train on; "
                "evaluate on it, or train on other data"
            )
        return super()._on_disk(split)

    def _convert(self, name: str) -> None:
        cameras = omni3d_cameras(self.source, name)

        def write(folder: Path) -> None:
            (folder / "test" / "rgb").mkdir(parents=True)
            frames = []
            for view, camera in cameras.items():
                file = self.source / name / "images" / f"{view}.png"
                image = read_image(file)
                if image.mode != "RGBA":
                    raise UserError(f"{file}: has no transparent background (alpha channel)")
                if image.width != image.height:
                    raise UserError(f"{file}: is {image.width} x {image.height} pixels; views must be square")
                shutil.copyfile(file, folder / "test" / "rgb" / f"{view}.png")
                latlon = to_ifusion(view_pose(camera)).tolist()
                frames.append({"file_path": f"{view}.png", "transform_matrix": camera.tolist(), "latlon": latlon})
            write_transforms(folder / "test", frames)

        write_converted(self.path / name, {"object": name, **self._demands()}, write)


def omni3d_objects(root: str | Path) -> list[str]:
    """Names of the objects below `root`, sorted: those with a folder of poses; `UserError` where there are none."""
    root = Path(root)
    if not root.is_dir():
        raise UserError(f"{root}: there is no such folder; give data.path=FOLDER with OBJECT/images and OBJECT/poses")
    names = sorted(folder.name for folder in root.iterdir() if (folder / "poses").is_dir())
    if not names:
        raise UserError(f"{root}: holds no views in ID-Pose's layout; looked for {root}/OBJECT/poses/*.npy")
    return names


def omni3d_cameras(root: str | Path, name: str) -> dict[str, Tensor]:
    """Cameras `[4, 4]` (float64) of an object by view, such as "011", with +Y up, their median radius 1.85.

    Raises `UserError` naming the file for a pose that is not readable or no upright camera that looks at the centre,
    and where an object has fewer than two.
    """
    folder = Path(root) / name / "poses"
    files = sorted(folder.glob("*.npy"))
    if len(files) < 2:
        raise UserError(f"{folder}: two or more poses (*.npy) are needed, {len(files)} are there")
    cameras = torch.stack([_camera(file) for file in files])
    scale = RADIUS / cameras[:, :3, 3].norm(dim=-1).median()
    scaled = rigid_transform(cameras[:, :3, :3], cameras[:, :3, 3] * scale)
    return {file.stem: camera for file, camera in zip(files, scaled, strict=True)}


def _camera(file: Path) -> Tensor:
    try:
        matrix = np.load(file).astype(np.float64, casting="same_kind")
    except Exception as error:  # damaged files raise anything from EOFError to SyntaxError
        raise UserError(f"{file}: is not a readable array ({' '.join(str(error).split())})") from error
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise UserError(f"{file}: must be a 4 x 4 camera-to-world matrix of finite numbers, got {list(matrix.shape)}")
    rotation = torch.from_numpy(matrix[:3, :3])
    if not is_rotation(rotation):
        raise UserError(f"{file}: is not a rigid camera-to-world transform")
    camera = z_up_to_y_up(rigid_transform(rotation, torch.from_numpy(matrix[:3, 3])))
    if not camera[:3, 3].norm() > 1e-6:
        raise UserError(f"{file}: its camera must stand off the origin")
    residual = spherical_residual(camera).item()
    if not residual <= LARGEST_RESIDUAL:
        raise UserError(
            f"{file}: its camera does not look at the origin with +Z up (it is {residual:.1f} degrees off, "
            f"{LARGEST_RESIDUAL:g} are allowed)"
        )
    return camera
