"""`train`: fit a model of the relative pose; `resume=RUN_FOLDER` resumes an interrupted run."""

from __future__ import annotations

import csv
import math
import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning import Trainer
from lightning.pytorch import callbacks
from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from lp_framework import catalogue, registry
from lp_framework.commands import building
from lp_framework.data.module import PairDataModule
from lp_framework.errors import UserError, optional_import
from lp_framework.evaluation.tables import write_csv, write_json, write_text
from lp_framework.models.checkpoints import BEST, FOLDER, LAST, ModelCheckpoint, read_checkpoint
from lp_framework.models.pose_model import PoseModel
from lp_framework.report.page import PAGE, write_run_page
from lp_framework.report.runs import saved_config
from lp_framework.viz.curves import save_training_picture

METRICS = "metrics.csv"
TRAIN_ONLY = ("batch_pairs", "block", "validation_views", "validation_objects", "seed")  # of data, not used by eval


def run(config: DictConfig) -> None:
    """Train into this run's folder. Resumes the run in the folder `resume`, or this run if it was stopped."""
    folder = building.run_folder() if config.resume is None else Path(config.resume)
    saved, last = folder / "config.yaml", folder / FOLDER / LAST
    resuming = last.is_file()
    if config.resume is not None:
        if not resuming:
            raise UserError(
                f"resume={folder}: contains no {FOLDER}/{LAST} to resume from; give the folder of a training run"
            )
        # A run may be extended or moved to other devices.
        config = building.with_overrides(OmegaConf.create(saved_config(saved)), config, ("trainer",), saved)
    elif resuming and saved_config(saved) != building.plain(config):  # never overwrite another training
        raise UserError(
            f"{folder}: contains a training run with other settings; resume it with resume={folder}, or choose another "
            "hydra.run.dir"
        )
    settings = building.plain(config)
    _check(settings)
    checkpoint, epochs = read_checkpoint(last) if resuming else {}, settings["trainer"]["max_epochs"]
    if resuming:
        reported = all((folder / name).is_file() for name in (building.TRAINING, PAGE))
        if epochs is not None and 0 < epochs <= checkpoint["epoch"] + 1 and reported:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                print(f"skipped (already finished): {folder}")
                return
            raise UserError(f"{folder}: all epochs are done; to train longer: resume={folder} trainer.max_epochs=N")
    building.seed_run(settings["seed"])
    components = building.Components(settings)
    data, model = components["data"], components["model"]
    model.recipe = {"model": settings["model"], "backbone": settings["backbone"]}
    if (extractor := model.extractor()) is not None:
        data.cache_features(extractor)
    data.with_points = model.needs_points
    loggers: list[Logger] = [MetricsLogger(folder, checkpoint.get("global_step", 0))]
    loggers += chosen_logger(settings["logger"], folder)
    trainer = building.build_trainer(settings["trainer"], folder, chosen_callbacks(settings, folder), loggers)
    if trainer.is_global_zero:
        write_text(saved, OmegaConf.to_yaml(config))
    with building.resumable(folder, FOLDER):
        trainer.fit(model, datamodule=data, ckpt_path=last if resuming else None, weights_only=True)
        if trainer.is_global_zero:
            report(trainer, folder, settings, data)


def _check(settings: Mapping[str, Any]) -> None:
    ema, patience = settings["ema"], settings["patience"]
    if settings["trainer"]["max_epochs"] == 0:
        raise UserError("trainer.max_epochs must be at least 1, got 0")
    if ema is not None and not (isinstance(ema, int | float) and 0 <= ema <= 1):
        raise UserError(f"ema must be a share from 0 to 1, or null for none; got {ema}")
    if patience is not None and not (isinstance(patience, int) and patience >= 0):
        raise UserError(f"patience must be a number of epochs, or null for no early stopping; got {patience}")


def chosen_callbacks(settings: Mapping[str, Any], folder: Path) -> list[callbacks.Callback]:
    """Lightning's callbacks: checkpoints (best, last), early stopping, EMA, learning rate, progress."""
    validated = settings["data"]["validation_views"] > 0
    chosen: list[callbacks.Callback] = [callbacks.LearningRateMonitor("step"), callbacks.RichProgressBar(leave=False)]
    if settings["ema"] is not None:
        chosen.append(callbacks.EMAWeightAveraging(decay=settings["ema"]))
    if validated and settings["patience"] is not None:
        chosen.append(callbacks.EarlyStopping("val/loss", patience=settings["patience"]))
    # Two callbacks: `save_last` alone would keep the last epoch only if it is also the best.
    for file, monitor, mode in ((BEST, "val/loss" if validated else None, "min"), (LAST, "epoch", "max")):
        named: dict[str, Any] = {"filename": Path(file).stem, "monitor": monitor, "mode": mode}
        chosen.append(
            ModelCheckpoint(folder / FOLDER, **named, enable_version_counter=False, save_on_train_epoch_end=True)
        )
    return chosen


