"""Folders of finished evaluations with synthetic metrics, in the layout of `eval`."""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS

CONFIG = {
    "plugins": [],
    "data": {"name": "toy", "path": "datasets/toy", "seed": 0},
    "start": {"name": "grid", "latitudes_degrees": [-30.0, 0.0, 30.0]},
    "solver": {"name": "two_stage", "gamma": [0.0, 0.3, 0.0], "iterations": 50},
    "prior": {"name": "tiny"},
    "seed": 0,
    "protocol": "ordered",
    "checkpoint": None,
}


def metrics(recall: float, success: float | None = None) -> dict[str, float]:
    """All metrics: `recall` within 30 degrees, less within fewer; medians that fall with it."""
    success = recall if success is None else success
    values: dict[str, float] = {}
    for prefix, share in (("R", recall), ("SR", success)):
        for degrees, factor in zip(ROTATION_THRESHOLDS, (0.7, 0.95, 1.0), strict=True):
            values[f"{prefix}@{degrees}"] = share * factor
            values[f"{prefix}(R)@{degrees}"] = min(1.0, share * factor + 0.01)
    return {**values, "rotation_error": 10 * (1 - recall), "translation_error": 0.1}


def write_result(
    folder: Path,
    config: Mapping[str, Any] | None = None,
    values: Mapping[str, float | None] | None = None,
    experiment: str | None = None,
    seconds: float = 0.1,
    **result: Any,
) -> Path:
    """A finished run: `config` (dotted keys) over `CONFIG`, `values` as metrics, and what `result` replaces."""
    full = OmegaConf.create(copy.deepcopy(CONFIG))
    for key, value in (config or {}).items():
        if key.endswith(".name"):
            full[key.partition(".")[0]] = {"name": value}
        else:
            OmegaConf.update(full, key, value, force_add=True)
    values = metrics(0.8) if values is None else values
    content = {
        **{"metrics": values, "metrics_unique_answer": values, "per_object": {}, "per_ambiguity": {}, "pairs": 672},
        **{"seconds_per_pair": seconds, "network_passes_per_pair": 100.0, "protocol": full.protocol},
        **{"seed": full.seed, "checkpoint": None, "config": OmegaConf.to_container(full), "versions": {}},
        **result,
    }
    write_job(folder, experiment)
    (folder / "results.json").write_text(json.dumps(content))
    return folder


def write_job(folder: Path, experiment: str | None = None, command: str = "eval") -> Path:
    """The files that Hydra writes before a job starts."""
    (folder / ".hydra").mkdir(parents=True)
    job = {"hydra": {"job": {"name": command}, "runtime": {"choices": {"experiment": experiment, "data": "toy"}}}}
    OmegaConf.save(OmegaConf.create(job), folder / ".hydra" / "hydra.yaml")
    return folder
