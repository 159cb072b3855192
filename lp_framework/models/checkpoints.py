"""Trained models on disk: names and numbers beside the weights, so that loading runs no code of the file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer

from lp_framework import registry
from lp_framework.errors import UserError, one_line, optional_import
from lp_framework.models.model_folder import CONFIG, RECIPE, WEIGHTS, is_recipe, read_model_folder
from lp_framework.models.pose_model import PoseModel
from lp_framework.models.trained_module import TrainedModule

FOLDER = "checkpoints"
LATEST = "latest"
LAST, BEST = "last.ckpt", "best.ckpt"
SHIPPED = Path(__file__).parents[1] / "weights"  # folders of models that come with this package


class KeepRecipe(Callback):
    """Writes the configs of model and backbone, by registered name, into every checkpoint."""

    def __init__(self, model: Mapping[str, Any], backbone: Mapping[str, Any]) -> None:
        self.recipe = {"model": dict(model), "backbone": dict(backbone)}

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Called by Lightning."""
        checkpoint[RECIPE] = self.recipe


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The contents of a checkpoint of this framework, as tensors, numbers and text only; `UserError` for others.

    `path` is a file that training wrote, or the safetensors of a model's folder (see `model_folder`).
    """
    if path.name == WEIGHTS:
        return read_model_folder(path.parent)
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise UserError(f"{path}: there is no such checkpoint") from None
    except Exception as error:  # a damaged pickle fails in any way
        raise UserError(
            f"{path}: is not a readable checkpoint (damaged, or holding more than numbers and text)"
        ) from error
    if not isinstance(checkpoint, dict) or not is_recipe(checkpoint.get(RECIPE)) or not _weights_in(checkpoint):
        raise UserError(f"{path}: is a checkpoint of something else; one that `lp train` wrote is wanted")
    return checkpoint


def _weights_in(checkpoint: Mapping[str, Any]) -> bool:
    weights = checkpoint.get("state_dict")
    return isinstance(weights, dict) and all(
        isinstance(key, str) and isinstance(value, torch.Tensor) for key, value in weights.items()
    )


def find_checkpoint(name: str | Path) -> Path:
    """The file of weights that `checkpoint=` means.

    `name` is that of weights that ship (`score`), `latest` (the latest training run below the working directory), a
    checkpoint file, a run's folder (its best, else its last checkpoint), a folder that `lp convert` wrote, or the id of
    such a folder on the Hugging Face hub. Raises `UserError` where there is none.
    """
    if not isinstance(name, str | Path):
        raise UserError(f"checkpoint={name}: give bundled weights by name (score), a file, a run's folder, or {LATEST}")
    if name in [folder.name for folder in SHIPPED.iterdir()]:
        return SHIPPED / name / WEIGHTS
    if name == LATEST:
        return latest_checkpoint()
    path = Path(name)
    if path.is_dir():
        return _in_folder(path)
    if re.fullmatch(r"[\w.-]+/[\w.-]+", str(name)) and not (path.exists() or path.parent.is_dir()):
        return _from_hub(str(name))
    return path


def _in_folder(path: Path) -> Path:
    if (path / WEIGHTS).is_file():
        return path / WEIGHTS
    for folder in (path / FOLDER, path):
        for name in (BEST, LAST):
            if (folder / name).is_file():
                return folder / name
    raise UserError(f"{path}: holds no {FOLDER}/{BEST} or {LAST}; give a run's folder or a checkpoint file")


def _from_hub(name: str) -> Path:
    hub = optional_import("huggingface_hub", f"checkpoint={name}", "pip install 'lp_framework[zero123]'")
    try:
        return Path(hub.snapshot_download(name, allow_patterns=[WEIGHTS, CONFIG])) / WEIGHTS
    except (OSError, ValueError) as error:  # the hub's errors are of these
        raise UserError(f"checkpoint={name}: is neither a file or folder nor on the hub ({one_line(error)})") from error


def latest_checkpoint(runs: str | Path = "runs/train") -> Path:
    """The latest training run's pose model below the working directory; `UserError` where there is none.

    Runs of priors are passed over, and those that diverged.
    """
    found = sorted(Path(runs).glob(f"*/{FOLDER}/{LAST}"), key=lambda file: file.stat().st_mtime, reverse=True)
    for file in found:
        best = _in_folder(file.parents[1])
        checkpoint = read_checkpoint(best)
        finite = all(each.isfinite().all() for each in checkpoint["state_dict"].values())
        if finite and issubclass(registry.get("model", checkpoint[RECIPE]["model"]["name"]), PoseModel):
            return best
    raise UserError(f"checkpoint={LATEST}: there is no training run of a model in {Path(runs).absolute()}")


def describe(checkpoint: Path) -> str:
    """A checkpoint in words, for the terminal."""
    if checkpoint.is_relative_to(SHIPPED):
        return f"{checkpoint.parent.name}, which ships with lp_framework (trained on the twelve embedded objects)"
    return str(checkpoint)


def load_model(path: str | Path) -> PoseModel:
    """The pose model of a checkpoint file or a run's folder, ready for use.

    Raises `UserError` naming the file when it is missing, damaged, or its weights do not fit the model it names.
    """
    file = find_checkpoint(path)
    model = restore(file, read_checkpoint(file))
    if not isinstance(model, PoseModel):
        raise UserError(f"{file}: holds a prior, not a model of the pose; use it with prior=tiny prior.path={path}")
    return model


def restore(file: Path, checkpoint: dict[str, Any]) -> TrainedModule:
    """The trained module that a checkpoint (see `read_checkpoint`) holds; `file` names it in errors."""
    recipe = checkpoint[RECIPE]
    try:
        settings = dict(recipe["backbone"])
        if settings.get("pretrained") and not settings.get("frozen"):
            settings["pretrained"] = False  # trained along, so all its weights are in the checkpoint
        backbone = registry.build("backbone", settings)
        model: TrainedModule = registry.build("model", recipe["model"], backbone=backbone)
        model.on_load_checkpoint(checkpoint)
    except UserError as error:
        raise UserError(f"{file}: {error}") from error
    except (ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError, TypeError, ValueError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise UserError(f"{file}: describes no model that can be built ({reason})") from error
    kind = recipe["model"]["name"]
    try:
        missing, unexpected = model.load_state_dict(checkpoint["state_dict"], strict=False)
    except RuntimeError as error:  # of other shapes
        raise UserError(
            f"{file}: its weights are of another {kind} model: {str(error).splitlines()[-1].strip()}"
        ) from error
    if missing or unexpected:
        raise UserError(
            f"{file}: its weights are of another {kind} model: missing {missing[:2]}, unknown {unexpected[:2]}"
        )
    return model.eval().requires_grad_(False)
