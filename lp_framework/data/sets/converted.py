"""Photographs with cameras, converted once into views on disk and then used like rendered views.

They become crops around the object (see `real_cameras`) with evenly spread viewpoints. `conversion.json` beside an
object's views records the settings, the source files, and what was left out.

In addition to the usual `transform.json` fields, a frame stores its photograph (`source`, `width`, `height`), its
camera (`photograph_camera`, in the object's frame, and `photograph_intrinsics`, pixels), the `turn_degrees` and
`crop_angle_degrees` of its crop, and its `perspective_residual`.
"""

from __future__ import annotations

import json
import math
import os
import warnings
from abc import abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from lp_framework.atomic import DiskFull
from lp_framework.data import real_cameras
from lp_framework.data.cache import tracked
from lp_framework.data.files import LIST, Origin, differences, locked, raise_failures, read_record, written_folder
from lp_framework.data.masks import HALF, mask_opacity
from lp_framework.data.photographs import read_image, read_mask
from lp_framework.data.views import ViewSource, write_transforms
from lp_framework.errors import UserError, check_settings
from lp_framework.geometry import is_rotation, to_ifusion, view_pose
from lp_framework.keyed_random import stable_id

RECORD = "conversion.json"
LARGEST_PERSPECTIVE = 0.25  # of the image's side; views whose crop differs more from a spherical camera's are left out
NEAREST = 1.0  # units of the object's longest side; nearer cameras are left out


@dataclass(frozen=True)
class Photograph:
    """A photograph of an object: its file, mask file, camera `[4, 4]` (camera to world, OpenGL axes, float64) in the
    object's frame (see `real_cameras`), intrinsics `[3, 3]` in pixels and size (width, height)."""

    file: Path
    mask: Path
    camera: Tensor
    intrinsics: Tensor
    size: tuple[int, int]

    def __post_init__(self) -> None:
        if not is_rotation(self.camera[:3, :3]):
            raise ValueError("the rotation of its camera is not a rotation")
        if not (self.intrinsics.diagonal()[:2] > 0).all():
            raise ValueError("its focal lengths must be positive")

    def colours(self) -> Image.Image:
        """The photograph in RGB; `UserError` if it cannot be read or has another size."""
        return self._of_size(self.file, read_image(self.file)).convert("RGB")

    def opacity(self) -> Image.Image:
        """The opacity from its mask ("L"), opaque if the mask has no background; `UserError` as for `colours`."""
        mask = self._of_size(self.mask, read_mask(self.mask))
        return mask_opacity(mask, str(self.file)) or Image.new("L", self.size, 255)

    def _of_size(self, file: Path, image: Image.Image) -> Image.Image:
        if image.size != self.size:
            (width, height), (wide, high) = image.size, self.size
            raise UserError(f"{file}: is {width} x {height} pixels, but the photograph should be {wide} x {high}")
        return image


class Annotated(NamedTuple):
    """A data set's information about an object: photographs, `points` `[P, 3]` on its bounding box, the number of
    photographs left out for each reason, and further entries of `conversion.json`."""

    photographs: list[Photograph]
    points: Tensor
    left_out: Counter[str]
    remarks: dict[str, Any]


class ConvertedSource(ViewSource):
    """Views in `path`, converted on first use from those of a download, whose folder is never written to."""

    download: Path

    @abstractmethod
    def convert(self, name: str, folder: Path) -> tuple[list[Path], dict[str, Any]]:
        """Write an object's views into a folder; returns the source files, and entries to record in addition to these
        and `demands`."""

    def demands(self) -> dict[str, Any]:
        """The settings that determine an object's views, as plain values."""
        return {"source": self.download.resolve().name}

    def prepare(self) -> None:
        """Convert missing objects one by one; one `UserError` at the end lists those that failed."""
        failures: dict[str, str] = {}
        with locked(self.path, ".convert.lock"):
            objects = self.names()
            missing = [name for name in objects if not is_converted(self.path / name, self.demands(), self.download)]
            for name in tracked(missing, "converting photographs"):
                try:
                    self._write(name)
                except DiskFull:
                    raise
                except UserError as error:
                    failures[name] = str(error)
        listed = self.path / LIST
        how = f"; repair them, or remove their names from {listed}" if listed.is_file() else ""
        raise_failures(failures, len(objects), f"converted{how}")

    def _write(self, name: str) -> None:
        folder = self.path / name
        if folder.exists():
            others = f"holds views that were made from other files or settings (see its {RECORD})"
            raise UserError(f"{folder}: {others}; choose another data.views or delete it")
        with written_folder(folder) as partial:
            files, record = self.convert(name, partial)
            made = {"files": [os.path.relpath(file, self.download) for file in files], "origin": Origin(files).record()}
            (partial / RECORD).write_text(json.dumps({"object": name, **self.demands(), **record, **made}, indent=1))


