"""Which objects of a data set are seen and unseen: chosen once, written beside the views, and read from there.

`objects.json` in the folder of views: `{"chosen": {how}, "seen": [names], "unseen": [names]}`. So a later run, with
more of the data set downloaded, has the same objects; and the names that a result is about are on record.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lp_framework.atomic import written
from lp_framework.data.object_folders import differences, locked, read_record
from lp_framework.errors import UserError

LIST = "objects.json"


class ObjectLists(NamedTuple):
    """Names of the objects to train on (`seen`) and of those kept for evaluation (`unseen`), each sorted."""

    seen: list[str]
    unseen: list[str]

    def named(self, which: str) -> list[str]:
        """The list called "seen" or "unseen"; `UserError` where it is empty."""
        names = self.unseen if which == "unseen" else self.seen
        if not names:
            raise UserError(f"data.objects={which}: there are none; set data.unseen to the number of unseen objects")
        return names


def drawn(available: Sequence[str], seen: int | None, unseen: int, seed: int, where: Path) -> ObjectLists:
    """A seeded choice of `seen` (None: all others) and `unseen` objects among those available.

    Raises `UserError`, naming the place, where there are too few.
    """
    names = sorted(available)
    least = (1 if seen is None else seen) + unseen
    if min(unseen, least - unseen) < 0 or least == 0:
        raise UserError(f"{where}: the numbers of objects must not be negative, got {seen} seen and {unseen} unseen")
    if len(names) < least:
        raise UserError(
            f"{where}: {len(names)} objects are there, {least} are needed ({least - unseen} seen and {unseen} unseen)"
        )
    order = [names[index] for index in np.random.default_rng(seed).permutation(len(names))]
    return ObjectLists(sorted(order[unseen:] if seen is None else order[unseen:least]), sorted(order[:unseen]))


def kept_lists(views: Path, how: dict[str, Any], choose: Callable[[], ObjectLists]) -> ObjectLists:
    """The lists in the folder `views`, chosen and written there where there are none yet.

    `how` (plain values) says how they are chosen; `UserError` where those that are there were chosen otherwise.
    """
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
