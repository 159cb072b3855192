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

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from PIL import Image
from torch import Tensor

from lp_framework.data.real_cameras import from_opencv_view, normalised, z_up_to_y_up
from lp_framework.data.sets.converted import Annotated, ConvertedData, Photograph
from lp_framework.data.sets.object_lists import ObjectLists, kept_lists
from lp_framework.errors import UserError
from lp_framework.geometry import is_rotation, rigid_transform
from lp_framework.registry import register

ANNOTATIONS = ("scene_camera.json", "scene_gt.json", "scene_gt_info.json")


class Box(NamedTuple):
    """An object's bounding box in its model's frame (+Z up): centre and side lengths `[3]`, millimetres."""

    centre: Tensor
    sides: Tensor

    def corners(self) -> Tensor:
        """Its corners `[8, 3]` in the object's frame: centre at the origin, +Y up, longest side 1."""
        halves = (self.sides / self.sides.max() / 2)[[1, 2, 0]]
        return torch.cartesian_prod(*(torch.stack([-half, half]) for half in halves))


class Instance(NamedTuple):
    """An instance of an object in an image, as annotated."""

    scene: Path
    image: int
    place: int  # among the instances of the image
    visible: float  # share of the silhouette


@register("data", "hopev2")
class HOPEv2Data(ConvertedData):
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
        cache: str = "datasets/cache",
        image_size: int = 256,
        batch_pairs: int = 1024,
        block: int = 8,
        validation_views: int = 8,
        seed: int = 0,
    ) -> None:
        super().__init__(views, cache, image_size, batch_pairs, block, validation_views, seed)
        self.source, self.splits, self.least_visible = Path(path), list(splits), least_visible
        self.train_views, self.test_views = train_views, test_views
        self.resolution, self.split_seed = resolution, split_seed
        self._instances: dict[int, list[Instance]] | None = None
        self._scenes: dict[Path, dict[str, Any]] = {}

    def demands(self) -> dict[str, Any]:
        return {**super().demands(), "splits": self.splits, "least_visible": self.least_visible}

    def names(self) -> list[str]:
        """The objects that have a model, `obj_000001` and so on."""
        return kept_lists(self.path, {}, self._available).seen

    def _available(self) -> ObjectLists:
        return ObjectLists([f"obj_{number:06d}" for number in sorted(self._boxes())], [])

    def photographs(self, name: str) -> Annotated:
        number = int(name.removeprefix("obj_"))
        box = self._boxes()[number]
        instances = self._index().get(number, [])
        visible = [each for each in instances if each.visible >= self.least_visible]
        hidden = Counter({"occluded": len(instances) - len(visible)})
        return Annotated([self._photograph(each, box) for each in visible], box.corners(), +hidden, {})

    def _photograph(self, instance: Instance, box: Box) -> Photograph:
        scene, image = instance.scene, instance.image
        content = self._scenes[scene]
        annotation = scene / "scene_gt.json"
        entry = content["scene_gt.json"][str(image)][instance.place]
        rotation = _numbers(entry, "cam_R_m2c", 9, annotation, image).view(3, 3)
        translation = _numbers(entry, "cam_t_m2c", 3, annotation, image)
        if not is_rotation(rotation):
            raise UserError(f"{annotation}: cam_R_m2c of image {image} is not a rotation")
        camera = from_opencv_view(rigid_transform(rotation, translation))
        if not (rotation @ box.centre + translation)[2] > 0:
            raise UserError(f"{annotation}: image {image} has an object behind its camera (cam_t_m2c)")
        intrinsics = _numbers(
            content["scene_camera.json"].get(str(image)), "cam_K", 9, scene / "scene_camera.json", image
        ).view(3, 3)
        if not (intrinsics[0, 0] > 0 and intrinsics[1, 1] > 0):
            raise UserError(f"{scene / 'scene_camera.json'}: cam_K of image {image} has no positive focal lengths")
        half = intrinsics.new_tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        file = _image_file(scene / "rgb", image)
        mask = scene / "mask_visib" / f"{image:06d}_{instance.place:06d}.png"
        if not mask.is_file():
            raise UserError(f"{mask}: there is no such mask")
        return Photograph(
            file=file,
            mask=mask,
            camera=z_up_to_y_up(normalised(camera, box.centre, box.sides.max())),
            intrinsics=intrinsics + half,
            size=_size(file),
        )

    def _boxes(self) -> dict[int, Box]:
        file = self.source / "models" / "models_info.json"
        if not self.source.is_dir():
            raise UserError(f"{self.source}: there is no such folder; give data.path=FOLDER of a BOP data set")
        content = _read_json(file)
        try:
            boxes = {
                int(number): Box(
                    torch.tensor(
                        [info[f"min_{axis}"] + info[f"size_{axis}"] / 2 for axis in "xyz"], dtype=torch.float64
                    ),
                    torch.tensor([info[f"size_{axis}"] for axis in "xyz"], dtype=torch.float64),
                )
                for number, info in content.items()
            }
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise UserError(
                f"{file}: needs min_x, size_x, ... of every object by number ({type(error).__name__}: {error})"
            ) from error
        if not boxes or not all(box.sides.max() > 0 for box in boxes.values()):
            raise UserError(f"{file}: has no objects with an extent")
        return boxes

    def _index(self) -> dict[int, list[Instance]]:
        """All annotated instances by object."""
        if self._instances is None:
            folders = [
                folder
                for split in self.splits
                for folder in (self.source / split, *sorted(self.source.glob(f"{split}_*")))
            ]
            scenes = [file.parent for folder in folders for file in sorted(folder.glob("*/scene_gt.json"))]
            if not scenes:
                looked = ", ".join(f"{self.source}/{split}/*/scene_gt.json" for split in self.splits)
                raise UserError(f"{self.source}: has no annotated scenes; looked for {looked}")
            found: dict[int, list[Instance]] = {}
            for scene in scenes:
                self._scenes[scene] = content = {file: _read_json(scene / file) for file in ANNOTATIONS}
                try:
                    for image, entries in content["scene_gt.json"].items():
                        for place, entry in enumerate(entries):
                            visible = float(content["scene_gt_info.json"][image][place]["visib_fract"])
                            instance = Instance(scene, int(image), place, visible)
                            found.setdefault(int(entry["obj_id"]), []).append(instance)
                except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
                    raise UserError(
                        f"{scene}: scene_gt.json and scene_gt_info.json need obj_id and visib_fract of the same "
                        f"instances ({type(error).__name__}: {error})"
                    ) from error
            self._instances = found
        return self._instances


def _read_json(file: Path) -> Any:
    try:
        return json.loads(file.read_bytes())
    except FileNotFoundError:
        raise UserError(f"{file}: there is no such file; a data set in BOP format needs it") from None
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{file}: is not readable JSON ({error})") from error


def _numbers(entry: Any, key: str, count: int, file: Path, image: int) -> Tensor:
    try:
        values = torch.tensor(entry[key], dtype=torch.float64)
    except (KeyError, TypeError, ValueError, RuntimeError):
        values = torch.empty(0)
    if values.shape != (count,) or not values.isfinite().all():
        raise UserError(f"{file}: {key} of image {image} must be {count} finite numbers")
    return values


def _image_file(folder: Path, image: int) -> Path:
    for suffix in (".png", ".jpg"):
        if (folder / f"{image:06d}{suffix}").is_file():
            return folder / f"{image:06d}{suffix}"
    raise UserError(f"{folder / f'{image:06d}.png'}: there is no such image, nor one that ends in .jpg")


def _size(file: Path) -> tuple[int, int]:
    try:
        with Image.open(file) as image:
            return image.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise UserError(f"{file}: is not a readable image ({error})") from error
