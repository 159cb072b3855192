"""Reading files and writing folders, with errors that name the file and say what is wrong.

An object's folder of views is complete or absent even if the run is interrupted: it is written as a hidden folder and
renamed when complete. A record beside the views identifies their source files, so that they are not mistaken for views
of other files with the same names (see `Origin`). `objects.json` in the parent folder,
`{"chosen": {how}, "seen": [names], "unseen": [names]}`, keeps the choice of objects: a later run uses the same objects
even if more of the data set has been downloaded.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from filelock import FileLock
from torch import Tensor

from lp_framework.atomic import writing, written
from lp_framework.errors import UserError, nearest
from lp_framework.geometry import is_rotation, spherical_residual

LIST = "objects.json"
LARGEST_RESIDUAL = 1.0  # degrees; cameras that deviate more from a spherical one are rejected
SHOWN = 5  # names in a message, and lines in a list of failures


def read_json(file: Path) -> Any:
    """Read a JSON file, gzipped (.jgz) or not."""
    zipped = file.suffix == ".jgz"
    with expecting(f"{file}: is not readable {'gzipped ' if zipped else ''}JSON"):
        content = file.read_bytes()
        return json.loads(gzip.decompress(content) if zipped else content)


@contextmanager
def expecting(sentence: str) -> Iterator[None]:
    """Convert any exception while reading or parsing to a `UserError` with `sentence`, which says what is expected."""
    try:
        yield
    except UserError:
        raise
    except FileNotFoundError as error:
        raise UserError(f"{error.filename or error}: there is no such file") from error
    except Exception as error:  # parsers raise any exception from KeyError to struct.error
        reason = " ".join(str(error).split())
        raise UserError(f"{sentence} ({type(error).__name__}: {reason})") from error


def names_below(root: Path, names: Iterable[str], what: str, looked_for: object) -> list[str]:
    """Sorted unique names found in a folder; `UserError` if the folder does not exist or contains none."""
    if not root.is_dir():
        raise UserError(f"{root}: there is no such folder of {what}; give data.path=FOLDER")
    found = sorted({*names})
    if not found:
        raise UserError(f"{root}: holds no {what}; looked for {looked_for}")
    return found


def chosen(names: Sequence[str], wanted: str | Sequence[str] | None, where: object) -> list[str]:
    """The objects selected by `data.objects` (`wanted`), sorted; all for None. `UserError` for one that is not in
    `names`, the objects available in `where`."""
    if wanted is None:
        return sorted(names)
    found = sorted({wanted} if isinstance(wanted, str) else {*wanted})
    if not found:
        raise UserError("data.objects is empty; it needs the name of at least one object")
    for name in found:
        if name not in names:
            raise UserError(f"data.objects: there is no '{name}' in {where}{nearest(name, names)}")
    return found


def listed(names: Sequence[str]) -> str:
    """The first few names in a sentence, and how many others there are.

    >>> listed(["mug", "vase"]), listed("abcdefg")
    ('mug, vase', 'a, b, c, d, e and 2 more')
    """
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more


def numbers(values: Any, *shape: int) -> Tensor:
    """A tensor (float64) of finite numbers of this shape; may raise any exception, so call it within `expecting`."""
    tensor = torch.as_tensor(values, dtype=torch.float64)
    if tensor.shape != shape or not tensor.isfinite().all():
        raise ValueError(f"these are not {' x '.join(map(str, shape))} finite numbers")
    return tensor


def check_upright(camera: Tensor, where: str, up: str = "+Y") -> None:
    """`UserError` unless a camera `[4, 4]` is rigid, not at the origin, looks at the origin and is upright."""
    if not is_rotation(camera[:3, :3]) or (camera[3] - camera.new_tensor([0, 0, 0, 1])).abs().max() >= 1e-3:
        raise UserError(f"{where} is not a rigid camera-to-world transform")
    if not 1e-6 < camera[:3, 3].norm() < torch.inf:
        raise UserError(f"{where} must not be at the origin; its distance is {camera[:3, 3].norm():g}")
    residual = spherical_residual(camera).item()
    if not residual <= LARGEST_RESIDUAL:
        off = f"it is {residual:.1f} degrees off; at most {LARGEST_RESIDUAL:g} are allowed"
        raise UserError(f"{where} does not look at the origin with {up} up ({off})")


@contextmanager
def locked(folder: Path, lock: str) -> Iterator[None]:
    """Lock a folder, created if needed, so that runs that create views in it take turns."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / lock):
            yield


