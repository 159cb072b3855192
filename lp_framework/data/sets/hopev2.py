"""HOPEv2 (Tyree et al. 2022), or any data set in the BOP format, as object-centric views.

    <path>/models/models_info.json                      bounding boxes of the objects, millimetres
    <path>/<split>/<scene>/scene_camera.json            cam_K of every image
    <path>/<split>/<scene>/scene_gt.json                obj_id, cam_R_m2c, cam_t_m2c (millimetres) of every instance
    <path>/<split>/<scene>/scene_gt_info.json           visib_fract of every instance
    <path>/<split>/<scene>/rgb/000000.png               or .jpg
    <path>/<split>/<scene>/mask_visib/000000_000000.png of an instance, by image and place in scene_gt.json

Model coordinates have +Z up. Cameras are OpenCV's, their pixels have whole numbers at the centre. Objects are named by
their number, `obj_000001`, as their models are.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import torch

from lp_framework.data.files import ObjectLists, expecting, kept_lists, numbers, read_json
from lp_framework.data.photographs import opened
from lp_framework.data.real_cameras import ObjectFrame, z_up_to_y_up
from lp_framework.data.sets.converted import Annotated, Photograph, PhotographedData
from lp_framework.errors import UserError
from lp_framework.geometry import from_opencv, inverse, rigid_transform
from lp_framework.registry import register

ANNOTATIONS = ("scene_camera.json", "scene_gt.json", "scene_gt_info.json")


class Instance(NamedTuple):
    """An instance of an object in an image, as annotated: its pose and the image's camera as they are in the files."""

    scene: Path
    image: int
    place: int  # among the instances of the image
    visible: float  # share of the silhouette
    pose: Any
    camera: Any


@register("data", "hopev2")
class HOPEv2Data(PhotographedData):
    """HOPEv2 in BOP format: crops around every object, converted into `views` on first use.

    Of the images in `splits` (folders of that name, or with a type after it as in `val_realsense`, as far as they are
    there and have annotations), with at least `least_visible` of the object's silhouette visible, `train_views` +
    `test_views` are chosen for their viewpoints.
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
    ) -> None:
        super().__init__(path, views, train_views, test_views, resolution, split_seed)
        self.splits, self.least_visible = list(splits), least_visible

    def demands(self) -> dict[str, Any]:
        return {**super().demands(), "splits": self.splits, "least_visible": self.least_visible}

    def names(self) -> list[str]:
        """The objects that have a model, `obj_000001` and so on."""
        return kept_lists(self.path, {}, lambda: ObjectLists([f"obj_{n:06d}" for n in sorted(self._frames())], [])).seen

    def photographs(self, name: str) -> Annotated:
        number = int(name.removeprefix("obj_"))
        frame = self._frames()[number]
        instances = self._instances.get(number, [])
        visible = [each for each in instances if each.visible >= self.least_visible]
        hidden = Counter({"occluded": len(instances) - len(visible)})
        return Annotated([_photograph(each, frame) for each in visible], frame.corners(), +hidden, {})

    def _frames(self) -> dict[int, ObjectFrame]:
        """The objects' frames in those of their models, by number; millimetres."""
        file = self.download / "models" / "models_info.json"
        with expecting(f"{file}: needs min_x, size_x, ... of every object by number"):
            frames = {int(number): _frame(info) for number, info in read_json(file).items()}
        if not frames or not all(frame.longest_side > 0 for frame in frames.values()):
            raise UserError(f"{file}: has no objects with an extent")
        return frames

    @cached_property
    def _instances(self) -> dict[int, list[Instance]]:
        """All annotated instances by object."""
        named = ((self.download / split, *sorted(self.download.glob(f"{split}_*"))) for split in self.splits)
        scenes = [file.parent for folder in chain(*named) for file in sorted(folder.glob("*/scene_gt.json"))]
        if not scenes:
            looked = ", ".join(f"{self.download}/{split}/*/scene_gt.json" for split in self.splits)
            raise UserError(f"{self.download}: has no annotated scenes; looked for {looked}")
        found: dict[int, list[Instance]] = {}
        for scene in scenes:
            cameras, poses, infos = (read_json(scene / file) for file in ANNOTATIONS)
            wanted = "need cameras, and obj_id and visib_fract of the same instances"
            with expecting(f"{scene}: {', '.join(ANNOTATIONS)} {wanted}"):
                for image, entries in poses.items():
                    for place, (pose, info) in enumerate(zip(entries, infos[image], strict=True)):
                        found.setdefault(int(pose["obj_id"]), []).append(
                            Instance(scene, int(image), place, float(info["visib_fract"]), pose, cameras.get(image))
                        )
        return found


def _frame(info: dict[str, Any]) -> ObjectFrame:
    low, sides = (numbers([info[f"{key}_{axis}"] for axis in "xyz"], 3) for key in ("min", "size"))
    axes, longest = z_up_to_y_up(torch.eye(4, dtype=torch.float64))[:3, :3], sides.max()
    return ObjectFrame(axes, low + sides / 2, longest, axes @ sides / longest)


def _photograph(instance: Instance, frame: ObjectFrame) -> Photograph:
    scene, image = instance.scene, instance.image
    files = [scene / "rgb" / f"{image:06d}{suffix}" for suffix in (".png", ".jpg")]
    file = next((file for file in files if file.is_file()), files[0])
    mask = scene / "mask_visib" / f"{image:06d}_{instance.place:06d}.png"
    with opened(file) as photograph:
        size = photograph.size
    with expecting(f"{scene}: image {image} needs cam_K of 9 numbers, cam_R_m2c of 9 and cam_t_m2c of 3"):
        rotation, translation = instance.pose["cam_R_m2c"], instance.pose["cam_t_m2c"]
        pose = rigid_transform(numbers(rotation, 9).view(3, 3), numbers(translation, 3))
        intrinsics = numbers(instance.camera["cam_K"], 9).view(3, 3)
        if (pose[:3, :3] @ frame.centre + pose[:3, 3])[2] <= 0:
            raise ValueError("the object is behind its camera")
        half = intrinsics.new_tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        return Photograph(file, mask, frame.camera(from_opencv(inverse(pose))), intrinsics + half, size)
