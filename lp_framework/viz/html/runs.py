"""Which runs there are below some folders, and of which command each is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

import yaml

from lp_framework.errors import UserError
from lp_framework.evaluation.runs import HYDRA, RESULT

Kind = Literal["eval", "train", "estimate", "landscape"]
# What tells a run whose Hydra folder is gone: the first of these files that it has.
FILES: dict[str, Kind] = {
    "training.json": "train", "metrics.csv": "train", "landscape.json": "landscape", "azimuth.json": "landscape",
    "poses.csv": "estimate", RESULT: "eval",
}  # fmt: skip


def run_kind(folder: Path) -> Kind | None:
    """The command that made the folder, None where it is none with a page."""
    try:
        hydra = yaml.load((folder / HYDRA).read_text(encoding="utf-8"), yaml.CSafeLoader)
        name = hydra["hydra"]["job"]["name"]
        return next((kind for kind in get_args(Kind) if kind == name), None)
    except (OSError, yaml.YAMLError, ValueError, KeyError, TypeError):
        return next((kind for file, kind in FILES.items() if (folder / file).is_file()), None)


def run_folders(folders: Sequence[Path]) -> list[tuple[Path, Kind]]:
    """All runs with a page in and below `folders`, each once, in natural order; `UserError` for a missing folder."""
    found: dict[Path, tuple[Path, Kind]] = {}
    for folder in folders:
        if not folder.is_dir():
            raise UserError(f"runs={folder}: there is no such folder")
        below = {file.parent for name in FILES for file in folder.rglob(name)}
        below |= {file.parent.parent for file in folder.rglob(str(HYDRA))}
        for each in below:
            kind = run_kind(each)
            if kind is not None:
                found[each.resolve()] = each, kind
    return sorted(found.values(), key=lambda run: [(len(part), part) for part in run[0].parts])
