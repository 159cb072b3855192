"""HOPEv2 as it is released, in BOP format: photographs of a painted box, with annotations."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import torch
from painted_cube import SIDES, photograph
from PIL import Image

from lp_framework.geometry import camera_to_world, inverse, rigid_transform, so3_exp

SIZE = (320, 240)
LONGEST = 80.0  # millimetres
CENTRE = torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64)  # of the box in the model's frame, millimetres
FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
TO_Z_UP = torch.tensor([[0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)  # x, y, z there are Z, X, Y here


def real_cameras(count: int, seed: int = 0) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Cameras in the object's frame, 4 to 9 times its length away, off-axis and rolled, with their intrinsics."""
    random = np.random.default_rng(seed)
    cameras = []
    for _ in range(count):
        low, high = [-1.0, 0.0, 4.0], [1.2, 2 * math.pi, 9.0]
        camera = camera_to_world(torch.from_numpy(random.uniform(low, high)))
        off = so3_exp(torch.from_numpy(random.uniform([-0.06, -0.06, -3], [0.06, 0.06, 3])))
        focal = random.uniform(450, 600)
        intrinsics = torch.tensor([[focal, 0, 157.3], [0, focal * 1.02, 121.7], [0, 0, 1]], dtype=torch.float64)
        cameras.append((rigid_transform(camera[:3, :3] @ off, camera[:3, 3]), intrinsics))
    return cameras


def annotation(camera: torch.Tensor) -> tuple[list[float], list[float]]:
    """cam_R_m2c and cam_t_m2c of a camera in the object's frame."""
    world_to_camera = FLIP @ inverse(camera)
    # From the model's frame: centred, scaled, and its +Z made +Y.
    rotation = world_to_camera[:3, :3] @ TO_Z_UP.mT
    translation = world_to_camera[:3, 3] * LONGEST - rotation @ CENTRE
    return rotation.flatten().tolist(), translation.tolist()


def write_scene(folder: Path, cameras: list, object_id: int = 1, visible: float = 0.95, suffix: str = ".png") -> None:
    """A scene with one annotated instance per image, preceded by an instance of another object."""
    for name in ("rgb", "mask_visib", "mask", "depth"):
        (folder / name).mkdir(parents=True)
    content: dict[str, dict] = {"scene_camera.json": {}, "scene_gt.json": {}, "scene_gt_info.json": {}}
    for index, (camera, intrinsics) in enumerate(cameras):
        image = 3 * index  # numbers of images need not be consecutive
        colours, mask = photograph(camera, intrinsics, SIZE)
        Image.fromarray(colours).save(folder / "rgb" / f"{image:06d}{suffix}", quality=98)
        Image.fromarray(mask).save(folder / "mask_visib" / f"{image:06d}_000001.png")
        Image.fromarray(0 * mask).save(folder / "mask_visib" / f"{image:06d}_000000.png")
        rotation, translation = annotation(camera)
        pixel_centres = intrinsics - torch.tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        content["scene_camera.json"][str(image)] = {"cam_K": pixel_centres.flatten().tolist(), "depth_scale": 1.0}
        other = {"obj_id": 2, "cam_R_m2c": rotation, "cam_t_m2c": translation}
        content["scene_gt.json"][str(image)] = [other, {**other, "obj_id": object_id}]
        content["scene_gt_info.json"][str(image)] = [{"visib_fract": 0.0}, {"visib_fract": visible}]
    for file, entries in content.items():
        (folder / file).write_text(json.dumps(entries))


def write_hopev2(root: Path, views: int = 9) -> Path:
    """A data set in BOP format with one object, in a scene of `val` and, partly hidden, in one of `val_realsense`."""
    sides = (LONGEST * torch.tensor(SIDES, dtype=torch.float64))[[2, 0, 1]]  # x, y, z of the model
    low = (CENTRE - sides / 2).tolist()
    info = {"diameter": 100.0}
    info |= {f"min_{axis}": value for axis, value in zip("xyz", low, strict=True)}
    info |= {f"size_{axis}": value for axis, value in zip("xyz", sides.tolist(), strict=True)}
    (root / "models").mkdir(parents=True)
    (root / "models" / "models_info.json").write_text(json.dumps({"1": info}))
    write_scene(root / "val" / "000001", real_cameras(views))
    write_scene(root / "val_realsense" / "000002", real_cameras(3, seed=1), visible=0.3)
    (root / "test" / "000003" / "rgb").mkdir(parents=True)  # without public annotations
    (root / "test" / "000003" / "scene_camera.json").write_text("{}")
    return root
