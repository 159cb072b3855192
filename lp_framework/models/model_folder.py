"""A trained module as a folder of names, numbers and safetensors: what ships with this package, and what users share.

model.json           the configs of model and backbone by registered name, the fingerprint of the frozen trunk
model.safetensors    the weights
config.yaml, metrics.csv, training.png    where they come from: the run's config with its seed, its curve
"""

from __future__ import annotations

import errno
import json
import shutil
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from lp_framework.errors import UserError

CONFIG, WEIGHTS = "model.json", "model.safetensors"
ORIGIN = ("config.yaml", "training.json", "metrics.csv", "training.png")  # of a run's folder
RECIPE = "lp_framework"  # key in a checkpoint: the configs of model and backbone


def write_model_folder(checkpoint: dict[str, Any], run: Path, folder: Path, dtype: torch.dtype) -> None:
    """Write a checkpoint (see `read_checkpoint`) of the run in `run`, floating-point weights as `dtype`.

    Whole or not at all; `UserError` where the folder exists already or cannot be written.
    """
    if folder.exists():
        raise UserError(f"{folder}: exists already; give another folder or remove it")
    partial = folder.with_name(f"{folder.name}.partial")
    weights = {
        key: (tensor.to(dtype) if tensor.is_floating_point() else tensor).contiguous()
        for key, tensor in checkpoint["state_dict"].items()
    }
    config = {**checkpoint[RECIPE], "trunk": checkpoint.get("trunk")}
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        save_file(weights, partial / WEIGHTS)
        (partial / CONFIG).write_text(json.dumps(config, indent=2) + "\n", encoding="utf-8")
        for name in ORIGIN:
            if (run / name).is_file():
                shutil.copyfile(run / name, partial / name)
        partial.rename(folder)
    except (OSError, SafetensorError) as error:
        shutil.rmtree(partial, ignore_errors=True)
        full = isinstance(error, OSError) and error.errno == errno.ENOSPC
        raise UserError(f"{folder}: cannot be written: {'the disk is full' if full else error}") from error


def is_recipe(value: Any) -> bool:
    """Whether a value can be the configs of model and backbone: settings by name, `name` among them."""
    return isinstance(value, dict) and all(
        isinstance(value.get(group), dict)
        and isinstance(value[group].get("name"), str)
        and all(isinstance(key, str) for key in value[group])
        for group in ("model", "backbone")
    )


def read_model_folder(folder: Path) -> dict[str, Any]:
    """The checkpoint that a folder holds, weights in float32; `UserError` naming the file that is at fault."""
    try:
        config = json.loads((folder / CONFIG).read_text(encoding="utf-8"))
        recipe, trunk = {"model": config["model"], "backbone": config["backbone"]}, config["trunk"]
        if not is_recipe(recipe):
            raise ValueError("model and backbone have no names")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise UserError(f"{folder / CONFIG}: is not the description of a trained model ({error})") from error
    try:
        with safe_open(folder / WEIGHTS, framework="pt") as file:
            weights = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a mapping)
    except (OSError, SafetensorError) as error:
        raise UserError(f"{folder / WEIGHTS}: is not a readable file of weights ({error})") from error
    weights = {key: tensor.float() if tensor.is_floating_point() else tensor for key, tensor in weights.items()}
    return {RECIPE: recipe, "trunk": trunk, "state_dict": weights}
