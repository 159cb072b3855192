"""Photographs of one object, prepared as the priors and models expect: upright, cut out, centred, square, on white.

A mask file, the image's own alpha channel or a generated mask (see `data.masks`) marks the object. The crop is that of
Zero123's demo (`load_and_preprocess`): the object's bounding box is centred and its longest side scaled to 200 of the
image's 256 pixels. Pixels less than half opaque are background, as in the code of iFusion and ID-Pose.

The prepared image approximates that of a *virtual* camera with the priors' field of view at the same viewpoint, turned
towards the object's centre and moved until the object fills that fraction of the frame. Latitude and longitude are
therefore the photograph's; distance and focal length are lost, and a relative radius compares two virtual cameras.
"""

from __future__ import annotations

import logging
import math
import numbers
import shutil
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import ExifTags, Image, ImageOps

from lp_framework.atomic import written
from lp_framework.data.files import expecting
from lp_framework.data.images import eight_bit
from lp_framework.data.masks import HALF, alpha_opacity, mask_maker, mask_opacity, without_strays
from lp_framework.data.photograph_files import DYNAMIC, listed, mask_beside, mask_files, no_mask
from lp_framework.errors import UserError

log = logging.getLogger(__name__)

SIZE, EXTENT = 256, 200  # pixels a side of a prepared image, and of the object's longest side in it
SMALLEST = 16  # pixels; a smaller object shows too little detail
CUT_OFF = 0.1  # of the object's longest side: more along the border means that the object is cut off
EMPTY = "its mask is empty: none of it is at least half opaque"
FULL_FRAME = math.hypot(36, 24)  # mm: the diagonal of 35 mm film
RESOLUTION_UNITS = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # mm, by EXIF's FocalPlaneResolutionUnit

Box = tuple[int, int, int, int]  # left, top, right, bottom


@contextmanager
def opened(file: str | Path) -> Iterator[Image.Image]:
    """Open an image file, reading only its header; `UserError` naming the file if it cannot be read."""
    if Path(file).is_dir():
        raise UserError(f"{file}: is a folder; give an image file")
    with expecting(f"{file}: is not a readable image"), Image.open(file) as image:
        yield image


def read_mask(file: str | Path) -> Image.Image:
    """Read a mask file and apply its EXIF orientation: as RGB or RGBA, or the raw values (see `masks.mask_opacity`);
    instant-ngp's masks are inverted. `UserError` naming the file if it cannot be read."""
    with opened(file) as opened_mask:
        mask = ImageOps.exif_transpose(opened_mask)
        if Path(file).name.startswith(DYNAMIC):
            return Image.fromarray(~np.asarray(mask.convert("RGB")).any(axis=2))
        if mask.mode[0] not in "IF":
            return mask.convert("RGBA" if mask.has_transparency_data else "RGB")
        mask.load()
        return mask


def read_image(file: str | Path) -> Image.Image:
    """Read an image file as `upright` returns it; `UserError` naming the file if it cannot be read."""
    with opened(file) as image:
        return upright(image)


def upright(image: Image.Image) -> Image.Image:
    """Convert an image of any mode to 8 bits and apply its EXIF orientation: RGBA if it has transparency, else RGB.
    Raises `ValueError` for a mode whose white level is unknown (floating point)."""
    image = eight_bit(ImageOps.exif_transpose(image))
    return image.convert("RGBA" if image.has_transparency_data else "RGB")


def exif_focal(image: Image.Image) -> float | None:
    """The focal length in pixels from the EXIF data of an image with square pixels, None if unknown: from the 35 mm
    equivalent, with the film's diagonal as the image's (CIPA DCG-001), or from the sensor's pixels."""
    try:
        exif = image.getexif().get_ifd(ExifTags.IFD.Exif)
    except Exception:  # damaged data, for which Pillow raises any exception
        return None

    def number(tag: ExifTags.Base) -> float:
        value = exif.get(tag)
        told = float(value) if isinstance(value, numbers.Real) else 0.0
        return told if 0 < told < math.inf else 0.0

    if film := number(ExifTags.Base.FocalLengthIn35mmFilm):
        return film / FULL_FRAME * math.hypot(*image.size)
    unit = RESOLUTION_UNITS.get(exif.get(ExifTags.Base.FocalPlaneResolutionUnit, 2), 25.4)
    pixels = number(ExifTags.Base.FocalLength) * number(ExifTags.Base.FocalPlaneXResolution) / unit
    recorded = max(number(ExifTags.Base.ExifImageWidth), number(ExifTags.Base.ExifImageHeight))  # before any resizing
    return pixels * max(image.size) / (recorded or max(image.size)) or None


