"""From a composed config to objects, and what every run records of itself."""

from __future__ import annotations

import hashlib
import importlib.metadata
import inspect
import json
import logging
import platform
import subprocess
import typing
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning import Trainer, seed_everything
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import Logger
from lightning.pytorch.strategies import ModelParallelStrategy, StrategyRegistry
from omegaconf import DictConfig, OmegaConf
from torch import nn

from lp_framework import registry
from lp_framework.api import TINY_KNOWS
from lp_framework.composition import one_line
from lp_framework.data.module import PairDataModule
from lp_framework.errors import UserError
from lp_framework.models.checkpoints import SHIPPED, default_checkpoint, find_checkpoint, load_model
from lp_framework.solvers.base import Solver

log = logging.getLogger(__name__)

TRAINING = "training.json"  # what a training run says of itself
DIVIDED = "model_parallel"  # the strategy that divides a prior among processes; Lightning has no name for it
if DIVIDED not in StrategyRegistry.available_strategies():
    StrategyRegistry.register(DIVIDED, ModelParallelStrategy, description="a prior divided among the processes")

# Beginnings of warnings, mostly Lightning's, on which a user of a command cannot or need not act.
OF_NO_USE = (
    r"The '\w+' does not have many workers",  # batches come from memory, in this process
    r"Detected pickle protocol \d+ in the checkpoint",  # it is refused with a sentence of ours
    r"`isinstance\(treespec, LeafSpec\)` is deprecated",
    r"The number of training batches .* is smaller than the logging interval",
    r"Found \d+ module\(s\) in eval mode at the start of training",  # a frozen trunk
    r"Experiment logs directory .* exists and is not empty",  # it is the run's folder
    r"Checkpoint directory .* exists and is not empty",
    r"Total length of `DataLoader` across ranks is zero",  # an evaluation of which only the tables were missing
)


@contextmanager
def orderly_console() -> Iterator[None]:
    """Lightning's notes go to the run's log alone; warnings go to the log and, one line each, to the console."""
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        notes = logging.getLogger(name)
        notes.handlers.clear()  # Hydra's handlers, above it, take over
        notes.propagate = True

    def show(
        message: Warning | str, category: type[Warning], filename: str, lineno: int,
        file: TextIO | None = None, line: str | None = None,
    ) -> None:  # fmt: skip
        log.warning("%s", " ".join(str(message).split()))

    with warnings.catch_warnings():
        for beginning in OF_NO_USE:
            warnings.filterwarnings("ignore", beginning)
        warnings.showwarning = show
        yield


def build_data(config: DictConfig) -> PairDataModule:
    """The data module of a config, with its renderer."""
    renderer = None
    if "renderer" in registry.component_names(registry.get("data", config.data.name)):
        renderer = registry.build("renderer", config.renderer)
    data: PairDataModule = registry.build("data", config.data, renderer=renderer)
    return data


def build_solver(config: DictConfig, known: Path | None = None) -> tuple[Solver, Path | None]:
    """The solver of a config and the checkpoint of its model, with those of model and prior that it asks for.

    The model is that of the checkpoint `known`, else `config.checkpoint`, else the latest training run's, else the one
    that ships.
    """
    wanted = registry.component_names(registry.get("solver", config.solver.name))
    components: dict[str, Any] = {}
    checkpoint: Path | None = None
    if "model" in wanted:
        chosen = config.checkpoint if known is None else known
        checkpoint = default_checkpoint() if chosen is None else find_checkpoint(chosen)
        components["model"] = load_model(checkpoint)
    if "prior" in wanted:
        components["prior"] = registry.build("prior", config.prior)
    return registry.build("solver", config.solver, **components), checkpoint


def warn_of_unused(config: DictConfig) -> None:
    """Of a prior or a checkpoint that the command line names and the solver does not ask for, say so.

    Not in a sweep, which may go over solvers that do.
    """
    job, name = HydraConfig.get(), config.solver.name
    wanted = registry.component_names(registry.get("solver", name))
    named = {override.partition("=")[0].strip("+~").partition(".")[0] for override in job.overrides.task}
    for key, component in (("prior", "prior"), ("checkpoint", "model")):
        if key in named and component not in wanted and job.mode != RunMode.MULTIRUN:
            log.warning("%s=... has no effect: solver=%s takes no %s", key, name, component)


