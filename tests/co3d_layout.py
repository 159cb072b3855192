"""CO3Dv2 as it is released: photographs of a painted box in a world of any orientation, origin and scale."""

from __future__ import annotations

import gzip
import json
import math
from pathlib import Path

import numpy as np
import torch
import trimesh
from painted_cube import SIDES, photograph
from PIL import Image

from lp_framework.geometry import camera_to_world, rigid_transform, so3_exp

SIZE = (200, 240)
WORLD = so3_exp(torch.tensor([2.1, -0.7, 1.3], dtype=torch.float64))  # COLMAP's world in the object's frame
ORIGIN, SCALE = torch.tensor([4.0, -7.0, 2.0], dtype=torch.float64), 3.7
SEQUENCE = "106_12648_23157"


def orbit(count: int, seed: int = 0) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Cameras in the object's frame on an uneven ring around it, a little off-axis and tilted, with intrinsics."""
    random = np.random.default_rng(seed)
    cameras = []
    for index in range(count):
        turn = 2 * math.pi * (index + random.uniform(0, 0.5)) / count
        pose = [random.uniform(0.2, 0.6), turn, random.uniform(2.5, 3.5)]
        camera = camera_to_world(torch.tensor(pose, dtype=torch.float64))
        off = so3_exp(torch.from_numpy(random.uniform([-0.06, -0.06, -0.04], [0.06, 0.06, 0.04])))
        intrinsics = torch.tensor([[260.0, 0, 104], [0, 264.0, 117], [0, 0, 1]], dtype=torch.float64)
        cameras.append((rigid_transform(camera[:3, :3] @ off, camera[:3, 3]), intrinsics))
    return cameras


def in_world(camera: torch.Tensor) -> torch.Tensor:
    return rigid_transform(WORLD @ camera[:3, :3], SCALE * WORLD @ camera[:3, 3] + ORIGIN)


def viewpoint(camera: torch.Tensor, intrinsics: torch.Tensor, isotropic: bool) -> dict:
    """A camera in PyTorch3D's convention: X_camera = X R + T, x left, y up, z forward."""
    flip = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64))
    rotation = camera[:3, :3] @ flip
    half = torch.tensor([min(SIZE)] * 2 if isotropic else SIZE, dtype=torch.float64) / 2
    focal = torch.stack([intrinsics[0, 0], intrinsics[1, 1]]) / half
    principal = (torch.tensor(SIZE, dtype=torch.float64) / 2 - intrinsics[:2, 2]) / half
    return {
        "R": rotation.tolist(),
        "T": (-camera[:3, 3] @ rotation).tolist(),
        "focal_length": focal.tolist(),
        "principal_point": principal.tolist(),
        "intrinsics_format": "ndc_isotropic" if isotropic else "ndc_norm_image_bounds",
    }


def box_points(count: int = 6000, seed: int = 0) -> torch.Tensor:
    """Points on the box in COLMAP's world, and a few stray ones, as reconstructions have them."""
    random = np.random.default_rng(seed)
    points = random.uniform(-0.5, 0.5, (count, 3)) * SIDES
    face = random.integers(3, size=count)
    points[np.arange(count), face] = np.sign(points[np.arange(count), face]) * np.array(SIDES)[face] / 2
    points[: count // 200] *= 5
    return SCALE * torch.from_numpy(points) @ WORLD.mT + ORIGIN


def write_sequences(root: Path, sequences: list, category: str = "hydrant") -> None:
    with gzip.open(root / category / "sequence_annotations.jgz", "wb") as file:
        file.write(json.dumps(sequences).encode())


def write_category(
    root: Path,
    category: str = "hydrant",
    sequence: str = SEQUENCE,
    views: int = 14,
    subset: str = "manyview_dev_0",
    cloud: bool = True,
) -> Path:
    """A category of CO3Dv2 with one sequence; frame numbers are not those in the names of the files."""
    for folder in ("images", "masks", "depths", "depth_masks"):
        (root / category / sequence / folder).mkdir(parents=True)
    frames, listed = [], []
    for index, (camera, intrinsics) in enumerate(orbit(views)):
        colours, mask = photograph(camera, intrinsics, SIZE)
        image = f"{category}/{sequence}/images/frame{index + 1:06d}.jpg"
        mask_file = f"{category}/{sequence}/masks/frame{index + 1:06d}.png"
        Image.fromarray(colours).save(root / image, quality=98)
        Image.fromarray(mask).save(root / mask_file)
        frames.append(
            {
                "sequence_name": sequence,
                "frame_number": 5 * index,
                "frame_timestamp": 0.1 * index,
                "image": {"path": image, "size": [SIZE[1], SIZE[0]]},
                "mask": {"path": mask_file, "mass": 1.0},
                "viewpoint": viewpoint(in_world(camera), intrinsics, isotropic=index % 2 == 0),
            }
        )
        listed.append([sequence, 5 * index, image])
    frames.append({**frames[0], "sequence_name": "another"})
    write_frames(root, frames, category)
    (root / category / "set_lists").mkdir()
    content = {"train": listed[2:], "val": listed[:1], "test": listed[1:2]}
    (root / category / "set_lists" / f"set_lists_{subset}.json").write_text(json.dumps(content))
    file = f"{category}/{sequence}/pointcloud.ply"
    if cloud:
        points = box_points()
        colours = np.full((len(points), 4), 200, np.uint8)
        trimesh.PointCloud(points.numpy(), colors=colours).export(root / file)
    points_of = {"path": file, "quality_score": 1.7, "n_points": 6000}
    annotation = {"sequence_name": sequence, "category": category, "video": None, "point_cloud": points_of}
    nothing = {"point_cloud": None, "viewpoint_quality_score": math.nan}  # as the challenge's test sequences have it
    write_sequences(
        root,
        [{**annotation, "sequence_name": "another", **nothing}, {**annotation, "viewpoint_quality_score": 2.5}],
        category,
    )
    return root


def write_frames(root: Path, frames: list, category: str = "hydrant") -> None:
    with gzip.open(root / category / "frame_annotations.jgz", "wb") as file:
        file.write(json.dumps(frames).encode())
