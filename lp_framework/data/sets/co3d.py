"""CO3Dv2 (Reizenstein et al. 2021), its single-sequence subset, as object-centric views.

    <path>/<category>/set_lists/set_lists_<subset>.json   frames of a sequence: [sequence_name, frame_number, path]
    <path>/<category>/frame_annotations.jgz               cameras, sizes, and paths of images and masks
    <path>/<category>/sequence_annotations.jgz            paths of point clouds, scores of clouds and cameras
    <path>/<category>/<sequence>/images/frame000001.jpg
    <path>/<category>/<sequence>/masks/frame000001.png    probability of the object, 0 to 255
    <path>/<category>/<sequence>/pointcloud.ply           the object alone; the challenge's test sequences have none

Cameras are PyTorch3D's, in COLMAP's world, which has arbitrary orientation, origin and scale. There is no model of the
object, so its frame is estimated from cameras, masks and point cloud (see `real_cameras`).
"""

from __future__ import annotations

import itertools
import math
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion
from torch import Tensor

from lp_framework.data.files import ObjectLists, chosen, drawn, expecting, kept_lists, names_below, numbers, read_json
from lp_framework.data.masks import HALF
from lp_framework.data.photographs import read_image
from lp_framework.data.real_cameras import (
    agreeing_views,
    fitting_views,
    frame_of_points,
    frame_of_silhouettes,
    from_pytorch3d,
    ndc_intrinsics,
)
from lp_framework.data.sets.converted import Annotated, Photograph, PhotographedData
from lp_framework.errors import UserError
from lp_framework.registry import register

FRAMES, SEQUENCES = "frame_annotations.jgz", "sequence_annotations.jgz"
FORMATS = {"ndc_isotropic": True, "ndc_norm_image_bounds": False}
SAMPLES = 4000  # pixels of a mask used to measure its extent
BLACK = 8  # images with no brighter pixel were blackened for the challenge


@register("data", "co3d")
class CO3DData(PhotographedData):
    """CO3Dv2's single-sequence subset: crops around the object of each scene, converted into `views` on first use.

    `scenes` sequences are drawn from the set lists of `subsets` with `split_seed` and stored in `objects.json`; of
    each, `train_views` + `test_views` frames with well-spread viewpoints are chosen.
    """

    def __init__(
        self,
        path: str,
        views: str = "datasets/co3d",
        subsets: Sequence[str] = ("manyview_dev_0", "manyview_dev_1"),
        scenes: int = 29,
        train_views: int = 60,
        test_views: int = 8,
        resolution: int = 512,
        split_seed: int = 0,
        objects: str | Sequence[str] | None = None,
    ) -> None:
        super().__init__(path, views, train_views, test_views, resolution, split_seed, objects)
        self.subsets, self.scenes = list(subsets), scenes

    def demands(self) -> dict[str, Any]:
        return {**super().demands(), "subsets": self.subsets}

    def names(self) -> list[str]:
        """The chosen or drawn scenes, `<category>-<sequence>`."""
        if self.wanted is not None:
            return chosen(self._available(), self.wanted, self.download)
        how = {"subsets": self.subsets, "scenes": self.scenes, "split_seed": self.split_seed}
        return kept_lists(self.path, how, self._draw).seen

    def _draw(self) -> ObjectLists:
        return drawn(self._available(), self.scenes, 0, self.split_seed, self.download)

    def _available(self) -> list[str]:
        folders = self.download.glob("*")
        scenes = (f"{folder.name}-{sequence}" for folder in folders for sequence, _ in self._listed(folder))
        looked_for = (f"{self.download}/*/set_lists/set_lists_{subset}.json" for subset in self.subsets)
        return names_below(self.download, scenes, "scenes of CO3Dv2", ", ".join(looked_for))

    def _listed(self, folder: Path) -> set[tuple[str, int]]:
        """Sequence and frame number of every frame in the category's set lists; few categories have all lists."""
        listed: set[tuple[str, int]] = set()
        for file in (folder / "set_lists" / f"set_lists_{subset}.json" for subset in self.subsets):
            if file.is_file():
                content = read_json(file)
                with expecting(f"{file}: is not a set list of CO3Dv2"):
                    listed |= {(str(name), int(number)) for frames in content.values() for name, number, _ in frames}
        return listed

    def annotations(self, name: str) -> list[Path]:
        folder = self.download / name.partition("-")[0]
        cloud, _ = _cloud_and_scores(folder / SEQUENCES, name.partition("-")[2], self.download)
        return [folder / FRAMES, folder / SEQUENCES, *([] if cloud is None else [cloud])]

    def photographs(self, name: str) -> Annotated:
        category, _, sequence = name.partition("-")
        folder = self.download / category
        listed = {number for found, number in self._listed(folder) if found == sequence}
        file = folder / FRAMES
        annotated = _of_sequence(file, sequence)
        frames = {each["frame_number"]: each for each in annotated if isinstance(each.get("frame_number"), int)}
        if missing := sorted(listed - frames.keys()):
            raise UserError(f"{file}: has no frame {missing[0]} of sequence '{sequence}', which the set list names")
        photographs = [_photograph(frames[number], self.download, file) for number in sorted(listed)]
        cloud, scores = _cloud_and_scores(folder / SEQUENCES, sequence, self.download)
        with expecting(f"{folder / sequence}: the object's frame cannot be determined"):
            return _in_object_frame(photographs, cloud, scores)


