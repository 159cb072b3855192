"""Run folders: only one command at a time may use a folder, and empty folders are removed."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from lp_framework.atomic import FULL, DiskFull, reason
from lp_framework.errors import UserError

HYDRA, LOCK = ".hydra", ".lock"


def relative(folder: Path) -> Path:
    """A folder relative to the working directory if it lies inside it, otherwise unchanged."""
    return folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder


class Held(UserError):
    """Another command is using this folder."""


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Lock a run's folder until the end of the block or of the process.

    Raises `Held` if another process holds it, and `DiskFull` if the disk fills up inside the block. Of several
    processes of a run, rank 0 holds the folder; a folder that does not exist is not locked.
    """
    from lightning.pytorch.utilities import rank_zero_only  # already imported by any command

    lock = FileLock(folder / LOCK)
    if rank_zero_only.rank == 0 and folder.is_dir():  # type: ignore[attr-defined]  # set at import
        try:
            lock.acquire(timeout=0)
        except Timeout as error:
            raise Held(f"{folder}: is in use by another command; wait for it, or choose another folder") from error
        except OSError as error:
            raise UserError(f"{folder / LOCK}: cannot be written ({reason(error, folder)})") from error
    try:
        yield
    except OSError as error:
        if error.errno not in FULL:
            raise
        file = Path(error.filename or folder)
        raise DiskFull(f"{file}: cannot be written ({reason(error, file)})") from error
    finally:
        lock.release()


def remove_if_empty(folder: Path, log: str) -> None:
    """Remove a run's folder if it contains only its `log`, the lock and Hydra's own files."""
    if folder.is_dir() and {each.name for each in folder.iterdir()} <= {HYDRA, LOCK, log} and folder != Path.cwd():
        shutil.rmtree(folder, ignore_errors=True)