def save_upright(file: Path, copy: Path) -> None:
    """Copy an image file. If it has an EXIF orientation, which most programs ignore, apply it and drop the EXIF
    data."""
    with opened(file) as image, written(copy) as partial:
        if image.getexif().get(ExifTags.Base.Orientation, 1) == 1:
            shutil.copyfile(file, partial)
        else:
            profile = image.info.get("icc_profile")
            ImageOps.exif_transpose(image).save(partial, image.format, quality=95, icc_profile=profile)


def array_image(array: ArrayLike, name: str) -> Image.Image:
    """Convert an array `[H, W, 3 | 4]`, uint8 or floats in [0, 1], to an image."""
    values: NDArray[Any] = np.asarray(array)
    if values.ndim != 3 or values.shape[2] not in (3, 4) or not values.size:
        raise UserError(f"{name} must be [H, W, 3] or [H, W, 4], got {list(values.shape)}")
    if values.dtype != np.uint8:
        if not (np.issubdtype(values.dtype, np.floating) and values.min() >= 0 and values.max() <= 1):
            raise UserError(f"{name} must be uint8, or floats in [0, 1], got {values.dtype}")
        values = np.rint(values * 255).astype(np.uint8)
    return Image.fromarray(values)


def cut_out(
    image: Image.Image,
    name: str,
    mask: Image.Image | None = None,
    remove_background: bool = False,
    required: bool = True,
) -> Image.Image:
    """Convert an image to RGBA with a transparent background: from `mask` if given, else the alpha channel, else with
    `remove_background` a generated mask.

    `UserError`, which calls the image `name`, for a mask of another size or without background. If none of the three is
    available, `UserError` if `required`, else the whole image stays opaque.
    """
    opacity = None
    if mask is not None:
        if mask.size != image.size:
            sides = f"{image.width} x {image.height} pixels but its mask is {mask.width} x {mask.height}"
            raise UserError(f"{name}: is {sides}")
        opacity = mask_opacity(mask, name)
        if opacity is None:
            raise UserError(f"{name}: its mask marks no background, which must be black")
    elif image.mode == "RGBA":
        opacity = alpha_opacity(image.getchannel("A"))
    if opacity is None and remove_background:
        opacity = alpha_opacity(made_mask(image, name))
    if opacity is None and required:
        raise UserError(
            f"{name}: has no transparent background (alpha channel) and no mask; give masks=FOLDER or "
            "remove_background=true, or crop=false if it shows the object on white already"
        )
    result = image.convert("RGB")
    result.putalpha(255 if opacity is None else opacity)
    return result


def made_mask(image: Image.Image, name: str) -> Image.Image:
    """Generate a mask ("L") of an image's object, see `data.masks`; `UserError` if no background is found."""
    maker = mask_maker()
    mask = maker.mask(image.convert("RGB"))
    if alpha_opacity(mask) is None:
        raise UserError(f"{name}: {maker.name} found no background in it; give a mask")
    return mask


class Prepared(NamedTuple):
    """A prepared image, and the object's bounding box in the image before cropping, None without a crop."""

    image: Image.Image
    box: Box | None


def crop_to_object(image: Image.Image, name: str) -> Prepared:
    """Crop to RGBA of `SIZE` pixels a side with the object centred, its longest side `EXTENT` pixels (see the module);
    stray parts far from the object are removed."""
    opacity = without_strays(image.getchannel("A"), name)
    opaque = np.asarray(opacity) >= HALF
    box = Image.fromarray(opaque).getbbox()
    if box is None:
        most = int(np.asarray(opacity).max())
        empty = f"none of its mask is at least half opaque (at most {most / 255:.0%})" if most else EMPTY
        raise UserError(f"{name}: {empty}")
    left, top, right, bottom = box
    longest = max(right - left, bottom - top)
    if longest < SMALLEST:
        raise UserError(f"{name}: the object is {longest} pixels long, but at least {SMALLEST} are needed")
    border = (opaque[0], opaque[-1], opaque[:, 0], opaque[:, -1])
    if all(line.all() for line in border):
        log.warning("%s: the whole image border counts as the object; a mask must be white on the object", name)
    elif max(int(line.sum()) for line in border) > CUT_OFF * longest:
        log.warning("%s: the image border seems to cut off the object; all of it should be in the picture", name)
    side = longest * SIZE / EXTENT
    corners = np.array([left + right - side, top + bottom - side, left + right + side, top + bottom + side]) / 2
    whole = (*(math.floor(corner) for corner in corners[:2]), *(math.ceil(corner) for corner in corners[2:]))
    x0, y0, x1, y1 = (corners - np.tile(whole[:2], 2)).tolist()
    image = image.copy()
    image.putalpha(opacity)
    return Prepared(image.crop(whole).resize((SIZE, SIZE), Image.Resampling.LANCZOS, box=(x0, y0, x1, y1)), box)