def warn_of_other_objects(checkpoint: Path, names: Sequence[str]) -> None:
    """Of a model that nobody chose: say so where it was trained on none of these objects."""
    try:
        trained = json.loads((checkpoint.parents[1] / TRAINING).read_text(encoding="utf-8"))["objects"]
    except (OSError, ValueError, LookupError, TypeError):  # the one that ships, or a run that was stopped
        return
    if isinstance(trained, list) and not {*names} & {*map(str, trained)}:
        log.warning("%s was trained on other objects than these; checkpoint=... chooses another model", checkpoint)


def model_origin(checkpoint: Path, chosen: object) -> str:
    """Which model a solver has, for the terminal; `chosen` is the config's `checkpoint`."""
    if checkpoint.is_relative_to(SHIPPED):
        return "the one that ships"
    found = "" if chosen is not None else " (of the latest training run; checkpoint=... for others)"
    return f"{checkpoint}{found}"


def seed_run(seed: object) -> None:
    """Seed the global random state, from which weights are initialised."""
    if not isinstance(seed, int) or not 0 <= seed < 2**32:
        raise UserError(f"seed must be a whole number between 0 and 2^32 - 1, got {seed}")
    seed_everything(seed, verbose=False)


def build_trainer(config: DictConfig, folder: Path, callbacks: list[Callback], logger: list[Logger]) -> Trainer:
    """Lightning's trainer with the settings of `config.trainer`."""
    epochs = config.trainer.get("max_epochs", 1)
    if not isinstance(epochs, int) or epochs < 0:
        raise UserError(f"trainer.max_epochs must be a number of epochs, got {epochs}")
    settings, hints = plain(config.trainer), typing.get_type_hints(Trainer.__init__)
    for key, value in settings.items():
        if key in hints and not registry.fits(value, hints[key]):
            kind = inspect.formatannotation(hints[key]).replace("typing.", "")
            raise UserError(f"trainer.{key}={value} is not of its type, {kind}")
    try:
        return Trainer(
            **settings,
            default_root_dir=folder,
            callbacks=callbacks,
            logger=logger,
            use_distributed_sampler=False,  # the data module's samplers know the processes
        )
    except (MisconfigurationException, ImportError, ValueError, TypeError) as error:
        raise UserError(f"trainer: {one_line(error)}") from error


def run_folder() -> Path:
    """The folder of this run, made if need be; relative to the working directory where it lies below it."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    folder.mkdir(parents=True, exist_ok=True)
    return folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder


def warn_of_photographs(prior: DictConfig) -> None:
    """Of the config of the prior that ships, say that it knows no photographs."""
    if prior.name == "tiny" and prior.path is None:
        log.warning("%s. For photographs: solver=ifusion prior=zero123xl prior.path=FOLDER", TINY_KNOWS)


def plain(config: DictConfig) -> dict[str, Any]:
    """A config as dicts, lists, names and numbers."""
    values: Any = OmegaConf.to_container(config, resolve=True)
    return {str(key): value for key, value in values.items()}


def weights_fingerprint(networks: Sequence[nn.Module], sample: int = 1024) -> str:
    """A text that changes when networks do: of every parameter and buffer its name, shape and first values.

    Training changes every tensor, so a `sample` of each tells; of large networks all of it would take long to read.
    """
    digest = hashlib.blake2b(digest_size=16)
    for network in networks:
        for name, value in network.state_dict().items():
            digest.update(f"{name} {tuple(value.shape)} {value.dtype}".encode())
            values = value.detach().flatten()[:sample].cpu().contiguous()
            digest.update(values.view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def versions() -> dict[str, str]:
    """Versions of what computes, and the commit of the source tree where there is one, `-dirty` if it was changed."""
    packages = ("lp_framework", "torch", "torchvision", "lightning", "numpy", "trimesh", "pyrender")
    found = {name: importlib.metadata.version(name) for name in packages}
    return {"python": platform.python_version(), **found, "git": _git_state()}


def _git_state() -> str:
    here = Path(__file__).parents[2]
    if not (here / ".git").exists():
        return "not a checkout"
    try:
        command = ["git", "-C", str(here), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
