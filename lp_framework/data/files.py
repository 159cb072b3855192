"""Files read and folders written: whatever is wrong with one is told in a sentence that names it.

An object's folder of views is complete or absent, whatever stops the run: it is written as a hidden folder that is
renamed when all of it is there. A record beside the views says what they were made from, so that they are not taken for
those of other files of the same names (see `Origin`). `objects.json` in the folder
of all, `{"chosen": {how}, "seen": [names], "unseen": [names]}`, keeps which objects were chosen: a later run, with more
of the data set downloaded, has the same.
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
LARGEST_RESIDUAL = 1.0  # degrees; a camera further from a spherical one is refused
SHOWN = 5  # names in a sentence, and lines in a list of failures


def read_json(file: Path) -> Any:
    """The content of a JSON file, of a gzipped one (.jgz) too."""
    zipped = file.suffix == ".jgz"
    with expecting(f"{file}: is not readable {'gzipped ' if zipped else ''}JSON"):
        content = file.read_bytes()
        return json.loads(gzip.decompress(content) if zipped else content)


@contextmanager
def expecting(sentence: str) -> Iterator[None]:
    """Make `UserError`, with what `sentence` says is wanted, of what goes wrong in reading or taking apart."""
    try:
        yield
    except UserError:
        raise
    except FileNotFoundError as error:
        raise UserError(f"{error.filename or error}: there is no such file") from error
    except Exception as error:  # parsers raise anything from KeyError to struct.error
        reason = " ".join(str(error).split())
        raise UserError(f"{sentence} ({type(error).__name__}: {reason})") from error


def names_below(root: Path, names: Iterable[str], what: str, looked_for: object) -> list[str]:
    """Names found in a folder, sorted, each once; `UserError` where there is no such folder and where it has none."""
    if not root.is_dir():
        raise UserError(f"{root}: there is no such folder of {what}; give data.path=FOLDER")
    found = sorted({*names})
    if not found:
        raise UserError(f"{root}: holds no {what}; looked for {looked_for}")
    return found


def chosen(names: Sequence[str], wanted: str | Sequence[str] | None, where: object) -> list[str]:
    """The objects that `data.objects` names (`wanted`), sorted; all for None. `UserError` for one that is not among the
    `names`, which are those in `where`."""
    if wanted is None:
        return sorted(names)
    found = sorted({wanted} if isinstance(wanted, str) else {*wanted})
    if not found:
        raise UserError("data.objects is empty; it needs the name of an object")
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
    """A tensor (float64) of finite numbers of this shape; raises anything, so it is called within `expecting`."""
    tensor = torch.as_tensor(values, dtype=torch.float64)
    if tensor.shape != shape or not tensor.isfinite().all():
        raise ValueError(f"these are not {' x '.join(map(str, shape))} finite numbers")
    return tensor


def check_upright(camera: Tensor, where: str, up: str = "+Y") -> None:
    """`UserError` unless a camera `[4, 4]` is rigid, off the origin, looks at it, and stands upright."""
    if not is_rotation(camera[:3, :3]) or (camera[3] - camera.new_tensor([0, 0, 0, 1])).abs().max() >= 1e-3:
        raise UserError(f"{where} is not a rigid camera-to-world transform")
    if not 1e-6 < camera[:3, 3].norm() < torch.inf:
        raise UserError(f"{where} must stand off the origin; its distance is {camera[:3, 3].norm():g}")
    residual = spherical_residual(camera).item()
    if not residual <= LARGEST_RESIDUAL:
        off = f"it is {residual:.1f} degrees off, {LARGEST_RESIDUAL:g} are allowed"
        raise UserError(f"{where} does not look at the origin with {up} up ({off})")


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


def content_key(files: Iterable[Path], *facts: object) -> str:
    """A key for what is computed from the bytes of `files`, in their order, and from `facts`."""
    digest = hashlib.blake2b(repr(facts).encode(), digest_size=16)
    for file in files:
        try:
            digest.update(hashlib.blake2b(file.read_bytes()).digest())
        except OSError as error:
            raise UserError(f"{file}: cannot be read ({error.strerror})") from error
    return digest.hexdigest()


@dataclass(frozen=True)
class Origin:
    """The files that an object's views are made from, others `beside` them that may belong to several objects, and the
    axis that is `up` in them."""

    files: Sequence[Path]
    beside: Origin | None = None
    up: str = "y"

    @cached_property
    def content(self) -> str:
        """A text that changes with the names and bytes of the files."""
        return content_key(self.files, [file.name for file in self.files], self.beside and self.beside.content, self.up)

    @cached_property
    def stamp(self) -> str:
        """A text that changes with their places, sizes and times, which costs no reading."""
        stats = [(os.path.abspath(file), file.stat()) for file in self.files]
        facts = [(path, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns) for path, stat in stats]
        return content_key([], facts, self.beside and self.beside.stamp, self.up)

    def record(self) -> dict[str, str]:
        """What a record is to keep of the files."""
        return {"content": self.content, "stamp": self.stamp}

    def is_of(self, record: Any) -> bool:
        """Whether a record is of these files; they are read where they are not where and as they were."""
        return isinstance(record, dict) and (record.get("stamp") == self.stamp or record.get("content") == self.content)


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
    """One `UserError` for all objects of which one was raised, by name: what they share is said once, of many different
    messages the first few are listed."""
    names: dict[str, list[str]] = {}
    for name, message in failures.items():
        names.setdefault(message, []).append(name)
    lines = [f"{listed(of_these)}: {message}" for message, of_these in names.items()]
    if len(lines) > SHOWN:
        others = sum(len(of_these) for of_these in [*names.values()][SHOWN:])
        lines = [*lines[:SHOWN], f"and {others} more"]
    if lines:
        told = f" {lines[0]}" if len(lines) == 1 else "".join(f"\n  {line}" for line in lines)
        raise UserError(f"{len(failures)} of {objects} objects could not be {done}:{told}")


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
    content = read_json(path)
    with expecting(f"{path}: is no list of objects as this program writes it; delete it to choose anew"):
        changed = differences(content["chosen"], how)
        seen, unseen = ([str(name) for name in content[key]] for key in ("seen", "unseen"))
    if changed:
        raise UserError(f"{path}: its objects were chosen otherwise ({changed}); choose another folder of views")
    return ObjectLists(seen, unseen)
