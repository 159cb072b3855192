"""CO3Dv2 (Reizenstein et al. 2021), its single-sequence subset, as object-centric views.

    <path>/<category>/set_lists/set_lists_<subset>.json   frames of a sequence: [sequence_name, frame_number, path]
    <path>/<category>/frame_annotations.jgz               cameras, sizes, and paths of images and masks
    <path>/<category>/<sequence>/images/frame000001.jpg
    <path>/<category>/<sequence>/masks/frame000001.png    probability of the object, 0 to 255

Cameras are PyTorch3D's. Their world is COLMAP's, of any orientation, origin and scale, and there is no model of the
object, so the object's frame is taken from cameras and masks (`object_frame`): up is where the photographs have it, the
centre and the longest side are those of the silhouettes.
"""

from __future__ import annotations

import gzip
import json
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.data.photographs import HALF, read_image
from lp_framework.data.real_cameras import from_pytorch3d, ndc_intrinsics
from lp_framework.data.sets.converted import ConvertedData, Photograph
from lp_framework.data.sets.object_lists import drawn, kept_lists
from lp_framework.errors import UserError
from lp_framework.geometry import camera_to_world, rigid_transform, view_pose
from lp_framework.registry import register

FORMATS = {"ndc_isotropic": True, "ndc_norm_image_bounds": False}
SAMPLES = 4000  # pixels of a mask that its extent is taken from


class ObjectFrame(NamedTuple):
    """Where an object is in the world: rows `[3, 3]` of its axes (second: up), centre `[3]`, and about its longest
    side; `sides` `[3]` of its bounding box in these units, the horizontal ones equal."""

    axes: Tensor
    centre: Tensor
    longest_side: Tensor
    sides: Tensor

    def camera(self, camera: Tensor) -> Tensor:
        """A camera `[..., 4, 4]` of the world in the object's frame."""
        place = (self.axes @ (camera[..., :3, 3] - self.centre)[..., None]).squeeze(-1) / self.longest_side
        return rigid_transform(self.axes @ camera[..., :3, :3], place)