def is_converted(folder: Path, demands: Mapping[str, Any], download: Path) -> bool:
    """Whether a folder holds an object's views that match `demands` and, if the download is available and the record
    names them, were made from its current files."""
    record = read_record(folder / RECORD)
    names = record.get("files")
    if not record or differences(record, demands):
        return False
    if not isinstance(names, list) or not download.is_dir():  # an older record, or nothing to compare with
        return True
    files = [download / str(name) for name in names]
    return all(map(os.path.isfile, files)) and Origin(files).is_of(record.get("origin"))


def frame(file: str, camera: Tensor) -> dict[str, Any]:
    """The `transform.json` entry of a view with an image file and a camera `[4, 4]`."""
    latlon = to_ifusion(view_pose(camera)).tolist()
    return {"file_path": file, "transform_matrix": camera.tolist(), "latlon": latlon}


class PhotographedData(ConvertedSource):
    """Object-centric crops of photographs with cameras: a number of views per object, chosen with `split_seed`."""

    def __init__(
        self,
        path: str,
        views: str,
        train_views: int,
        test_views: int,
        resolution: int,
        split_seed: int,
        objects: str | Sequence[str] | None,
    ) -> None:
        check_settings(
            "data",
            ("train_views", train_views, train_views >= 2, "at least 2"),
            ("test_views", test_views, test_views >= 2, "at least 2"),
            ("resolution", resolution, resolution >= 16, "at least 16"),
        )
        self.download, self.path = Path(path), Path(views)
        self.train_views, self.test_views = train_views, test_views
        self.resolution, self.split_seed, self.wanted = resolution, split_seed, objects

    @abstractmethod
    def photographs(self, name: str) -> Annotated:
        """The photographs and extent of an object, in the object's frame."""

    @abstractmethod
    def annotations(self, name: str) -> list[Path]:
        """The annotation files that `photographs` uses for an object."""

    def demands(self) -> dict[str, Any]:
        names = ("train_views", "test_views", "resolution", "split_seed")
        return {**super().demands(), **{name: getattr(self, name) for name in names}}

    def convert(self, name: str, folder: Path) -> tuple[list[Path], dict[str, Any]]:
        photographs, points, left_out, remarks = self.photographs(name)
        views, more = sound_views(photographs, points)
        left_out += more
        wanted, where = self.train_views + self.test_views, f"{self.download}: object '{name}'"
        reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(left_out.items()))
        if len(views) < wanted:
            without = f" ({reasons} are left out)" if reasons else ""
            asked = f"data.train_views={self.train_views} and data.test_views={self.test_views} ask for {wanted}"
            raise UserError(f"{where} has {len(views)} usable views{without}, but {asked}")
        if reasons:
            warnings.warn(f"{where}: {reasons} are left out", stacklevel=2)
        places = torch.stack([view.photograph.camera[:3, 3] for view in views])
        directions = torch.nn.functional.normalize(places, dim=-1).numpy()
        random = np.random.default_rng([self.split_seed, stable_id(name)])
        chosen = spread(directions, wanted, random)
        test = np.sort(random.choice(chosen, self.test_views, replace=False))
        for split, indices in {"train": np.setdiff1d(chosen, test), "test": test}.items():
            (folder / split / "rgb").mkdir(parents=True)
            frames = []
            for number, index in enumerate(indices):
                file = f"{number:03d}.png"
                crop(views[index], self.resolution).save(folder / split / "rgb" / file, compress_level=1)
                frames.append(self._frame(file, views[index]))
            write_transforms(folder / split, frames)
        taken, _, turns, residuals = zip(*(views[index] for index in chosen), strict=True)
        files = [file for photograph in taken for file in (photograph.file, photograph.mask)]
        return [*self.annotations(name), *files], {
            **remarks,
            "left_out": dict(left_out),
            "median_perspective_residual": float(np.median(residuals)),
            "largest_perspective_residual": max(residuals),
            "largest_turn_degrees": max(turns),
        }

    def _frame(self, file: str, view: SphericalView) -> dict[str, Any]:
        photograph, radius = view.photograph, view.radius
        angle = real_cameras.crop_field_of_view(photograph.camera[:3, 3].norm(), radius)
        return {
            **frame(file, real_cameras.spherical_camera(photograph.camera, radius)),
            "source": os.path.relpath(photograph.file, self.download),
            "width": photograph.size[0],
            "height": photograph.size[1],
            "photograph_camera": photograph.camera.tolist(),
            "photograph_intrinsics": photograph.intrinsics.tolist(),
            "turn_degrees": view.turn,
            "crop_angle_degrees": math.degrees(angle.item()),
            "perspective_residual": view.residual,
        }


