"""Tiny folders of views in iFusion's layout, for any test: drawn by numpy, nothing is rendered."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from lp_framework.geometry import camera_to_world, to_ifusion

FIELD_OF_VIEW = math.radians(49.1)
AMBIGUITY_BY_NAME = {"cup": "unique", "tram": "twofold", "vase": "continuous"}


def random_poses(count: int, *keys: str) -> NDArray[np.float64]:
    """View poses `[count, 3]` (radians, radians, scene units) in the paper's ranges; the same for the same keys."""
    random = np.random.default_rng([zlib.crc32(key.encode()) for key in keys])
    return random.uniform([math.radians(-30), 0, 1.2], [math.radians(30), 2 * math.pi, 2.0], (count, 3))


def draw_view(pose: NDArray[np.float64], size: int, seed: int = 0) -> NDArray[np.uint8]:
    """An RGBA picture `[size, size, 4]` of a disc: its colours and size tell the pose, its grain the seed."""
    latitude, longitude, radius = pose
    y, x = (np.mgrid[0:size, 0:size] + 0.5) / size * 2 - 1
    waves = [np.sin(longitude + 2 * x), np.cos(longitude + 2 * x), np.sin(3 * latitude + y)]
    grain = np.random.default_rng(seed).normal(0, 4, (size, size, 3))
    colour = np.clip(127 + 100 * np.stack(waves, axis=-1) + grain, 0, 255)
    alpha = 255 * (np.hypot(x, y) < 1.2 / radius)
    return np.concatenate([colour, alpha[..., None]], axis=-1).astype(np.uint8)


def transforms(poses: NDArray[np.float64], **labels: Any) -> dict[str, Any]:
    """The contents of a `transform.json`; `labels` are `ambiguity` and `unique_answer`, both optional."""
    cameras, latlon = (turn(torch.from_numpy(poses)).tolist() for turn in (camera_to_world, to_ifusion))
    frames = [
        {"file_path": f"{index:03d}.png", "transform_matrix": camera, "latlon": angles}
        for index, (camera, angles) in enumerate(zip(cameras, latlon, strict=True))
    ]
    return {"camera_angle_x": FIELD_OF_VIEW, **labels, "frames": frames}


def write_split(folder: Path, poses: NDArray[np.float64], size: int = 16, **labels: Any) -> Path:
    """Write `rgb/*.png` and `transform.json` below `folder`; the path of the latter."""
    (folder / "rgb").mkdir(parents=True)
    for index, pose in enumerate(poses):
        seed = zlib.crc32(f"{folder.parent.name}/{folder.name}/{index}".encode())
        Image.fromarray(draw_view(pose, size, seed)).save(folder / "rgb" / f"{index:03d}.png")
    path = folder / "transform.json"
    path.write_text(json.dumps(transforms(poses, **labels)))
    return path


def write_object(root: Path, name: str, train: int = 6, test: int = 3, size: int = 16, **labels: Any) -> Path:
    """Write an object with so many training and test views; its folder."""
    for split, count in (("train", train), ("test", test)):
        write_split(root / name / split, random_poses(count, name, split), size, **labels)
    return root / name


def write_objects(
    root: Path,
    ambiguities: Mapping[str, str] = AMBIGUITY_BY_NAME,
    train: int = 6,
    test: int = 3,
    size: int = 16,
    unique_answer: Sequence[str] = ("unique", "twofold"),
) -> Path:
    """Write several labelled objects below `root`, by default one of each ambiguity class; `root`."""
    for name, ambiguity in ambiguities.items():
        write_object(root, name, train, test, size, ambiguity=ambiguity, unique_answer=ambiguity in unique_answer)
    return root
