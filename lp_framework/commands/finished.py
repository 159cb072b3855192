"""Runs that have gone before: finished jobs of a sweep are skipped, stopped runs are resumed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from lp_framework.errors import UserError
from lp_framework.evaluation.journal import FOLDER, MOVABLE, compared_settings, differences, unfinished
from lp_framework.evaluation.tables import RESULT


def is_finished(folder: Path, settings: Mapping[str, Any], checkpoint: Path | None) -> bool:
    """Whether `folder` has the results of this very job of a sweep, with `settings` and the model of `checkpoint`;
    if so, that is printed.

    The results have to be of the same configuration, seeds included, and not older than the checkpoint. Raises
    `UserError` for other results: they are not overwritten. A job without a readable `results.json` is to be run.
    """
    if HydraConfig.get().mode != RunMode.MULTIRUN:
        return False
    file = folder / RESULT
    try:
        result = json.loads(file.read_text(encoding="utf-8"))
        previous = compared_settings(result["config"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return False
    before = {**previous, "checkpoint": result.get("checkpoint")}
    now = {**compared_settings(json.loads(json.dumps(settings))), "checkpoint": checkpoint and str(checkpoint)}
    changed = differences(before, now)
    advice = "give another hydra.sweep.dir, or remove it"
    if changed:
        said = ", ".join(f"{key} is {there} there, {here} here" for key, (there, here) in list(changed.items())[:3])
        raise UserError(f"{folder}: holds the results of another configuration ({said}); {advice}")
    if checkpoint is not None and checkpoint.stat().st_mtime > file.stat().st_mtime:
        raise UserError(f"{folder}: holds the results of an earlier {checkpoint}; {advice}")
    print(f"skipped, finished before: {folder}")
    return True


def unfinished_evaluation(folder: Path, config: DictConfig, overrides: Sequence[str]) -> tuple[DictConfig, Path | None]:
    """The config and the checkpoint of the stopped `eval` in `folder`; it may be resumed on other devices.

    Raises `UserError` where there is none, and for `overrides` of other settings.
    """
    if (folder / RESULT).is_file():
        raise UserError(f"resume={folder}: that run is finished, {folder / RESULT} has its results")
    subject = unfinished(folder)
    if subject is None:
        raise UserError(f"resume={folder}: holds no {FOLDER} evaluation to go on from; give the folder of one")
    previous = OmegaConf.create(subject["config"])
    if missing := sorted({*config} - {*previous}):
        raise UserError(f"resume={folder}: is of another version of lp_framework, without {missing[0]}; evaluate anew")
    checkpoint = Path(subject["checkpoint"]) if subject["checkpoint"] else None
    return with_overrides(previous, config, overrides, MOVABLE, folder / FOLDER), checkpoint


def with_overrides(
    previous: DictConfig, config: DictConfig, overrides: Sequence[str], changeable: tuple[str, ...], saved: Path
) -> DictConfig:
    """The config of a resumed run: `previous`, of the file or folder `saved`, with what the command line changes.

    Raises `UserError` where `overrides`, the command line's, have a key that does not begin as one of `changeable`.
    """
    keys = {override.partition("=")[0].strip("+~") for override in overrides} - {"resume", "plugins"}
    for key in sorted(keys):
        if not key.startswith(changeable):
            raise UserError(f"{key} cannot be changed by a resumed run: {saved} says what it is; leave it out")
        OmegaConf.update(previous, key, OmegaConf.select(config, key), merge=False, force_add=True)
    return previous
