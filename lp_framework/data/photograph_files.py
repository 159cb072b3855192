"""Find the photographs of the object and their masks."""

from __future__ import annotations

import mimetypes
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

from lp_framework.errors import UserError

SUFFIXES = (
    ".bmp", ".gif", ".jfif", ".jp2", ".jpe", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tga", ".tif", ".tiff", ".webp",
    ".avif",
)  # fmt: skip
SHOWN = 5  # file names listed in a message
DYNAMIC = "dynamic_mask_"  # prefix of instant-ngp's masks, in which the background is *not* black


def photograph_files(images: str | Path | Sequence[str | Path] | None) -> list[Path]:
    """The image files of a folder, sorted naturally by name (2 before 10), or of a list, in its order, without those
    that are masks of others. `UserError` for fewer than two. Warns of unread files in the folder that may be
    photographs."""
    if images is None:
        raise UserError("images needs a value: a folder, or a list of files, images=[A.png,B.png]")
    if isinstance(images, str | Path):
        folder = Path(images)
        if not folder.is_dir():
            what = "is one image, but two or more are needed" if folder.exists() else "there is no such folder"
            raise UserError(f"images={folder}: {what}; give a list, images=[A.png,B.png], or a folder")
        found = _images_in(folder)
        if left_out := [file.name for file in sorted(folder.iterdir()) if file not in found and _may_show(file)]:
            hint = "save photographs as PNG or JPEG"
            warnings.warn(f"images={folder}: files that are not read: {listed(left_out)}; {hint}", stacklevel=2)
    else:
        found = [Path(str(image)) for image in images]
    masks = {(file.parent, stem) for file in found for stem in _mask_stems(file)[1:]}
    files = [file for file in found if (file.parent, file.stem) not in masks]
    if len(files) < 2:
        known = ", ".join(SUFFIXES)
        raise UserError(f"images={images}: two or more are needed, got {len(files)}; give a list or a folder ({known})")
    return files


def mask_files(files: Sequence[Path], folder: str | Path) -> list[Path | None]:
    """The mask in `folder` of every image, or None. The mask of `front.jpg` is called `front.png` (as in nerfstudio),
    `front.jpg.png` (COLMAP), `front_mask.png`, `front.mask.png` or `dynamic_mask_front.png` (instant-ngp); other
    suffixes are allowed. `UserError` if no image has a mask, or if an image has two."""
    folder = Path(folder)
    if not folder.is_dir():
        raise UserError(f"masks={folder}: there is no such folder")
    first: dict[str, Path] = {}
    for file in files:
        if first.setdefault(file.stem, file) != file:
            both = f"{first[file.stem]} and {file}"
            raise UserError(f"{both} have the same name, so {folder} cannot tell their masks apart")
    there = _images_in(folder)
    found = [_mask_among(there, file, _mask_stems(file)) for file in files]
    if not any(found):
        raise UserError(no_mask(files[0], folder))
    return found


def mask_beside(file: Path) -> Path | None:
    """The mask of an image where other programs put it: beside the image under one of those names, in a folder `masks`
    there or, if the image's folder is called `images`, in the folder `masks` next to it (nerfstudio)."""
    folder, stems = file.parent, _mask_stems(file)
    beside = folder.parent / "masks" if folder.name == "images" else folder / "masks"
    places = (folder, stems[1:]), (folder / "masks", stems), (beside, stems)
    masks = (_mask_among(_images_in(place), file, names) for place, names in places if place.is_dir())
    return next(filter(None, masks), None)


def _mask_stems(file: Path) -> list[str]:
    """Possible names of an image's masks, without suffix; the first is the image's own name."""
    others = [f"{file.stem}_mask", f"{file.stem}.mask", f"{DYNAMIC}{file.stem}"]
    return [file.stem, *others, *([file.name] if file.suffix else [])]


def _mask_among(masks: Sequence[Path], file: Path, stems: Sequence[str]) -> Path | None:
    found = [mask for mask in masks if mask.stem in stems and mask != file]
    if len(found) > 1:
        raise UserError(f"{found[0]} and {found[1]} are both masks of {file}")
    return found[0] if found else None


def no_mask(file: Path, folder: str | Path) -> str:
    """A message about an image without a mask in `folder`: what was expected and what was found."""
    names = [found.name for found in sorted(Path(folder).iterdir()) if found.name[0] != "."]
    there = listed(names) or "nothing"
    return f"{file}: has no mask; looked for {Path(folder) / file.stem}.png (or with another suffix), found {there}"


def _images_in(folder: Path) -> list[Path]:
    images = [file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and file.name[0] != "."]
    return sorted(images, key=as_counted)


def as_counted(file: Path) -> tuple[list[int | str], str]:
    """Key for natural sorting of names: `2.png` before `10.png`."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", file.stem)], file.name


def _may_show(file: Path) -> bool:
    """Whether an unread file may be a photograph: its type is unknown, or an image or video."""
    kind = mimetypes.guess_type(file.name)[0] or "unknown"
    return file.is_file() and file.name[0] != "." and kind.partition("/")[0] in ("unknown", "image", "video")


def listed(names: Sequence[str]) -> str:
    """The first few names, and how many more there are."""
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more
