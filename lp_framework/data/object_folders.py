"""Folders of views as they are made: an object's is complete or absent, whatever stops the run.

An object is written into a hidden folder that is renamed when all of it is there. A record beside its views says what
they were made from.
"""

from __future__ import annotations

import errno
import json
import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock
from safetensors import SafetensorError

from lp_framework.data.views import FIELD_OF_VIEW_DEGREES, TRANSFORMS
from lp_framework.errors import UserError


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Make a `UserError` that names `folder` of what goes wrong in writing into it."""
    try:
        yield
    except (OSError, SafetensorError) as error:
        full = getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT)
        reason = "the disk is full" if full else getattr(error, "strerror", error)
        raise UserError(f"{folder}: cannot be written ({reason})") from error


@contextmanager
def locked(folder: Path, lock: str) -> Iterator[None]:
    """Have a folder to oneself, made if need be: runs that make views in one folder take turns."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / lock):
            yield


@contextmanager
def written_folder(folder: Path) -> Iterator[Path]:
    """A hidden folder beside `folder` to write to; it takes its name at the end, and is removed where that fails."""
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)  # of a run that was killed
    try:
        with writing(folder):
            partial.mkdir(parents=True)
            yield partial
            partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def write_object(folder: Path, record_file: str, record: Mapping[str, Any], write: Callable[[Path], None]) -> None:
    """Have an object's folder written by `write`, with its record, whole or not at all."""
    with written_folder(folder) as partial:
        write(partial)
        (partial / record_file).write_text(json.dumps(record, indent=1))


def write_transforms(
    folder: Path,
    frames: list[dict[str, Any]],
    field_of_view_degrees: float = FIELD_OF_VIEW_DEGREES,
    labels: Mapping[str, Any] | None = None,
) -> None:
    """The `transform.json` of a split (see `views`)."""
    content = {"camera_angle_x": math.radians(field_of_view_degrees), **(labels or {}), "frames": frames}
    (folder / TRANSFORMS).write_text(json.dumps(content, indent=1))


def read_record(file: Path) -> dict[str, Any]:
    """The content of a record; empty where there is none that can be read."""
    try:
        content = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def differences(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """What of a record is not as wanted, empty where all of it is.

    >>> differences({"seed": 0, "views": 8}, {"seed": 1, "views": 8})
    'seed was 0, is 1'
    """
    changed = (key for key, value in wanted.items() if found.get(key) != value)
    return "; ".join(f"{key} was {found.get(key)}, is {wanted[key]}" for key in changed)


def raise_failures(failures: Mapping[str, str], objects: int, done: str) -> None:
    """One `UserError` for all objects of which one was raised, by name; what they share is said once."""
    names: dict[str, list[str]] = {}
    for name, message in failures.items():
        names.setdefault(message, []).append(name)
    told = [f"{', '.join(of_these)}: {message}" for message, of_these in names.items()]
    if told:
        listed = f" {told[0]}" if len(told) == 1 else "".join(f"\n  {each}" for each in told)
        raise UserError(f"{len(failures)} of {objects} objects could not be {done}:{listed}")
