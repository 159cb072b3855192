"""Jobs of a sweep that have run before: an interrupted sweep continues where it stopped."""

from __future__ import annotations

import json
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from lp_framework import registry
from lp_framework.commands.building import plain
from lp_framework.errors import UserError
from lp_framework.evaluation.runs import RESULT, differences, dotted
from lp_framework.models.checkpoints import default_checkpoint, find_checkpoint


def is_finished(folder: Path, config: DictConfig) -> bool:
    """Whether `folder` has the results of this very job of a sweep, which is then said in a line.

    The results have to be of the same configuration, seeds included, and not older than the model's checkpoint. Raises
    `UserError` for other results: they are not overwritten. A job without a readable `results.json` is to be run.
    """
    if HydraConfig.get().mode != RunMode.MULTIRUN:
        return False
    file = folder / RESULT
    try:
        result = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    checkpoint = _checkpoint(config)
    before = {**dotted(result.get("config", {})), "checkpoint": result.get("checkpoint")}
    now = {**dotted(json.loads(json.dumps(plain(config)))), "checkpoint": str(checkpoint) if checkpoint else None}
    changed = {key: pair for key, pair in differences(before, now).items() if key != "plugins"}
    advice = "give another hydra.sweep.dir, or remove it"
    if changed:
        said = ", ".join(f"{key} is {there} there, {here} here" for key, (there, here) in list(changed.items())[:3])
        raise UserError(f"{folder}: holds the results of another configuration ({said}); {advice}")
    if checkpoint is not None and checkpoint.stat().st_mtime > file.stat().st_mtime:
        raise UserError(f"{folder}: holds the results of an earlier {checkpoint}; {advice}")
    print(f"skipped, finished before: {folder}")
    return True


def _checkpoint(config: DictConfig) -> Path | None:
    """The checkpoint that the job would use, None for a solver without a model."""
    if "model" not in registry.component_names(registry.get("solver", config.solver.name)):
        return None
    return default_checkpoint() if config.checkpoint is None else find_checkpoint(config.checkpoint)
