"""HOPEv2 (Tyree et al. 2022), or any data set in the BOP format, as object-centric views.

    <path>/models/models_info.json                      bounding boxes of the objects, millimetres (or metres)
    <path>/<split>/<scene>/scene_camera.json            cam_K of every image
    <path>/<split>/<scene>/scene_gt.json                obj_id, cam_R_m2c, cam_t_m2c (millimetres, or metres)
    <path>/<split>/<scene>/scene_gt_info.json           visib_fract of every instance
    <path>/<split>/<scene>/rgb/000000.png               or .jpg
    <path>/<split>/<scene>/mask_visib/000000_000000.png of an instance, by image and index in scene_gt.json

Model coordinates have +Z up. Cameras are OpenCV's, with pixel centres at integer coordinates. Objects are named after
their number, `obj_000001`, like their models.
"""

from __future__ import annotations

import math
import warnings
from collections import Counter, defaultdict
from collections.abc import Sequence
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lp_framework.data.files import ObjectLists, chosen, expecting, kept_lists, numbers, read_json
from lp_framework.data.masks import HALF, mask_opacity
from lp_framework.data.photographs import opened, read_mask
from lp_framework.data.real_cameras import ObjectFrame, z_up_to_y_up
from lp_framework.data.sets.converted import Annotated, Photograph, PhotographedData
from lp_framework.errors import UserError
from lp_framework.geometry import from_opencv, inverse, rigid_transform
from lp_framework.registry import register

MODELS = Path("models") / "models_info.json"
ANNOTATIONS = ("scene_camera.json", "scene_gt.json", "scene_gt_info.json")
UNITS = {  # factor from cam_t_m2c to the unit of the models, and its meaning
    1.0: "models and cam_t_m2c in the same unit",
    1000.0: "models in millimetres, cam_t_m2c in metres",
    0.001: "models in metres, cam_t_m2c in millimetres",
}
SAMPLES = 9  # masks of an object used to determine its unit
FARTHEST_OFF = 8.0  # times larger or smaller than in its masks: neither unit fits


class Instance(NamedTuple):
    """An annotated instance of an object in an image: its pose and the image's camera as stored in the files."""

    scene: Path
    image: int
    mask: Path
    visible: float  # fraction of the silhouette
    pose: Any
    camera: Any

    def numbers(self) -> tuple[Tensor, Tensor, Tensor]:
        """Rotation `[3, 3]` and translation `[3]`, from the model to the camera, and intrinsics `[3, 3]`."""
        with expecting(f"{self.scene}: image {self.image} needs cam_K of 9 numbers, cam_R_m2c of 9 and cam_t_m2c of 3"):
            rotation = numbers(self.pose["cam_R_m2c"], 9).view(3, 3)
            return rotation, numbers(self.pose["cam_t_m2c"], 3), numbers(self.camera["cam_K"], 9).view(3, 3)


