"""Trained models on disk: names and numbers beside the weights, so that loading runs no code of the file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer

from lp_framework import registry
from lp_framework.errors import UserError
from lp_framework.models.pose_model import PoseModel

RECIPE = "lp_framework"  # key in the checkpoint: the configs of model and backbone
FOLDER = "checkpoints"
LAST, BEST = "last.ckpt", "best.ckpt"


class KeepRecipe(Callback):
    """Writes the configs of model and backbone, by registered name, into every checkpoint."""

    def __init__(self, model: Mapping[str, Any], backbone: Mapping[str, Any]) -> None:
        self.recipe = {"model": dict(model), "backbone": dict(backbone)}

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Called by Lightning."""
        checkpoint[RECIPE] = self.recipe


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The contents of a checkpoint of this framework, as tensors, numbers and text only; `UserError` for others."""
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise UserError(f"{path}: there is no such checkpoint") from None
    except (OSError, RuntimeError, EOFError, UnpicklingError, ValueError, KeyError) as error:
        raise UserError(
            f"{path}: is not a readable checkpoint (damaged, or holding more than numbers and text)"
        ) from error
    if not isinstance(checkpoint, dict) or RECIPE not in checkpoint or "state_dict" not in checkpoint:
        raise UserError(f"{path}: is a checkpoint of something else; one that `lp train` wrote is wanted")
    return checkpoint


def find_checkpoint(path: str | Path) -> Path:
    """The checkpoint file that `path` means: the file itself, or the best (else last) one of a run's folder."""
    path = Path(path)
    if not path.is_dir():
        return path
    for folder in (path / FOLDER, path):
        for name in (BEST, LAST):
            if (folder / name).is_file():
                return folder / name
    raise UserError(f"{path}: holds no {FOLDER}/{BEST} or {LAST}; give a run's folder or a checkpoint file")


def newest_checkpoint(runs: str | Path = "runs/train") -> Path:
    """The checkpoint of the latest training run below the working directory."""
    found = sorted(Path(runs).glob(f"*/{FOLDER}/{LAST}"), key=lambda file: file.stat().st_mtime)
    if not found:
        raise UserError(f"there is no trained model below {runs}: run `lp train` first, or give checkpoint=PATH")
    return find_checkpoint(found[-1].parents[1])


def load_model(path: str | Path) -> PoseModel:
    """The model of a checkpoint file or a run's folder, ready for use.

    Raises `UserError` naming the file when it is missing, damaged, or its weights do not fit the model it names.
    """
    file = find_checkpoint(path)
    checkpoint = read_checkpoint(file)
    recipe = checkpoint[RECIPE]
    try:
        settings = dict(recipe["backbone"])
        if settings.get("pretrained") and not settings.get("frozen"):
            settings["pretrained"] = False  # trained along, so all its weights are in the checkpoint
        backbone = registry.build("backbone", settings)
        model = registry.build("model", recipe["model"], backbone=backbone)
        model.on_load_checkpoint(checkpoint)
    except UserError as error:
        raise UserError(f"{file}: {error}") from error
    try:
        missing, unexpected = model.load_state_dict(checkpoint["state_dict"], strict=False)
    except RuntimeError as error:  # of other shapes
        raise UserError(
            f"{file}: its weights are of another {recipe['model']['name']} model: {str(error).splitlines()[-1].strip()}"
        ) from error
    if missing or unexpected:
        raise UserError(
            f"{file}: its weights are of another {recipe['model']['name']} model: missing {missing[:2]}, "
            f"unknown {unexpected[:2]}"
        )
    return model.eval().requires_grad_(False)