@contextmanager
def written_folder(folder: Path) -> Iterator[Path]:
    """A hidden folder beside `folder` to write to; renamed to `folder` at the end, or removed on failure."""
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)  # left by a killed run
    try:
        with writing(folder):
            partial.mkdir(parents=True)
            yield partial
            partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def content_key(files: Iterable[Path], *facts: object) -> str:
    """A key for results computed from the bytes of `files`, in order, and from `facts`."""
    digest = hashlib.blake2b(repr(facts).encode(), digest_size=16)
    for file in files:
        try:
            digest.update(hashlib.blake2b(file.read_bytes()).digest())
        except OSError as error:
            raise UserError(f"{file}: cannot be read ({error.strerror})") from error
    return digest.hexdigest()


@dataclass(frozen=True)
class Origin:
    """An object's source files, files `beside` them that several objects may share, and their `up` axis."""

    files: Sequence[Path]
    beside: Origin | None = None
    up: str = "y"

    @cached_property
    def content(self) -> str:
        """A hash of the names and bytes of the files."""
        return content_key(self.files, [file.name for file in self.files], self.beside and self.beside.content, self.up)

    @cached_property
    def stamp(self) -> str:
        """A hash of their paths, sizes and times, computed without reading them."""
        stats = [(os.path.abspath(file), file.stat()) for file in self.files]
        facts = [(path, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns) for path, stat in stats]
        return content_key([], facts, self.beside and self.beside.stamp, self.up)

    def record(self) -> dict[str, str]:
        """What a record stores about the files."""
        return {"content": self.content, "stamp": self.stamp}

    def is_of(self, record: Any) -> bool:
        """Whether a record matches these files, which are read only if a path, size or time has changed."""
        return isinstance(record, dict) and (record.get("stamp") == self.stamp or record.get("content") == self.content)


def read_record(file: Path) -> dict[str, Any]:
    """Read a record; empty if it is missing or unreadable."""
    try:
        content = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def differences(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """Describe how a record differs from the wanted values; empty if it does not.

    >>> differences({"seed": 0, "views": 8}, {"seed": 1, "views": 8})
    'seed was 0, is 1'
    """
    changed = (key for key, value in wanted.items() if found.get(key) != value)
    return "; ".join(f"{key} was {found.get(key)}, is {wanted[key]}" for key in changed)


def raise_failures(failures: Mapping[str, str], objects: int, done: str) -> None:
    """Raise one `UserError` for all failed objects, by name: equal messages are merged, and of many different ones only
    the first few are listed."""
    names: dict[str, list[str]] = {}
    for name, message in failures.items():
        names.setdefault(message, []).append(name)
    lines = [f"{listed(of_these)}: {message}" for message, of_these in names.items()]
    if len(lines) > SHOWN:
        others = sum(len(of_these) for of_these in [*names.values()][SHOWN:])
        lines = [*lines[:SHOWN], f"and {others} more"]
    if lines:
        details = f" {lines[0]}" if len(lines) == 1 else "".join(f"\n  {line}" for line in lines)
        raise UserError(f"{len(failures)} of {objects} objects could not be {done}:{details}")


class ObjectLists(NamedTuple):
    """Names of the training objects (`seen`) and of those held out for evaluation (`unseen`), each sorted."""

    seen: list[str]
    unseen: list[str]


def drawn(available: Sequence[str], seen: int | None, unseen: int, seed: int, where: Path) -> ObjectLists:
    """A seeded choice of `seen` (None: all other) and `unseen` objects; `UserError` naming `where` for too few."""
    names = sorted(available)
    if seen is None:
        seen = max(len(names) - unseen, 1)
    needed = seen + unseen
    if min(seen, unseen) < 0 or needed == 0:
        raise UserError(f"{where}: the numbers of objects must not be negative, got {seen} seen and {unseen} unseen")
    if len(names) < needed:
        wanted = f"{needed} are needed ({seen} seen and {unseen} unseen)"
        raise UserError(f"{where}: found {len(names)} objects, but {wanted}")
    order = [names[index] for index in np.random.default_rng(seed).permutation(len(names))]
    return ObjectLists(sorted(order[unseen:needed]), sorted(order[:unseen]))


def kept_lists(views: Path, how: dict[str, Any], choose: Callable[[], ObjectLists]) -> ObjectLists:
    """The lists in the folder `views`, chosen and written there on first use; `UserError` if they were chosen with
    settings other than `how` (plain values)."""
    path = views / LIST
    if not path.exists():
        lists = choose()
        with locked(views, ".objects.lock"):
            if not path.exists():
                with written(path) as partial:
                    partial.write_text(json.dumps({"chosen": how, **lists._asdict()}, indent=1))
    content = read_json(path)
    with expecting(f"{path}: is not a valid list of objects; delete it to choose them again"):
        changed = differences(content["chosen"], how)
        seen, unseen = ([str(name) for name in content[key]] for key in ("seen", "unseen"))
    if changed:
        raise UserError(
            f"{path}: its objects were chosen with other settings ({changed}); choose another folder of views"
        )
    return ObjectLists(seen, unseen)
