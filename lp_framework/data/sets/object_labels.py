"""Ambiguity classes of a user's objects, from a YAML file.

    bbq_sauce: {ambiguity: continuous, unique_answer: true, reason: "a bottle; its label is on one side"}
    butter: {ambiguity: twofold, reason: "a box that says something else on each side"}

`unique_answer` and `reason` may be left out; the class decides on the first then (see `MeshObject`).
"""

from __future__ import annotations

import warnings
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple, get_args

import yaml

from lp_framework.data.meshes import Ambiguity
from lp_framework.errors import UserError, nearest

CLASSES = tuple(name for name in get_args(Ambiguity) if name != "unlabelled")
KEYS = ("ambiguity", "unique_answer", "reason")


class Label(NamedTuple):
    """An object's ambiguity class and whether a view of it has one right longitude, None where the class decides."""

    ambiguity: Ambiguity
    unique_answer: bool | None = None


def read_labels(path: Path, names: Collection[str], where: Path) -> dict[str, Label]:
    """The labels in a file, by object; `names` are the objects in the folder `where`.

    Warns of objects that the file leaves out; they stay unlabelled. Raises `UserError` naming the file, and the object,
    for a file that is missing or no YAML, for an object that is not in the folder and for a label that is none.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"{path}: there is no such file of labels") from None
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise UserError(f"{path}: is not readable YAML ({' '.join(str(error).split())})") from error
    if not isinstance(content, dict):
        raise UserError(f"{path}: must give every object its label, as in 'mug: {{ambiguity: unique}}'")
    labels = {}
    for name, label in content.items():
        if name not in names:
            raise UserError(f"{path}: {where} has no object '{name}'{nearest(str(name), names)}")
        labels[name] = _label(label, f"{path}: object '{name}'")
    if left_out := sorted(set(names) - set(labels)):
        warnings.warn(f"{path}: leaves out, so that they stay unlabelled: {', '.join(left_out)}", stacklevel=2)
    return labels


def _label(label: Any, where: str) -> Label:
    if not isinstance(label, dict) or "ambiguity" not in label:
        raise UserError(f"{where} needs ambiguity: {', '.join(CLASSES[:-1])} or {CLASSES[-1]}")
    for key, value in label.items():
        if key not in KEYS:
            raise UserError(f"{where}: {key!r} is none of {', '.join(KEYS)}{nearest(str(key), KEYS)}")
        if key == "ambiguity" and value not in CLASSES:
            known = f"{', '.join(CLASSES)}{nearest(str(value), CLASSES)}"
            raise UserError(f"{where}: ambiguity {value!r} is none of {known}")
        if key == "unique_answer" and not isinstance(value, bool | None):
            raise UserError(f"{where}: unique_answer must be true or false, got {value!r}")
        if key == "reason" and not isinstance(value, str | None):
            raise UserError(f"{where}: reason must be a text, got {value!r}")
    return Label(label["ambiguity"], label.get("unique_answer"))