def _of_sequence(file: Path, sequence: str) -> list[dict[str, Any]]:
    """The entries of an annotation file that belong to a sequence."""
    content = read_json(file)
    with expecting(f"{file}: must hold a list of frames or sequences, each with sequence_name"):
        return [each for each in content if each["sequence_name"] == sequence]


def _photograph(frame: dict[str, Any], root: Path, file: Path) -> Photograph:
    """An annotated frame, with its camera still in the sequence's world."""
    where = f"{file}: frame {frame['frame_number']} of sequence '{frame['sequence_name']}'"
    wanted = "R of 3 x 3 numbers, T of 3, focal_length and principal_point of 2"
    with expecting(f"{where} needs image, mask and viewpoint with {wanted}, intrinsics_format {' or '.join(FORMATS)}"):
        view, (height, width) = frame["viewpoint"], frame["image"]["size"]
        size = (int(width), int(height))
        rotation, translation = numbers(view["R"], 3, 3), numbers(view["T"], 3)
        focal, principal = numbers(view["focal_length"], 2), numbers(view["principal_point"], 2)
        isotropic = FORMATS[view.get("intrinsics_format", "ndc_norm_image_bounds")]
        image, mask = root / frame["image"]["path"], root / frame["mask"]["path"]
        camera, intrinsics = from_pytorch3d(rotation, translation), ndc_intrinsics(focal, principal, size, isotropic)
        return Photograph(image, mask, camera, intrinsics, size)


def _cloud_and_scores(file: Path, sequence: str, root: Path) -> tuple[Path | None, dict[str, float | None]]:
    """The point cloud of a sequence, None if missing, and the scores of its cameras and cloud (larger is better; None
    if not recorded)."""
    found = _of_sequence(file, sequence)
    if not found:
        raise UserError(f"{file}: has no sequence '{sequence}', which the set list names")
    wanted = "needs point_cloud with path and quality_score, or null, and viewpoint_quality_score"
    with expecting(f"{file}: sequence '{sequence}' {wanted}"):
        cloud = found[0].get("point_cloud") or {}
        path = root / cloud["path"] if cloud and os.path.isfile(root / cloud["path"]) else None
        scores = (found[0].get("viewpoint_quality_score"), cloud.get("quality_score"))
        cameras, points = (float(score) if score is not None and math.isfinite(score) else None for score in scores)
    return path, {"viewpoint_quality_score": cameras, "point_cloud_quality_score": points}


def _in_object_frame(photographs: list[Photograph], cloud: Path | None, scores: dict[str, float | None]) -> Annotated:
    left_out: Counter[str] = Counter()
    whole, pixels = [], []
    for photograph in photographs:
        found = mask_pixels(photograph)
        if not len(found):
            left_out["with an empty mask"] += 1
        elif (found.min(axis=0) < 1).any() or (found.max(axis=0) > np.array(photograph.size) - 1).any():
            left_out["cut off by the image"] += 1
        elif np.asarray(read_image(photograph.file)).max() <= BLACK:
            left_out["all black"] += 1
        else:
            whole.append(photograph)
            pixels.append(found)
    nothing = Annotated([], torch.zeros(1, 3, dtype=torch.float64), left_out, dict(scores))
    if len(whole) < 3:
        return nothing
    cameras = torch.stack([photograph.camera for photograph in whole])
    intrinsics = torch.stack([photograph.intrinsics for photograph in whole])
    points = None if cloud is None else read_points(cloud)
    if points is not None:
        sound = fitting_views(cameras, intrinsics, pixels, points)
        if 2 * sound.sum() <= len(whole):
            points = None  # it belongs to something else
    if points is None:
        sound = agreeing_views(cameras, intrinsics, pixels)
    if wrong := [photograph.file.name for photograph, fits in zip(whole, sound, strict=True) if not fits]:
        left_out[f"whose camera or mask does not fit the others' ({', '.join(wrong)})"] = len(wrong)
    if sound.sum() < 3:
        return nothing
    cameras = cameras[sound]
    if points is None:
        frame = frame_of_silhouettes(cameras, intrinsics[sound], list(itertools.compress(pixels, sound)))
    else:
        frame = frame_of_points(cameras, points)
    fitting = zip(itertools.compress(whole, sound), frame.camera(cameras), strict=True)
    moved = [replace(photograph, camera=camera) for photograph, camera in fitting]
    source = "silhouettes" if points is None else "point cloud"
    return Annotated(moved, frame.corners(), left_out, {"object_frame": source, **scores})


def read_points(file: Path) -> Tensor:
    """The points `[P, 3]` (float64) of a PLY file; `UserError` naming it if it is unreadable or has fewer than 3."""
    with expecting(f"{file}: does not load as a point cloud of three or more points"):
        loaded: Any = trimesh.load(file, process=False)
        if len(loaded.vertices) < 3:
            raise ValueError(f"it has {len(loaded.vertices)}")
        return numbers(np.asarray(loaded.vertices), len(loaded.vertices), 3)


def mask_pixels(photograph: Photograph) -> NDArray[np.float64]:
    """Centres `[M, 2]` (x, y; pixels) of the outermost object pixels in each row and column of a photograph's mask."""
    inside = np.asarray(photograph.opacity()) >= HALF
    outline = inside & ~binary_erosion(inside)
    rows, columns = np.nonzero(outline)
    chosen = np.linspace(0, len(rows) - 1, min(len(rows), SAMPLES)).round().astype(int)
    return np.stack([columns[chosen], rows[chosen]], axis=-1) + 0.5
