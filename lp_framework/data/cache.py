"""Arrays computed once and memory-mapped afterwards: decoded views, features of frozen backbones.

An array is stored in `<key>.npy`, with a checksum in `<key>.json`, which is written last. A truncated or altered file
does not match its checksum and is computed again.
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
from lp_framework.data.files import content_key
from lp_framework.data.images import eight_bit
from lp_framework.data.photographs import on_white, opened, prepare
from lp_framework.errors import UserError

T = TypeVar("T")


def cached_array(folder: str | Path, key: str, count: int, blocks: Callable[[], Iterable[NDArray]]) -> np.memmap:
    """The read-only, memory-mapped array `[count, ...]` of a key; if missing or damaged, it is computed from `blocks`
    `[n, ...]` of the same shape and type."""
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / f"{key}.lock"):
            if not _intact(folder, key, count):
                _write(folder, key, count, blocks())
    except OSError as error:
        why = reason(error, folder)
        raise UserError(f"{folder}: the cache cannot be written ({why}); set data.cache=FOLDER") from error
    return np.lib.format.open_memmap(folder / f"{key}.npy", mode="r")


def _write(folder: Path, key: str, count: int, blocks: Iterable[NDArray]) -> None:
    partial, note = folder / f"{key}.partial.npy", folder / f"{key}.partial.json"
    array, place = None, 0
    try:
        for block in blocks:
            if array is None:
                shape = (count, *block.shape[1:])
                array = np.lib.format.open_memmap(partial, mode="w+", dtype=block.dtype, shape=shape)
                if hasattr(os, "posix_fallocate"):  # not on macOS; prevents a SIGBUS on a full disk
                    with partial.open("r+b") as file:
                        os.posix_fallocate(file.fileno(), 0, partial.stat().st_size)
            array[place : place + len(block)] = block
            place += len(block)
        if array is None or place != count:
            raise ValueError(f"the blocks of {key} have {place} rows, expected {count}")
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
    except Exception:  # damaged files raise any exception from EOFError to SyntaxError
        return False


def _checksum(array: NDArray) -> int:
    return zlib.crc32(array.reshape(-1).view(np.uint8).data)


def tracked(items: Iterable[T], description: str, total: int | None = None) -> Iterable[T]:
    """Iterate over items with a progress bar that disappears at the end; only terminals show it."""
    console = Console(stderr=True)
    return track(items, description, total, console=console, transient=True, disable=not console.is_terminal)


def cores() -> int:
    """The number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def decoded_views(files: Sequence[Path], size: int, folder: str | Path, crop: bool = False) -> tuple[str, np.memmap]:
    """Key of the content and array `[N, size, size, 3]` (uint8) of image files, composed over white and resized. The
    result is cached until the decoding changes. With `crop` the object is centred and scaled like a photograph's, by
    the alpha channel (see `prepare`).

    `UserError` for an image that does not decode or is not square."""

    def decode(image: Image.Image) -> NDArray[np.uint8]:
        name = str(getattr(image, "filename", "a view"))
        return pixels_on_white(prepare(eight_bit(image).convert("RGBA"), name) if crop else image, size)

    def blocks() -> Iterator[NDArray[np.uint8]]:
        for file in tracked(files, "decoding views"):
            with opened(file) as image:
                if image.width != image.height:
                    raise UserError(f"{file}: is {image.width} x {image.height} pixels; views must be square")
                yield decode(image)[None]

    key = content_key(files, "crops" if crop else "views", size)
    samples = [decode(sample) for sample in sample_images()[: 1 if crop else 2]]
    return key, cached_array(folder, versioned_key(key, samples), len(files), blocks)


def sample_images() -> list[Image.Image]:
    """An image of an object with a soft edge, and a 16-bit greyscale image."""
    ramp = np.arange(64 * 64, dtype=np.uint16).reshape(64, 64) * 16
    opacity = (24 - np.hypot(*np.mgrid[-31.5:32, -31.5:32])) * 32
    soft = np.dstack([ramp / 257, ramp.T / 257, ramp % 256, opacity.clip(0, 255)]).astype(np.uint8)
    return [Image.fromarray(soft), Image.fromarray(ramp)]


def versioned_key(key: str, samples: Iterable[NDArray]) -> str:
    """Extend `key` by a decoder's outputs for sample images, its `samples`, so that arrays decoded differently by an
    earlier version are not used."""
    return content_key([], key, [hashlib.blake2b(sample.tobytes(), digest_size=8).hexdigest() for sample in samples])


def pixels_on_white(image: Image.Image, size: int) -> NDArray[np.uint8]:
    """Pixels `[size, size, 3]` of a view, composed over white and resized."""
    white = Image.fromarray(on_white(eight_bit(image).convert("RGBA")))
    return np.asarray(white.resize((size, size), Image.Resampling.BOX))
