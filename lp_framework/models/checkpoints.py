"""Trained models on disk. Beside the weights there are only names and numbers, so loading never executes code.

A checkpoint is a file written by training, or a folder like those bundled with this package or shared by users:

model.json           configs of model and backbone by registered name, fingerprint of the frozen trunk
model.safetensors    the weights
config.yaml, metrics.csv, training.png    their origin: the run's config with its seed, and the training curve
"""

from __future__ import annotations

import io
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from textwrap import shorten
from typing import Any

import torch
from lightning.pytorch import callbacks
from lightning.pytorch.plugins.io import TorchCheckpointIO
from safetensors.torch import load_file, save_file

from lp_framework import registry
from lp_framework.atomic import written
from lp_framework.data.files import expecting, read_json, written_folder
from lp_framework.errors import UserError, one_line, optional_import
from lp_framework.models.pose_model import PoseModel
from lp_framework.models.trained_module import RECIPE, TrainedModule
from lp_framework.run_folders import relative

FOLDER = "checkpoints"
LATEST = "latest"
LAST, BEST = "last.ckpt", "best.ckpt"
TRAINED_ON = {"general": "3,940 procedural objects"}
SHIPPED = Path(__file__).parents[1] / "weights"  # folders of the bundled models
CONFIG, WEIGHTS = "model.json", "model.safetensors"
ORIGIN = ("config.yaml", "training.json", "metrics.csv", "training.png")  # files copied from a run's folder


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes Lightning's checkpoints atomically. Lightning itself copies them over the old ones from the system's
    temporary folder if that is on another disk."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write a checkpoint next to the one it replaces; raises `UserError` with its name on failure."""
        content = io.BytesIO()  # given a file, torch raises its own error for a full disk
        torch.save(checkpoint, content)
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with written(relative(Path(path))) as partial:
            partial.write_bytes(content.getbuffer())


class ModelCheckpoint(callbacks.ModelCheckpoint):
    """Lightning's `ModelCheckpoint` with paths relative to the run's checkpoint folder, so that a run can be moved.

    It keeps Lightning's class name, which is stored in checkpoints, so that earlier runs can be resumed.
    """

    def state_dict(self) -> dict[str, Any]:
        """Lightning's state with file names instead of paths."""
        return _mapped(super().state_dict(), lambda path: Path(path).name) | {"dirpath": ""}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load a state saved in any folder, with its paths moved to this folder."""
        folder = Path(str(self.dirpath))
        state = _mapped(state_dict, lambda path: str(folder / Path(path).name))
        super().load_state_dict(state | {"dirpath": self.dirpath})


def _mapped(state: dict[str, Any], change: Callable[[str], str]) -> dict[str, Any]:
    """Apply `change` to all paths that are set in the state of a `ModelCheckpoint`."""
    paths = {key: change(path) for key, path in state.items() if key.endswith("_model_path") and path}
    scores = {change(path): score for path, score in state["best_k_models"].items()}
    return state | paths | {"best_k_models": scores}


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint file, or a model's folder given its safetensors file; raises `UserError` for anything else."""
    if path.name == WEIGHTS:
        return _read_folder(path.parent)
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise UserError(f"{path}: there is no such checkpoint") from None
    except Exception as error:  # a damaged pickle can raise anything
        message = f"{path}: is not a readable checkpoint (damaged, or contains more than numbers and text)"
        raise UserError(message) from error
    if not isinstance(checkpoint, dict) or not {RECIPE, "state_dict"} <= checkpoint.keys():
        raise UserError(f"{path}: is not a checkpoint written by `lp train`")
    return checkpoint


def _read_folder(folder: Path) -> dict[str, Any]:
    """Read the checkpoint in a folder, with weights in float32; raises `UserError` naming the faulty file."""
    with expecting(f"{folder / CONFIG}: is not the description of a trained model and its backbone"):
        config = dict(read_json(folder / CONFIG))
        recipe = {"model": config["model"], "backbone": config["backbone"]}
    with expecting(f"{folder / WEIGHTS}: is not a readable file of weights"):
        weights = load_file(folder / WEIGHTS)
    return {
        RECIPE: recipe,
        "trunk": config.get("trunk"),
        "state_dict": {key: each.float() if each.is_floating_point() else each for key, each in weights.items()},
    }


