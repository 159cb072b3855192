"""`train`: fit a model of the relative pose; a killed run goes on with `resume=RUN_FOLDER`."""

from __future__ import annotations

import csv
import math
import shlex
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning import Trainer
from lightning.pytorch import callbacks
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from lp_framework import catalogue, registry
from lp_framework.atomic import written
from lp_framework.commands import building
from lp_framework.data.module import PairDataModule
from lp_framework.errors import UserError
from lp_framework.evaluation.tables import write_csv, write_json, write_text
from lp_framework.models.checkpoints import BEST, FOLDER, LAST, ModelCheckpoint, read_checkpoint
from lp_framework.models.pose_model import PoseModel
from lp_framework.report.page import PAGE, write_run_page
from lp_framework.report.runs import saved_config
from lp_framework.viz.curves import save_training_picture

METRICS = "metrics.csv"  # Lightning's name
OF_TRAINING = ("batch_pairs", "block", "validation_views", "validation_objects", "seed")  # of data, without use in eval


def run(config: DictConfig) -> None:
    """Train into this run's folder, or go on in the folder that `resume` names, or where this very run was stopped."""
    folder = building.run_folder() if config.resume is None else Path(config.resume)
    saved, last = folder / "config.yaml", folder / FOLDER / LAST
    begun = last.is_file()
    if config.resume is not None:
        if not begun:
            raise UserError(f"resume={folder}: holds no {FOLDER}/{LAST} to go on from; give a training run's folder")
        # A run may be prolonged or moved to other devices.
        config = building.with_overrides(OmegaConf.create(saved_config(saved)), config, ("trainer",), saved)
    elif begun and saved_config(saved) != building.plain(config):  # what was learned is not overwritten
        raise UserError(
            f"{folder}: holds a training run with other settings; resume={folder} goes on with it, and this one wants "
            "another hydra.run.dir"
        )
    settings = building.plain(config)
    _check(settings)
    steps = 0
    if begun:
        checkpoint, epochs = read_checkpoint(last), settings["trainer"]["max_epochs"]
        steps = checkpoint["global_step"]
        reported = all((folder / name).is_file() for name in (building.TRAINING, PAGE))
        if epochs is not None and 0 < epochs <= checkpoint["epoch"] + 1 and reported:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                print(f"skipped, finished before: {folder}")
                return
            raise UserError(
                f"{folder}: has done all of its epochs; resume={folder} trainer.max_epochs=N would prolong it"
            )
    building.seed_run(settings["seed"])
    components = building.Components(settings)
    data, model = components["data"], components["model"]
    model.recipe = {"model": settings["model"], "backbone": settings["backbone"]}
    if (extractor := model.extractor()) is not None:
        data.cache_features(extractor)
    data.carry(*model.carries)
    metrics = MetricsLogger(folder, name="", version="")
    boards = [TensorBoardLogger(folder, name="tensorboard", version="")] if settings["logger"]["tensorboard"] else []
    trainer = building.build_trainer(
        settings["trainer"], folder, chosen_callbacks(settings, folder), logger=[metrics, *boards]
    )
    if trainer.is_global_zero:
        write_text(saved, OmegaConf.to_yaml(config))
        if begun:
            keep_metrics(metrics, steps)
    with building.resumable(folder, FOLDER):
        trainer.fit(model, datamodule=data, ckpt_path=last if begun else None, weights_only=True)
        if trainer.is_global_zero:
            report(trainer, folder, settings, data)


def _check(settings: Mapping[str, Any]) -> None:
    ema, patience = settings["ema"], settings["patience"]
    if settings["trainer"]["max_epochs"] == 0:
        raise UserError("trainer.max_epochs must be at least 1, got 0")
    if ema is not None and not (isinstance(ema, int | float) and 0 <= ema <= 1):
        raise UserError(f"ema must be a share from 0 to 1, or null for none; got {ema}")
    if patience is not None and not (isinstance(patience, int) and patience >= 0):
        raise UserError(f"patience must be a number of epochs, or null for no early stop; got {patience}")