@register("data", "hopev2")
class HOPEv2Data(PhotographedData):
    """HOPEv2 in BOP format: crops around every object, converted into `views` on first use.

    `train_views` + `test_views` images with well-spread viewpoints and at least `least_visible` of the object's
    silhouette visible are chosen from `splits`: folders of that name, or with a suffix as in `val_realsense`, if they
    exist and have annotations.
    """

    def __init__(
        self,
        path: str,
        views: str = "datasets/hopev2",
        splits: Sequence[str] = ("val", "test", "onboarding_static"),
        train_views: int = 100,
        test_views: int = 4,
        least_visible: float = 0.8,
        resolution: int = 512,
        split_seed: int = 0,
        objects: str | Sequence[str] | None = None,
    ) -> None:
        super().__init__(path, views, train_views, test_views, resolution, split_seed, objects)
        self.splits, self.least_visible = list(splits), least_visible

    def demands(self) -> dict[str, Any]:
        return {**super().demands(), "splits": self.splits, "least_visible": self.least_visible}

    def names(self) -> list[str]:
        """The selected objects that have a model, `obj_000001` and so on."""
        lists = kept_lists(self.path, {}, lambda: ObjectLists(sorted(self._frames()), []))
        return chosen(lists.seen, self.wanted, self.download)

    def annotations(self, name: str) -> list[Path]:
        scenes = sorted({each.scene for each in self._instances[name]})
        return [self.download / MODELS, *(scene / file for scene in scenes for file in ANNOTATIONS)]

    def photographs(self, name: str) -> Annotated:
        frame, instances = self._frames()[name], self._instances[name]
        visible = [each for each in instances if each.visible >= self.least_visible]
        hidden = Counter({"occluded": len(instances) - len(visible)})
        unit = _unit(visible, frame, f"{self.download}: object '{name}'")
        photographs = [_photograph(each, frame, unit) for each in visible]
        return Annotated(photographs, frame.corners(), +hidden, {"units": UNITS[unit]})

    def _frames(self) -> dict[str, ObjectFrame]:
        """The objects' frames in the coordinates and unit of their models."""
        file, axes = self.download / MODELS, z_up_to_y_up(torch.eye(4, dtype=torch.float64))[:3, :3]
        with expecting(f"{file}: needs min_x, size_x, ... of every object by number"):
            frames = {}
            for number, info in read_json(file).items():
                low, sides = (numbers([info[f"{key}_{axis}"] for axis in "xyz"], 3) for key in ("min", "size"))
                frames[_name(number)] = ObjectFrame(axes, low + sides / 2, sides.max(), axes @ sides / sides.max())
        if not frames or not all(frame.longest_side > 0 for frame in frames.values()):
            raise UserError(f"{file}: has no objects with an extent")
        return frames

    @cached_property
    def _instances(self) -> defaultdict[str, list[Instance]]:
        """All annotated instances by object."""
        named = ((self.download / split, *sorted(self.download.glob(f"{split}_*"))) for split in self.splits)
        scenes = [file.parent for folder in chain(*named) for file in sorted(folder.glob("*/scene_gt.json"))]
        if not scenes:
            looked = ", ".join(f"{self.download}/{split}/*/scene_gt.json" for split in self.splits)
            raise UserError(f"{self.download}: has no annotated scenes; looked for {looked}")
        found: defaultdict[str, list[Instance]] = defaultdict(list)
        for scene in scenes:
            contents = [read_json(scene / file) for file in ANNOTATIONS]
            wanted = "need cameras, and obj_id and visib_fract of the same instances"
            with expecting(f"{scene}: {', '.join(ANNOTATIONS)} {wanted}"):
                # Some data sets pad image numbers with zeros.
                cameras, poses, infos = ({int(image): entry for image, entry in each.items()} for each in contents)
                for image, entries in poses.items():
                    for place, (pose, info) in enumerate(zip(entries, infos[image], strict=True)):
                        mask, visible = f"{image:06d}_{place:06d}.png", float(info["visib_fract"])
                        instance = Instance(
                            scene, image, scene / "mask_visib" / mask, visible, pose, cameras.get(image)
                        )
                        found[_name(pose["obj_id"])].append(instance)
        return found


def _name(number: str | int) -> str:
    return f"obj_{int(number):06d}"


def _unit(instances: Sequence[Instance], frame: ObjectFrame, name: str) -> float:
    """The key of `UNITS` that best matches the object's length in its masks; warns if it is not 1."""
    times = []  # length in the masks, in longest sides, for each unit
    for instance in instances[:: math.ceil(len(instances) / SAMPLES) or 1]:
        rotation, translation, intrinsics = instance.numbers()
        opacity = mask_opacity(read_mask(instance.mask), str(instance.mask))
        rows, columns = np.nonzero(np.asarray(opacity) >= HALF) if opacity else ((), ())
        if len(rows) and intrinsics[0, 0] > 0:
            shown = (max(np.ptp(rows), np.ptp(columns)) + 1) / intrinsics[0, 0]
            distances = torch.stack([(rotation @ frame.centre + unit * translation).norm() for unit in UNITS])
            times.append(shown * distances / frame.longest_side)
    if not times:
        return 1.0
    median = torch.stack(times).median(dim=0).values
    best = int(median.log().abs().argmin())
    if not 1 / FARTHEST_OFF <= median[best] <= FARTHEST_OFF:
        wanted = "models_info.json and cam_t_m2c must be in millimetres or metres"
        raise UserError(f"{name}: its masks show it {median[0]:.3g} times as long as its model is; {wanted}")
    unit = list(UNITS)[best]
    if unit != 1:
        warnings.warn(f"{name}: assuming {UNITS[unit]}, as its masks show", stacklevel=2)
    return unit


def _photograph(instance: Instance, frame: ObjectFrame, unit: float) -> Photograph:
    scene, image = instance.scene, instance.image
    files = [scene / "rgb" / f"{image:06d}{suffix}" for suffix in (".png", ".jpg")]
    file = next((file for file in files if file.is_file()), files[0])
    with opened(file) as photograph:
        size = photograph.size
    rotation, translation, intrinsics = instance.numbers()
    with expecting(f"{scene}: image {image} has a camera that cannot be"):
        pose = rigid_transform(rotation, unit * translation)
        if (pose[:3, :3] @ frame.centre + pose[:3, 3])[2] <= 0:
            raise ValueError("the object is behind its camera")
        half = intrinsics.new_tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        return Photograph(file, instance.mask, frame.camera(from_opencv(inverse(pose))), intrinsics + half, size)
