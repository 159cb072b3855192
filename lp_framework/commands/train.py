"""`train`: fit a model of the relative pose; a killed run goes on with `resume=RUN_FOLDER`."""

from __future__ import annotations

import math
import shlex
import warnings
from pathlib import Path
from typing import Any

from lightning import Trainer, seed_everything
from lightning.pytorch.callbacks import (
    Callback,
    EarlyStopping,
    EMAWeightAveraging,
    LearningRateMonitor,
    ModelCheckpoint,
    RichProgressBar,
)
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from lp_framework import registry
from lp_framework.commands.building import build_data, plain, run_folder, versions
from lp_framework.errors import UserError
from lp_framework.evaluation.tables import write_json
from lp_framework.models.checkpoints import BEST, FOLDER, LAST, RECIPE, KeepRecipe, read_checkpoint


def run(config: DictConfig) -> None:
    """Train into this run's folder, or go on in the folder that `resume` names."""
    folder = run_folder()
    last = None
    if config.resume is not None:
        folder = Path(config.resume)
        last = folder / FOLDER / LAST
        config = resumed_config(folder, config)
    recipe = {"model": plain(config.model), "backbone": plain(config.backbone)}
    if last is not None and read_checkpoint(last)[RECIPE] != recipe:
        raise UserError(f"{last}: is of another model than this config's; a resumed run keeps its model and backbone")
    seed_everything(config.seed, verbose=False)
    data = build_data(config)
    backbone = registry.build("backbone", config.backbone)
    model = registry.build("model", config.model, backbone=backbone)
    if backbone.frozen:
        data.cache_features(backbone)
    trainer = Trainer(
        **plain(config.trainer),
        default_root_dir=folder,
        callbacks=callbacks(config, folder, recipe),
        logger=loggers(config, folder),
        use_distributed_sampler=False,  # the data module's samplers know the processes
    )
    if trainer.is_global_zero:
        OmegaConf.save(config, folder / "config.yaml")
    with warnings.catch_warnings():
        # Batches come from memory, in this process.
        warnings.filterwarnings("ignore", ".*does not have many workers.*")
        trainer.fit(model, datamodule=data, ckpt_path=last, weights_only=True if last else None)
    if trainer.is_global_zero:
        report(trainer, folder, config, recipe)


def resumed_config(folder: Path, config: DictConfig) -> DictConfig:
    """The config of the run in `folder`; what else the command line says would be lost, so it must not differ."""
    saved = folder / "config.yaml"
    if not (folder / FOLDER / LAST).is_file() or not saved.is_file():
        raise UserError(f"resume={folder}: holds no {FOLDER}/{LAST} to go on from; give a training run's folder")
    previous = OmegaConf.load(saved)
    assert isinstance(previous, DictConfig)
    # A run may be prolonged or moved to other devices; all else stays as it was.
    previous.trainer = OmegaConf.merge(
        previous.trainer, {"max_epochs": max(previous.trainer.max_epochs, config.trainer.max_epochs)}
    )
    return previous


def callbacks(config: DictConfig, folder: Path, recipe: dict[str, Any]) -> list[Callback]:
    """Lightning's own parts: checkpoints (best, last), early stopping, moving average, rates, progress."""
    validated = config.data.validation_views > 0
    chosen: list[Callback] = [KeepRecipe(**recipe), LearningRateMonitor("step"), RichProgressBar(leave=False)]
    if config.ema is not None:
        chosen.append(EMAWeightAveraging(decay=config.ema))
    if validated and config.patience is not None:
        chosen.append(EarlyStopping("val/loss", patience=config.patience))
    best = {"monitor": "val/loss", "filename": Path(BEST).stem} if validated else {"filename": Path(BEST).stem}
    chosen.append(
        ModelCheckpoint(
            folder / FOLDER, **best, save_last=True, enable_version_counter=False, save_on_train_epoch_end=True
        )
    )
    return chosen


def loggers(config: DictConfig, folder: Path) -> list[Logger]:
    """CSV always, as `metrics.csv` in the run's folder; TensorBoard by config."""
    chosen: list[Logger] = [CSVLogger(folder, name="", version="")]
    if config.logger.tensorboard:
        chosen.append(TensorBoardLogger(folder, name="tensorboard", version=""))
    return chosen


def report(trainer: Trainer, folder: Path, config: DictConfig, recipe: dict[str, Any]) -> None:
    """`training.json` and the closing lines."""
    losses = {key: value.item() for key, value in trainer.callback_metrics.items()}
    finite = {key: value for key, value in losses.items() if math.isfinite(value)}
    write_json(
        folder / "training.json",
        {**recipe, "seed": config.seed, "epochs": trainer.current_epoch, "steps": trainer.global_step,
         "final": losses, "versions": versions()},
    )  # fmt: skip
    console = Console(soft_wrap=True, highlight=False)
    console.print(", ".join(f"{key} {value:.4f}" for key, value in sorted(finite.items())))
    console.print(f"model:   {folder / FOLDER / BEST}")
    console.print(f"next:    python -m lp_framework eval checkpoint={shlex.quote(str(folder))}")
