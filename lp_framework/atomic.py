"""Files that are written whole or not at all, and what is said where that fails."""

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
    """There is no room for a file, nor would there be for the next one."""


def reason(error: Exception, path: Path) -> str:
    """Why `path` cannot be written; of a full disk, how much space is not enough."""
    text = getattr(error, "strerror", None) or str(error)
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        existing = next(each for each in (path, *path.absolute().parents) if each.exists())
        text += f": it needs more than the {shutil.disk_usage(existing).free / 1e6:.1f} MB that are free"
    return text


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Make a `UserError` that names `path` of what goes wrong in writing to it, `DiskFull` for want of room."""
    try:
        yield
    except (OSError, SafetensorError) as error:
        kind = DiskFull if isinstance(error, OSError) and error.errno in FULL else UserError
        raise kind(f"{path}: cannot be written ({reason(error, path)})") from error


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """A hidden file beside `path` to write to; it replaces `path` at the end, and is removed where that fails.

    `UserError` that names `path` where it cannot be written.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")  # another process has another
    with writing(path):
        try:
            yield partial
            os.replace(partial, path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