def chosen_logger(settings: Mapping[str, Any], folder: Path) -> list[Logger]:
    """The Lightning logger chosen in addition to `MetricsLogger`; `UserError` if its package is missing."""
    install, name = "pip install 'lp_framework[loggers]'", settings.get("name")
    if name == "tensorboard":
        return [TensorBoardLogger(folder, name="tensorboard", version="")]
    if name == "wandb":
        optional_import("wandb", "logger=wandb", install)
        given = {key: settings[key] for key in ("project", "entity", "offline")}
        return [WandbLogger(folder.name, save_dir=folder, **given)]
    if name == "mlflow":
        optional_import("mlflow", "logger=mlflow", install)
        address = settings["tracking_uri"] or os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{folder}/mlflow.db"
        return [MLFlowLogger(settings["experiment"], folder.name, tracking_uri=address)]
    return []


def next_command(settings: Mapping[str, Any], folder: str) -> str:
    """The command that uses the trained model, on the data it was trained on and with the same plugins."""
    data, folders = settings["data"], ",".join(map(str, settings["plugins"]))
    plugins = [f"plugins={shlex.quote(f'[{folders}]')}"] if folders else []
    if not issubclass(registry.get("model", settings["model"]["name"]), PoseModel):
        return f"python -m lp_framework views prior.path={folder}"
    usual = catalogue.values("data", data["name"])
    changed = [
        f"data.{key}={shlex.quote(str(value))}"
        for key, value in data.items()
        if key not in ("name", *TRAIN_ONLY) and value != usual.get(key)
    ]
    chosen = [] if data["name"] == "toy" else [f"data={data['name']}"]
    return " ".join(["python -m lp_framework eval", *plugins, f"checkpoint={folder}", *chosen, *changed])


class MetricsLogger(Logger):
    """Logs to `METRICS` in a run's folder, always a complete file. A resumed run keeps the rows up to its checkpoint's
    step."""

    name = version = ""

    def __init__(self, folder: Path, steps: int = 0) -> None:
        super().__init__()
        self.file = folder / METRICS
        self.rows: list[dict[str, Any]] = []
        if self.file.is_file():
            with self.file.open(newline="") as content:
                self.rows += [row for row in csv.DictReader(content) if row["step"] and int(row["step"]) < steps]

    def log_hyperparams(self, *_: Any, **__: Any) -> None:
        """Ignored: see `config.yaml`."""

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Add a row; it is written to the file within 100 steps."""
        self.rows.append({**metrics, "step": step})
        if step is not None and (step + 1) % 100 == 0:
            self.save()

    @rank_zero_only
    def save(self) -> None:
        """Rewrite the file."""
        columns = sorted({column for row in self.rows for column in row})
        if self.rows:
            write_csv(self.file, columns, [[row.get(column, "") for column in columns] for row in self.rows])


def report(trainer: Trainer, folder: Path, settings: Mapping[str, Any], data: PairDataModule) -> None:
    """Write `TRAINING` and print the summary. The fingerprint covers all training views."""
    losses = {key: value.item() for key, value in trainer.callback_metrics.items()}
    finite = {key: value for key, value in losses.items() if math.isfinite(value)}
    chosen = {key: settings[key] for key in ("model", "backbone", "seed")}
    write_json(
        folder / building.TRAINING,
        {**chosen, "epochs": trainer.current_epoch, "steps": trainer.global_step, "final": losses,
         "objects": data.table("train").names, "fingerprints": {"views": data.fingerprint("all_train")},
         "versions": building.versions()},
    )  # fmt: skip
    if diverged := ", ".join(sorted({*losses} - {*finite})):
        raise UserError(f"{folder}: training diverged (not finite: {diverged}); lower model.learning_rate")
    console = Console(soft_wrap=True, highlight=False, markup=False)
    console.print(", ".join(f"{key} {value:.4f}" for key, value in sorted(finite.items())))
    console.print(f"model:   {folder / FOLDER / BEST}")
    for picture in save_training_picture(folder):
        console.print(f"picture: {picture}")
    console.print(f"page:    {write_run_page(folder, 'train')}")
    console.print(f"next:    {next_command(settings, shlex.quote(str(folder)))}")