def prepare(
    image: Image.Image, name: str, mask: Image.Image | None = None, remove_background: bool = False, crop: bool = True
) -> Image.Image:
    """Prepare an image as RGBA of `SIZE` pixels a side, by `cut_out` and `crop_to_object`. Without `crop`, resize the
    whole image, which must be square; without a background it must show the object on white."""
    if crop:
        return crop_to_object(cut_out(image, name, mask, remove_background), name).image
    if image.width != image.height:
        raise UserError(f"{name}: is {image.width} x {image.height} pixels; with crop=false an image must be square")
    whole = cut_out(image, name, mask, remove_background, required=False)
    return whole.resize((SIZE, SIZE), Image.Resampling.LANCZOS)


class Photograph(NamedTuple):
    """An image that was read, its mask, if any, and whether that mask was generated."""

    name: str
    image: Image.Image
    mask: Image.Image | None
    made: bool

    def prepared(self, crop: bool) -> Prepared:
        """Prepare the photograph, see `prepare`."""
        if crop:
            return crop_to_object(cut_out(self.image, self.name, self.mask), self.name)
        return Prepared(prepare(self.image, self.name, self.mask, crop=False), None)


def read_photographs(
    files: Sequence[Path], masks: str | Path | None, remove_background: bool, crop: bool
) -> list[Photograph]:
    """Read image files and their masks: from the folder `masks`; without it, from `mask_beside` for images without
    alpha channel; with `remove_background`, generated for images that have neither. All images are read before masks
    are generated."""
    for name, value in (("remove_background", remove_background), ("crop", crop)):
        if not isinstance(value, bool):
            raise UserError(f"{name} must be true or false, got {value}")
    found = mask_files(files, masks) if masks is not None else [None] * len(files)
    images = [read_image(file) for file in files]
    marks = [image.mode == "RGBA" and alpha_opacity(image.getchannel("A")) is not None for image in images]
    if masks is None:
        found = [None if marked else mask_beside(file) for file, marked in zip(files, marks, strict=True)]
        if beside := [mask.name for mask in found if mask is not None]:
            log.info("using the masks beside the photographs: %s", listed(beside))
    given = [None if mask is None else read_mask(mask) for mask in found]
    read = []
    for file, image, mask, marked in zip(files, images, given, marks, strict=True):
        if masks is not None and mask is None:
            if crop and not marked and not remove_background:
                raise UserError(no_mask(file, masks))
            instead = "alpha channel" if marked else "made mask" if remove_background else "whole picture"
            warnings.warn(f"{no_mask(file, masks)}; its {instead} is used", stacklevel=2)
        made = remove_background and mask is None and not marked
        read.append(Photograph(str(file), image, made_mask(image, str(file)) if made else mask, made))
    return read


def prepared_photographs(
    files: Sequence[Path], masks: str | Path | None, remove_background: bool, crop: bool
) -> list[Image.Image]:
    """Read and `prepare` image files; see `read_photographs`."""
    return [each.prepared(crop).image for each in read_photographs(files, masks, remove_background, crop)]


def on_white(image: Image.Image) -> NDArray[np.uint8]:
    """Compose an RGBA image over white: pixels `[H, W, 3]`."""
    white = Image.new("RGBA", image.size, "white")
    return np.asarray(Image.alpha_composite(white, image).convert("RGB"))


def save_png(path: Path, image: Image.Image) -> None:
    """Write a PNG file atomically."""
    with written(path) as partial:
        image.save(partial, "PNG")
