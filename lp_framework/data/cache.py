"""Arrays computed once and memory-mapped afterwards: decoded views, features of frozen backbones.

An array lies in `<key>.npy` with a checksum in `<key>.json`, which is written last. A file that is cut short or
altered does not match its checksum and is made anew.
"""

from __future__ import annotations

import hashlib
import json
import os
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from filelock import FileLock
from numpy.typing import NDArray
from PIL import Image
from rich.console import Console
from rich.progress import track

from lp_framework.atomic import reason
from lp_framework.data.images import eight_bit
from lp_framework.data.photographs import on_white, opened, prepare
from lp_framework.data.views import DEPTH_UNIT
from lp_framework.errors import UserError

T = TypeVar("T")


def cached_array(folder: str | Path, key: str, count: int, blocks: Callable[[], Iterable[NDArray]]) -> NDArray:
    """The array `[count, ...]` of a key, read-only and memory-mapped; where it is missing or damaged, it is made
    from `blocks`, which are `[n, ...]` of any one shape and type."""
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / f"{key}.lock"):
            if not _intact(folder, key, count):
                _write(folder, key, count, blocks())
    except OSError as error:
        why = reason(error, folder)
        raise UserError(f"{folder}: the cache cannot be written ({why}); set data.cache=FOLDER") from error
    return np.load(folder / f"{key}.npy", mmap_mode="r")


def _write(folder: Path, key: str, count: int, blocks: Iterable[NDArray]) -> None:
    partial, note = folder / f"{key}.partial.npy", folder / f"{key}.partial.json"
    array, place = None, 0
    try:
        for block in blocks:
            if array is None:
                shape = (count, *block.shape[1:])
                array = np.lib.format.open_memmap(partial, mode="w+", dtype=block.dtype, shape=shape)
                if hasattr(os, "posix_fallocate"):  # not on macOS; a mapped page that finds the disk full is a SIGBUS
                    with partial.open("r+b") as file:
                        os.posix_fallocate(file.fileno(), 0, partial.stat().st_size)
            array[place : place + len(block)] = block
            place += len(block)
        if array is None or place != count:
            raise ValueError(f"the blocks of {key} have {place} rows, {count} are wanted")
        array.flush()
        note.write_text(json.dumps({"shape": array.shape, "dtype": array.dtype.str, "checksum": _checksum(array)}))
        del array
        (folder / f"{key}.json").unlink(missing_ok=True)
        os.replace(partial, folder / f"{key}.npy")
        os.replace(note, folder / f"{key}.json")
    finally:
        partial.unlink(missing_ok=True)
        note.unlink(missing_ok=True)


def _intact(folder: Path, key: str, count: int) -> bool:
    try:
        record = json.loads((folder / f"{key}.json").read_text())
        array = np.load(folder / f"{key}.npy", mmap_mode="r")
        expected = record["shape"] == list(array.shape) and record["dtype"] == array.dtype.str and len(array) == count
        return bool(expected) and _checksum(array) == record["checksum"]
    except Exception:  # damaged files raise anything from EOFError to SyntaxError
        return False


def _checksum(array: NDArray) -> int:
    return zlib.crc32(array.reshape(-1).view(np.uint8).data)


def tracked(items: Iterable[T], description: str, total: int | None = None) -> Iterable[T]:
    """The items, with a progress bar on the terminal while they last; nothing is printed elsewhere."""
    console = Console(stderr=True)
    return track(items, description, total, console=console, transient=True, disable=not console.is_terminal)


def content_key(files: Iterable[Path], *facts: object) -> str:
    """A key for what is computed from the bytes of `files`, in their order, and from `facts`."""
    digest = hashlib.blake2b(repr(facts).encode(), digest_size=16)
    for file in files:
        try:
            digest.update(hashlib.blake2b(file.read_bytes()).digest())
        except OSError as error:
            raise UserError(f"{file}: cannot be read ({error.strerror})") from error
    return digest.hexdigest()


def decoded_views(files: Sequence[Path], size: int, folder: str | Path, crop: bool = False) -> tuple[str, NDArray]:
    """Key and array `[N, size, size, 3]` (uint8) of image files, composed over white and resized; decoded once. With
    `crop` the object is centred and scaled as that of a photograph, by the alpha channel (see `prepare`).

    `UserError` for an image that does not decode, is not square, or differs in size from the others of its folder."""

    def decode(image: Image.Image) -> NDArray:
        called = str(getattr(image, "filename", "a view"))
        return pixels_on_white(prepare(eight_bit(image).convert("RGBA"), called) if crop else image, size)

    key = content_key(files, "crops" if crop else "views", size)
    return key, cached_array(folder, key, len(files), lambda: _decoded(files, decode, "decoding views"))


def pixels_on_white(image: Image.Image, size: int) -> NDArray[np.uint8]:
    """Pixels `[size, size, 3]` of a view, composed over white and resized."""
    white = Image.fromarray(on_white(eight_bit(image).convert("RGBA")))
    return np.asarray(white.resize((size, size), Image.Resampling.BOX))


def decoded_alpha(files: Sequence[Path], size: int, folder: str | Path, views: str) -> NDArray:
    """The opacity `[N, size, size]` (uint8) of image files, resized as `decoded_views` does, whose key is `views`."""

    def decode(image: Image.Image) -> NDArray:
        return np.asarray(eight_bit(image).convert("RGBA").getchannel("A").resize((size, size), Image.Resampling.BOX))

    key = content_key([], "alpha", views)
    return cached_array(folder, key, len(files), lambda: _decoded(files, decode, "decoding alpha"))


def depth_files(files: Sequence[Path]) -> list[Path]:
    """The depths that belong to image files; `UserError` where a view has none."""
    depths = [file.parents[1] / "depth" / file.name for file in files]
    if missing := [file for file in depths if not file.is_file()]:
        raise UserError(f"{missing[0]}: there is no such file; views rendered with data.depth=true have depths")
    return depths


def decoded_depths(files: Sequence[Path], size: int, folder: str | Path) -> NDArray:
    """The depths `[N, size, size]` (float32) that belong to image files (see `views`): along the optical axis, in scene
    units, 0 where there is nothing; of the sample nearest to each pixel. `UserError` where a view has none."""
    depths = depth_files(files)

    def decode(image: Image.Image) -> NDArray:
        return scene_depth(image.resize((size, size), Image.Resampling.NEAREST))

    key = content_key(depths, "depths", size)
    return cached_array(folder, key, len(depths), lambda: _decoded(depths, decode, "decoding depths"))


def scene_depth(image: Image.Image) -> NDArray[np.float32]:
    """Depths `[H, W]` in scene units of an image of their levels."""
    return np.asarray(image).astype(np.float32) * np.float32(DEPTH_UNIT)


def _decoded(files: Sequence[Path], decode: Callable[[Image.Image], NDArray], description: str) -> Iterator[NDArray]:
    """What `decode` makes of every image file, `[1, ...]` each; `UserError` naming one that is not as it should be."""
    sizes: dict[Path, tuple[int, int]] = {}
    for file in tracked(files, description):
        with opened(file) as image:
            told = f"{file}: is {image.width} x {image.height} pixels"
            if image.width != image.height:
                raise UserError(f"{told}; views must be square")
            width, height = sizes.setdefault(file.parent, image.size)
            if image.size != (width, height):
                raise UserError(f"{told}, the other images of its folder are {width} x {height}")
            block = decode(image)[None]
        yield block