def write_model_folder(checkpoint: dict[str, Any], run: Path, folder: Path, dtype: torch.dtype) -> None:
    """Write a checkpoint of the run in `run` atomically, floating-point weights as `dtype`; `UserError` on failure."""
    weights = {
        key: (tensor.to(dtype) if tensor.is_floating_point() else tensor).contiguous()
        for key, tensor in checkpoint["state_dict"].items()
    }
    config = {**checkpoint[RECIPE], "trunk": checkpoint.get("trunk")}
    with written_folder(folder) as partial:
        save_file(weights, partial / WEIGHTS)
        (partial / CONFIG).write_text(json.dumps(config, indent=2) + "\n", encoding="utf-8")
        for name in ORIGIN:
            if (run / name).is_file():
                shutil.copyfile(run / name, partial / name)


def find_checkpoint(name: str | Path) -> Path:
    """Find the weights file for a value of `checkpoint=`.

    `name` is the name of bundled weights (`score`), `latest` (see `latest_checkpoint`), a checkpoint file, a run's
    folder (best checkpoint, or else the last), a folder written by `lp convert`, or the id of such a folder on the
    Hugging Face hub. Raises `UserError` if there is none."""
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
    raise UserError(f"{path}: contains no {FOLDER}/{BEST} or {LAST}; give a run's folder or a checkpoint file")


def _from_hub(name: str) -> Path:
    hub = optional_import("huggingface_hub", f"checkpoint={name}", "pip install 'lp_framework[zero123]'")
    try:
        return Path(hub.snapshot_download(name, allow_patterns=[WEIGHTS, CONFIG])) / WEIGHTS
    except (OSError, ValueError) as error:  # the hub's errors derive from these
        raise UserError(f"checkpoint={name}: is neither a file, a folder nor on the hub ({one_line(error)})") from error


def latest_checkpoint(runs: str | Path = "runs/train") -> Path:
    """Find the pose model of the latest training run that did not diverge; raises `UserError` if there is none."""
    found = sorted(Path(runs).glob(f"*/{FOLDER}/{LAST}"), key=lambda file: file.stat().st_mtime, reverse=True)
    for file in found:
        best = _in_folder(file.parents[1])
        checkpoint = read_checkpoint(best)
        finite = all(each.isfinite().all() for each in checkpoint["state_dict"].values())
        if finite and issubclass(registry.get("model", checkpoint[RECIPE]["model"]["name"]), PoseModel):
            return best
    raise UserError(f"checkpoint={LATEST}: there is no training run of a model in {Path(runs).absolute()}")


def describe(checkpoint: Path) -> str:
    """Describe a checkpoint for the terminal."""
    if checkpoint.is_relative_to(SHIPPED):
        name = checkpoint.parent.name
        objects = TRAINED_ON.get(name, "the twelve embedded objects")
        return f"{name}, which ships with lp_framework (trained on {objects})"
    return str(checkpoint)


def load_model(path: str | Path) -> PoseModel:
    """Load a pose model for inference, see `find_checkpoint`; raises `UserError` naming the faulty file."""
    file = find_checkpoint(path)
    model = restore(file, read_checkpoint(file))
    if not isinstance(model, PoseModel):
        raise UserError(f"{file}: contains a prior, not a pose model; use it with prior=tiny prior.path={path}")
    return model


def restore(file: Path, checkpoint: dict[str, Any]) -> TrainedModule:
    """Build the trained module in a checkpoint (see `read_checkpoint`); errors mention `file`."""
    try:
        with expecting("describes a model that cannot be built"):  # constructors can raise anything for odd values
            recipe = checkpoint[RECIPE]
            settings = dict(recipe["backbone"])
            if settings.get("pretrained") and not settings.get("frozen"):
                settings["pretrained"] = False  # not frozen, so all its weights are in the checkpoint
            backbone = registry.build("backbone", settings)
            model: TrainedModule = registry.build("model", recipe["model"], backbone=backbone)
            model.on_load_checkpoint(checkpoint)
    except UserError as error:
        raise UserError(f"{file}: {error}") from error
    try:
        model.load_state_dict(checkpoint["state_dict"])
    except Exception as error:  # for tensors of wrong shape or values that are not tensors
        reason = shorten(" ".join(str(error).splitlines()[1:2]), 200, placeholder=" ...")
        raise UserError(f"{file}: its weights do not fit its {recipe['model']['name']} model: {reason}") from error
    return model.eval().requires_grad_(False)
