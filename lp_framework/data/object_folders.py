"""Folders of views as they are made: an object's is complete or absent, whatever stops the run.

An object is written into a hidden folder that is renamed when all of it is there. A record beside its views says what
they were made from. `objects.json` in the folder of views, `{"chosen": {how}, "seen": [names], "unseen": [names]}`,
keeps which objects were chosen: a later run, with more of the data set downloaded, has the same.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from filelock import FileLock
from safetensors import SafetensorError

from lp_framework.atomic import written
from lp_framework.errors import UserError

LIST = "objects.json"


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Make a `UserError` that names `folder` of what goes wrong in writing into it."""
    try:
        yield
    except (OSError, SafetensorError) as error:
        raise UserError(f"{folder}: cannot be written ({getattr(error, 'strerror', error)})") from error


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


class ObjectLists(NamedTuple):
    """Names of the objects to train on (`seen`) and of those kept for evaluation (`unseen`), each sorted."""

    seen: list[str]
    unseen: list[str]


def drawn(available: Sequence[str], seen: int | None, unseen: int, seed: int, where: Path) -> ObjectLists:
    """A seeded choice of `seen` (None: all other) and `unseen` objects; `UserError` naming the place for too few."""
    names = sorted(available)
    if seen is None:
        seen = max(len(names) - unseen, 1)
    needed = seen + unseen
    if min(seen, unseen) < 0 or needed == 0:
        raise UserError(f"{where}: the numbers of objects must not be negative, got {seen} seen and {unseen} unseen")
    if len(names) < needed:
        wanted = f"{needed} are needed ({seen} seen and {unseen} unseen)"
        raise UserError(f"{where}: {len(names)} objects are there, {wanted}")
    order = [names[index] for index in np.random.default_rng(seed).permutation(len(names))]
    return ObjectLists(sorted(order[unseen:needed]), sorted(order[:unseen]))


def kept_lists(views: Path, how: dict[str, Any], choose: Callable[[], ObjectLists]) -> ObjectLists:
    """The lists in the folder `views`, chosen and written there where there are none yet; `UserError` where those that
    are there were chosen otherwise than `how` (plain values) says."""
    path = views / LIST
    if not path.exists():
        lists = choose()
        with locked(views, ".objects.lock"):
            if not path.exists():
                with written(path) as partial:
                    partial.write_text(json.dumps({"chosen": how, **lists._asdict()}, indent=1))
    content = read_record(path)
    found, seen, unseen = content.get("chosen"), _names(content.get("seen")), _names(content.get("unseen"))
    if not isinstance(found, dict) or seen is None or unseen is None:
        raise UserError(f"{path}: is no list of objects as this program writes it; delete it to choose anew")
    if changed := differences(found, how):
        raise UserError(f"{path}: its objects were chosen otherwise ({changed}); choose another folder of views")
    return ObjectLists(seen, unseen)


def _names(value: Any) -> list[str] | None:
    return value if isinstance(value, list) and all(isinstance(name, str) for name in value) else None