class SphericalView(NamedTuple):
    """A photograph with the effective radius of its crop (units of the object's longest side), the angle of its virtual
    turn (degrees) and its perspective residual (units of the image's side)."""

    photograph: Photograph
    radius: Tensor
    turn: float
    residual: float


def sound_views(photographs: Sequence[Photograph], points: Tensor) -> tuple[list[SphericalView], Counter[str]]:
    """The views of an object that are close enough to a spherical camera's, and the number of others by reason;
    `points` `[P, 3]` are on its bounding box."""
    if not photographs:
        return [], Counter()
    cameras = torch.stack([photograph.camera for photograph in photographs])
    distances = cameras[:, :3, 3].norm(dim=-1)
    radii = real_cameras.effective_radii(distances)
    residuals = real_cameras.perspective_residual(cameras, radii, points)
    _, turns = real_cameras.turn_towards_centre(cameras)
    near, distorted = distances < NEAREST, ~(residuals <= LARGEST_PERSPECTIVE)
    left_out = Counter(
        {
            "nearer than the object is long": int(near.sum()),
            "with too strong a perspective": int((distorted & ~near).sum()),
        }
    )
    views = map(SphericalView, photographs, radii, turns.tolist(), residuals.tolist())
    return [view for view, wrong in zip(views, near | distorted, strict=True) if not wrong], +left_out


def spread(directions: NDArray[np.floating], count: int, random: np.random.Generator) -> NDArray[np.int64]:
    """Indices `[count]` of evenly spread unit vectors `[V, 3]`: a random one, then repeatedly the one farthest from
    those already chosen (farthest-point sampling)."""
    chosen = [int(random.integers(len(directions)))]
    nearest = directions @ directions[chosen[0]]
    while len(chosen) < count:
        nearest[chosen] = np.inf
        chosen.append(int(nearest.argmin()))
        nearest = np.maximum(nearest, directions @ directions[chosen[-1]])
    return np.array(chosen)


def crop(view: SphericalView, size: int) -> Image.Image:
    """The object-centric crop of a photograph, RGBA of `size` pixels per side, transparent where the mask is dark and
    outside the photograph."""
    photograph = view.photograph
    cut = photograph.colours()
    cut.putalpha(photograph.opacity())
    homography = real_cameras.crop_homography(photograph.camera, photograph.intrinsics, view.radius, size)
    # Where the crop shrinks the photograph, render it larger first and then average to avoid aliasing: by the width,
    # in pixels of the photograph, of the crop's central pixel.
    middle = torch.tensor([[size / 2, size / 2, 1.0], [size / 2 + 1, size / 2, 1.0]], dtype=torch.float64)
    seen = middle @ homography.mT
    larger = max(1, math.ceil((seen[1, :2] / seen[1, 2] - seen[0, :2] / seen[0, 2]).norm().item() - 0.05))
    homography = homography / torch.tensor([larger, larger, 1.0], dtype=torch.float64)
    coefficients = (homography / homography[2, 2]).flatten()[:8].tolist()
    sides = (size * larger, size * larger)
    warped = cut.transform(sides, Image.Transform.PERSPECTIVE, coefficients, Image.Resampling.BICUBIC).reduce(larger)
    pixels = np.array(warped)
    if not (pixels[..., 3] >= HALF).any():
        raise UserError(f"{photograph.mask}: marks nothing where the annotation has the object")
    pixels[pixels[..., 3] == 0] = 0
    return Image.fromarray(pixels)