@register("data", "co3d")
class CO3DData(ConvertedData):
    """CO3Dv2's single-sequence subset: crops around the object of each scene, converted into `views` on first use.

    `scenes` of the sequences of a set list are taken, drawn with `split_seed` and kept in `objects.json`; of each,
    `train_views` + `test_views` frames are chosen for their viewpoints.
    """

    def __init__(
        self,
        path: str,
        views: str = "datasets/co3d",
        subset: str = "manyview_dev_0",
        scenes: int = 29,
        train_views: int = 60,
        test_views: int = 4,
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
        self.source, self.subset, self.scenes = Path(path), subset, scenes
        self.train_views, self.test_views = train_views, test_views
        self.resolution, self.split_seed = resolution, split_seed

    def demands(self) -> dict[str, Any]:
        return {**super().demands(), "subset": self.subset}

    def names(self) -> list[str]:
        """The scenes, `<category>-<sequence>`."""
        how = {"subset": self.subset, "scenes": self.scenes, "split_seed": self.split_seed}
        return kept_lists(
            self.path, how, lambda: drawn(self._available(), self.scenes, 0, self.split_seed, self.source)
        ).seen

    def _available(self) -> list[str]:
        if not self.source.is_dir():
            raise UserError(f"{self.source}: there is no such folder; give data.path=FOLDER of CO3Dv2")
        pattern = f"*/set_lists/set_lists_{self.subset}.json"
        files = sorted(self.source.glob(pattern))
        if not files:
            raise UserError(f"{self.source}: has no set lists of CO3Dv2; looked for {self.source}/{pattern}")
        return sorted(
            {f"{file.parents[1].name}-{sequence}" for file in files for sequence, _ in _frames_of_set_list(file)}
        )

    def photographs(self, name: str) -> tuple[list[Photograph], Tensor, Counter[str]]:
        category, _, sequence = name.partition("-")
        folder = self.source / category
        listed = {
            number
            for found, number in _frames_of_set_list(folder / "set_lists" / f"set_lists_{self.subset}.json")
            if found == sequence
        }
        file = folder / "frame_annotations.jgz"
        frames = {
            int(frame["frame_number"]): frame
            for frame in _read_jgz(file)
            if isinstance(frame, dict) and frame.get("sequence_name") == sequence and "frame_number" in frame
        }
        if missing := sorted(listed - frames.keys()):
            raise UserError(f"{file}: has no frame {missing[0]} of sequence '{sequence}', which the set list names")
        return _in_object_frame(
            [_photograph(frames[number], self.source, file) for number in sorted(listed)], f"{file}: '{sequence}'"
        )


# ---------------------------------------------------------------- annotations


def _frames_of_set_list(file: Path) -> list[tuple[str, int]]:
    """Sequence and frame number of every frame in a set list, whatever part it is in."""
    try:
        content = json.loads(file.read_bytes())
        return [(str(sequence), int(number)) for frames in content.values() for sequence, number, _ in frames]
    except FileNotFoundError:
        raise UserError(f"{file}: there is no such set list") from None
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise UserError(f"{file}: is no set list of CO3Dv2 ({type(error).__name__}: {error})") from error


def _read_jgz(file: Path) -> list[Any]:
    try:
        with gzip.open(file) as opened:
            content = json.loads(opened.read())
    except FileNotFoundError:
        raise UserError(f"{file}: there is no such file; every category of CO3Dv2 has one") from None
    except (OSError, EOFError, ValueError) as error:
        raise UserError(f"{file}: is not readable gzipped JSON ({error})") from error
    if not isinstance(content, list):
        raise UserError(f"{file}: must hold a list of frames")
    return content


def _photograph(frame: dict[str, Any], root: Path, file: Path) -> Photograph:
    """A frame as annotated, its camera still in the world of its sequence."""
    where = f"{file}: frame {frame['frame_number']} of sequence '{frame['sequence_name']}'"
    try:
        view, (height, width) = frame["viewpoint"], frame["image"]["size"]
        rotation, translation, focal, principal = (
            torch.tensor(view[key], dtype=torch.float64) for key in ("R", "T", "focal_length", "principal_point")
        )
        image, mask = root / frame["image"]["path"], root / frame["mask"]["path"]
        size = (int(width), int(height))
        form = view.get("intrinsics_format", "ndc_norm_image_bounds")
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        raise UserError(
            f"{where} needs image, mask and viewpoint with R, T, focal_length and principal_point "
            f"({type(error).__name__}: {error})"
        ) from error
    shapes = [list(each.shape) for each in (rotation, translation, focal, principal)]
    numbers = torch.cat([each.flatten() for each in (rotation, translation, focal, principal)])
    if shapes != [[3, 3], [3], [2], [2]] or not numbers.isfinite().all():
        raise UserError(f"{where} has no camera of finite numbers: R 3 x 3, T 3, focal_length 2, principal_point 2")
    skew = (rotation.mT @ rotation - torch.eye(3, dtype=torch.float64)).abs().max()
    if not (skew < 1e-3 and rotation.det() > 0):
        raise UserError(f"{where}: R is not a rotation")
    if not (focal > 0).all():
        raise UserError(f"{where}: focal_length must be positive, got {focal.tolist()}")
    if form not in FORMATS:
        raise UserError(f"{where}: intrinsics_format {form!r} is none of {', '.join(FORMATS)}")
    for found in (image, mask):
        if not found.is_file():
            raise UserError(f"{found}: there is no such file")
    return Photograph(
        image, mask, from_pytorch3d(rotation, translation), ndc_intrinsics(focal, principal, size, FORMATS[form]), size
    )


# ---------------------------------------------------------------- the object's frame


def _in_object_frame(photographs: list[Photograph], where: str) -> tuple[list[Photograph], Tensor, Counter[str]]:
    left_out: Counter[str] = Counter()
    whole, pixels = [], []
    for photograph in photographs:
        found = mask_pixels(photograph)
        if not len(found):
            left_out["with an empty mask"] += 1
        elif (found.min(axis=0) < 1).any() or (found.max(axis=0) > np.array(photograph.size) - 1).any():
            left_out["cut off by the image"] += 1
        else:
            whole.append(photograph)
            pixels.append(found)
    if len(whole) < 3:
        return [], torch.zeros(1, 3, dtype=torch.float64), left_out
    cameras = torch.stack([photograph.camera for photograph in whole])
    intrinsics = torch.stack([photograph.intrinsics for photograph in whole])
    try:
        frame = object_frame(cameras, intrinsics, pixels)
    except UserError as error:
        raise UserError(f"{where}: {error}") from error
    placed = frame.camera(cameras)
    corners = torch.cartesian_prod(*(torch.stack([-side, side]) / 2 for side in frame.sides))
    moved = [
        Photograph(each.file, each.mask, camera, each.intrinsics, each.size)
        for each, camera in zip(whole, placed, strict=True)
    ]
    return moved, corners, left_out


def mask_pixels(photograph: Photograph) -> NDArray[np.float64]:
    """Centres `[M, 2]` (x, y; pixels) of the outermost object pixels in each row and column of a photograph's mask."""
    mask = read_image(photograph.mask).convert("L")
    if mask.size != photograph.size:
        width, height = photograph.size
        raise UserError(
            f"{photograph.mask}: is {mask.width} x {mask.height} pixels, the photograph should be {width} x {height}"
        )
    inside = np.asarray(mask) >= HALF
    outline = inside & ~(
        np.pad(inside, 1)[1:-1, :-2] & np.pad(inside, 1)[1:-1, 2:]
        & np.pad(inside, 1)[:-2, 1:-1] & np.pad(inside, 1)[2:, 1:-1]
    )  # fmt: skip
    rows, columns = np.nonzero(outline)
    chosen = np.linspace(0, len(rows) - 1, min(len(rows), SAMPLES)).round().astype(int)
    return np.stack([columns[chosen], rows[chosen]], axis=-1) + 0.5


def object_frame(cameras: Tensor, intrinsics: Tensor, pixels: list[NDArray[np.float64]]) -> ObjectFrame:
    """The frame of an object from cameras `[V, 4, 4]` around it, intrinsics `[V, 3, 3]` and pixels `[M, 2]` of the
    outline of its silhouette in each photograph.

    Up is the direction to which the cameras' right axes are closest to perpendicular: photographers hold cameras level.
    The centre is the point nearest to the lines of sight through the middles of the silhouettes. The height is the
    median of the silhouettes' heights, the width nearly the largest of their widths (a 90 % quantile), both at the
    centre's distance. Raises `UserError` where the cameras do not go round the object.
    """
    right, up = cameras[:, :3, 0], cameras[:, :3, 1]
    spread, directions = torch.linalg.eigh(right.mT @ right / len(right))
    axis = directions[:, 0]
    if spread[1] < 0.02:
        raise UserError("its cameras do not go round the object, so which way is up cannot be told")
    axis = axis * torch.where((up @ axis).mean() < 0, -1.0, 1.0)
    first = torch.linalg.cross(axis, torch.eye(3, dtype=axis.dtype)[axis.abs().argmin()])
    first = first / first.norm()
    axes = torch.stack([first, axis, torch.linalg.cross(first, axis)])
    rays = [_rays(*each) for each in zip(axes @ cameras[:, :3, :3], intrinsics, pixels, strict=True)]
    places = cameras[:, :3, 3] @ axes.mT
    centre = _nearest_point(places, torch.stack([ray.mean(dim=0) for ray in rays]))
    for _ in range(3):  # the middle of a silhouette is that of a view towards the centre
        turned = camera_to_world(view_pose(rigid_transform(torch.eye(3, dtype=axis.dtype), places - centre)))[:, :3, :3]
        extents = torch.stack([_extent(ray @ turn) for ray, turn in zip(rays, turned, strict=True)])  # [V, 2, 2]
        middle = torch.cat([extents.mean(dim=1), -torch.ones(len(rays), 1, dtype=axis.dtype)], dim=-1)
        centre = _nearest_point(places, (turned @ middle[..., None]).squeeze(-1))
    distances = (places - centre).norm(dim=-1, keepdim=True)
    across, high = ((extents[:, 1] - extents[:, 0]) * distances).unbind(-1)
    sides = torch.stack([across.quantile(0.9), high.median(), across.quantile(0.9)])
    if not sides.max() > 0:
        raise UserError("its cameras stand in the object's centre")
    return ObjectFrame(axes, centre @ axes, sides.max(), sides / sides.max())


def _rays(rotation: Tensor, intrinsics: Tensor, pixels: NDArray[np.float64]) -> Tensor:
    """Directions `[M, 3]` of pixels `[M, 2]`, in the frame of `rotation` `[3, 3]` (camera to world, OpenGL axes)."""
    points = torch.from_numpy(np.concatenate([pixels, np.ones((len(pixels), 1))], axis=-1))
    seen = torch.linalg.solve(intrinsics, points.mT).mT * points.new_tensor([1.0, -1.0, -1.0])
    return seen @ rotation.mT


def _extent(seen: Tensor) -> Tensor:
    """Least and greatest tangent `[2, 2]` (x and y) of directions `[M, 3]` in a camera's axes."""
    tangents = seen[:, :2] / -seen[:, 2:]
    return torch.stack([tangents.amin(dim=0), tangents.amax(dim=0)])


def _nearest_point(places: Tensor, directions: Tensor) -> Tensor:
    """The point `[3]` with the least sum of squared distances from lines through `[V, 3]` along `[V, 3]`."""
    unit = torch.nn.functional.normalize(directions, dim=-1)
    across = torch.eye(3, dtype=unit.dtype) - unit[:, :, None] * unit[:, None, :]
    return torch.linalg.solve(across.sum(dim=0), (across @ places[..., None]).sum(dim=0).squeeze(-1))
