"""Arrays computed once and memory-mapped afterwards: decoded views, features of frozen backbones.

An array lies in `<key>.npy` with a checksum in `<key>.json`, which is written last. A file that is cut short or
altered does not match its checksum and is made anew.
"""

from __future__ import annotations

import hashlib
import json
import os
import zlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from filelock import FileLock
from numpy.typing import DTypeLike, NDArray
from PIL import Image
from rich.console import Console
from rich.progress import track

from lp_framework.errors import UserError

T = TypeVar("T")
_CHUNK = 1 << 24  # bytes a checksum step


def cached_array(
    folder: str | Path, key: str, shape: Sequence[int], dtype: DTypeLike, fill: Callable[[NDArray], None]
) -> NDArray:
    """The array of a key, read-only and memory-mapped; `fill` computes it in place where it is missing or damaged."""
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / f"{key}.lock"):
            if not _intact(folder, key, shape, dtype):
                _write(folder, key, shape, dtype, fill)
    except OSError as error:
        raise UserError(f"{folder}: the cache cannot be written ({error.strerror}); set data.cache=FOLDER") from error
    return np.load(folder / f"{key}.npy", mmap_mode="r")


def _write(folder: Path, key: str, shape: Sequence[int], dtype: DTypeLike, fill: Callable[[NDArray], None]) -> None:
    partial, note = folder / f"{key}.partial.npy", folder / f"{key}.partial.json"
    try:
        array = np.lib.format.open_memmap(partial, mode="w+", dtype=dtype, shape=tuple(shape))
        _reserve(partial)
        fill(array)
        array.flush()
        note.write_text(json.dumps({"shape": list(shape), "dtype": np.dtype(dtype).str, "checksum": _checksum(array)}))
        del array
        (folder / f"{key}.json").unlink(missing_ok=True)
        os.replace(partial, folder / f"{key}.npy")
        os.replace(note, folder / f"{key}.json")
    finally:
        partial.unlink(missing_ok=True)
        note.unlink(missing_ok=True)


def _reserve(file: Path) -> None:
    """Give a sparse file its disk space: where a mapped page finds the disk full, the process dies of a SIGBUS."""
    if hasattr(os, "posix_fallocate"):  # not on macOS
        with file.open("r+b") as opened:
            os.posix_fallocate(opened.fileno(), 0, file.stat().st_size)


def _intact(folder: Path, key: str, shape: Sequence[int], dtype: DTypeLike) -> bool:
    try:
        record = json.loads((folder / f"{key}.json").read_text())
        array = np.load(folder / f"{key}.npy", mmap_mode="r")
        expected = list(shape) == record["shape"] == list(array.shape) and np.dtype(dtype) == array.dtype
        return bool(expected) and _checksum(array) == record["checksum"]
    except Exception:  # damaged files raise anything from EOFError to SyntaxError
        return False


def _checksum(array: NDArray) -> int:
    flat = array.reshape(-1).view(np.uint8)
    checksum = 0
    for start in range(0, len(flat), _CHUNK):
        checksum = zlib.crc32(flat[start : start + _CHUNK].data, checksum)
    return checksum


def tracked(items: Sequence[T], description: str) -> Iterable[T]:
    """The items, with a progress bar on the terminal while they last; nothing is printed elsewhere."""
    console = Console(stderr=True)
    return track(items, description, console=console, transient=True, disable=not console.is_terminal)


def content_key(files: Iterable[Path], *facts: object) -> str:
    """A key for what is computed from the bytes of `files`, in their order, and from `facts`."""
    digest = hashlib.blake2b(repr(facts).encode(), digest_size=16)
    for file in files:
        try:
            digest.update(hashlib.blake2b(file.read_bytes()).digest())
        except OSError as error:
            raise UserError(f"{file}: cannot be read ({error.strerror})") from error
    return digest.hexdigest()


def decoded_views(files: Sequence[Path], size: int, folder: str | Path) -> tuple[str, NDArray]:
    """Key and array `[N, size, size, 3]` (uint8) of image files, composed over white and resized; decoded once.

    Raises `UserError` naming the file for an image that does not decode, is not square, or differs in size from the
    others of its folder.
    """
    key = content_key(files, "views", size)

    def fill(array: NDArray) -> None:
        sizes: dict[Path, tuple[int, int]] = {}
        for index, file in enumerate(tracked(files, "decoding views")):
            image = _decode(file)
            expected = sizes.setdefault(file.parent, image.size)
            if image.size != expected:
                raise UserError(
                    f"{file}: is {image.width} x {image.height} pixels, the other images of its folder are "
                    f"{expected[0]} x {expected[1]}"
                )
            array[index] = np.asarray(image.resize((size, size), Image.Resampling.BOX, reducing_gap=None))

    return key, cached_array(folder, key, (len(files), size, size, 3), np.uint8, fill)


def _decode(file: Path) -> Image.Image:
    """An image file over white, as RGB; square or a `UserError`."""
    try:
        with Image.open(file) as image:
            rgba = image.convert("RGBA")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise UserError(f"{file}: is not a readable image ({error})") from error
    if rgba.width != rgba.height:
        raise UserError(f"{file}: is {rgba.width} x {rgba.height} pixels; views must be square")
    white = Image.new("RGBA", rgba.size, "white")
    white.alpha_composite(rgba)
    return white.convert("RGB")