def chosen_callbacks(settings: Mapping[str, Any], folder: Path) -> list[callbacks.Callback]:
    """Lightning's own parts: checkpoints (best, last), early stopping, moving average, rates, progress."""
    validated = settings["data"]["validation_views"] > 0
    chosen: list[callbacks.Callback] = [callbacks.LearningRateMonitor("step"), callbacks.RichProgressBar(leave=False)]
    if settings["ema"] is not None:
        chosen.append(callbacks.EMAWeightAveraging(decay=settings["ema"]))
    if validated and settings["patience"] is not None:
        chosen.append(callbacks.EarlyStopping("val/loss", patience=settings["patience"]))
    # A callback each: with `save_last` the last epoch would be kept only where it is the best one, too.
    for file, monitor, mode in ((BEST, "val/loss" if validated else None, "min"), (LAST, "epoch", "max")):
        named: dict[str, Any] = {"filename": Path(file).stem, "monitor": monitor, "mode": mode}
        chosen.append(
            ModelCheckpoint(folder / FOLDER, **named, enable_version_counter=False, save_on_train_epoch_end=True)
        )
    return chosen


def next_command(settings: Mapping[str, Any], folder: str) -> str:
    """The command that uses the trained model, on the data that it was trained on."""
    data = settings["data"]
    if not issubclass(registry.get("model", settings["model"]["name"]), PoseModel):
        return f"python -m lp_framework views prior.path={folder}"
    usual = catalogue.values("data", data["name"])
    changed = [
        f"data.{key}={shlex.quote(str(value))}"
        for key, value in data.items()
        if key not in ("name", *OF_TRAINING) and value != usual.get(key)
    ]
    chosen = [] if data["name"] == "toy" else [f"data={data['name']}"]
    return " ".join(["python -m lp_framework eval", f"checkpoint={folder}", *chosen, *changed])


class MetricsLogger(CSVLogger):
    """Lightning's, whose file, `METRICS` in the run's folder, is whole at any moment."""

    @rank_zero_only
    def save(self) -> None:
        """Write the file with the rows that came since as another, which takes its place."""
        file, writer = Path(self.log_dir) / METRICS, self.experiment
        if not writer.metrics:
            return
        with written(file) as partial:
            if file.is_file():
                shutil.copyfile(file, partial)
            writer.metrics_file_path = str(partial)
            super().save()


def keep_metrics(logger: MetricsLogger, steps: int) -> None:
    """Keep the rows of a run that goes on, up to its checkpoint's step: Lightning would begin the file anew."""
    file = Path(logger.log_dir) / METRICS
    if not file.is_file():
        return
    with file.open(newline="") as content:
        reader = csv.DictReader(content)
        rows = [list(row.values()) for row in reader if row["step"] and int(row["step"]) < steps]
    with written(file) as partial:
        write_csv(partial, columns := list(reader.fieldnames or ()), rows)
        logger.experiment.metrics_keys = columns  # it removes `file` when it is made


def report(trainer: Trainer, folder: Path, settings: Mapping[str, Any], data: PairDataModule) -> None:
    """`TRAINING` and the closing lines; the fingerprint is that of all training views."""
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
        raise UserError(f"{folder}: the training has diverged ({diverged}: not finite); lower model.learning_rate")
    console = Console(soft_wrap=True, highlight=False)
    console.print(", ".join(f"{key} {value:.4f}" for key, value in sorted(finite.items())))
    console.print(f"model:   {folder / FOLDER / BEST}")
    for picture in save_training_picture(folder):
        console.print(f"picture: {picture}")
    console.print(f"page:    {write_run_page(folder, 'train')}")
    console.print(f"next:    {next_command(settings, shlex.quote(str(folder)))}")
