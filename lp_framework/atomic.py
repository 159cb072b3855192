"""Atomic file writing, with clear errors on failure."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from safetensors import SafetensorError

from lp_framework.errors import UserError

FULL = (errno.ENOSPC, errno.EDQUOT)


class DiskFull(UserError):
    """The disk is full, so writing further files would fail as well."""


def reason(error: Exception, path: Path) -> str:
    """Why `path` cannot be written; for a full disk, including the remaining space."""
    text = getattr(error, "strerror", None) or str(error)
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        existing = next(each for each in (path, *path.absolute().parents) if each.exists())
        text += f": it needs more than the {shutil.disk_usage(existing).free / 1e6:.1f} MB that are free"
    return text


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn errors in writing to `path` into a `UserError` that names it, or `DiskFull` if the disk is full."""
    try:
        yield
    except (OSError, SafetensorError) as error:
        kind = DiskFull if isinstance(error, OSError) and error.errno in FULL else UserError
        raise kind(f"{path}: cannot be written ({reason(error, path)})") from error


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """A hidden file beside `path` to write to; it replaces `path` at the end, or is removed on failure.

    Raises `UserError` with the name of `path` if it cannot be written.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")  # one per process
    with writing(path):
        try:
            yield partial
            os.replace(partial, path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
