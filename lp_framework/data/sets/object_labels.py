"""Ambiguity classes of a user's objects, from a YAML file.

    bbq_sauce: {ambiguity: continuous, unique_answer: true, reason: "a bottle; its label is on one side"}
    butter: {ambiguity: twofold, reason: "a box that says something else on each side"}

`unique_answer` and `reason` may be left out; the class decides on the first then (see `MeshObject`).
"""

from __future__ import annotations

import warnings
from collections.abc import Collection
from pathlib import Path
from typing import Literal

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from lp_framework.errors import UserError, nearest


class Label(BaseModel):
    """An object's ambiguity class and whether a view of it has one right longitude, None where the class decides."""

    model_config = ConfigDict(strict=True, extra="forbid")

    ambiguity: Literal["unique", "twofold", "continuous"]
    unique_answer: bool | None = None
    reason: str | None = None


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
        try:
            labels[name] = Label.model_validate(label)
        except ValidationError as error:
            first = error.errors()[0]
            key = "".join(f"{each}: " for each in first["loc"])
            raise UserError(f"{path}: object '{name}': {key}{first['msg']}, got {first['input']!r}") from error
    if left_out := sorted(set(names) - set(labels)):
        warnings.warn(f"{path}: leaves out, so that they stay unlabelled: {', '.join(left_out)}", stacklevel=2)
    return labels
