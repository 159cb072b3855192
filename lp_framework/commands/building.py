"""Build objects from a composed config, and record facts about each run."""

from __future__ import annotations

import hashlib
import importlib.metadata
import logging
import platform
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning import Trainer, seed_everything
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf
from torch import nn

from lp_framework import registry
from lp_framework.api import TINY_WARNING, best_device
from lp_framework.atomic import DiskFull
from lp_framework.data.module import PairDataModule
from lp_framework.data.views import ViewSource
from lp_framework.errors import UserError, one_line
from lp_framework.models.checkpoints import AtomicCheckpointIO, describe, find_checkpoint, load_model
from lp_framework.run_folders import relative

log = logging.getLogger(__name__)

TRAINING = "training.json"  # the record of a training run


def plain(config: DictConfig) -> dict[str, Any]:
    """A config as dicts, lists, names and numbers."""
    values: Any = OmegaConf.to_container(config, resolve=True)
    return {str(key): value for key, value in values.items()}


class Components:
    """The objects chosen by a config, each built once on first access: `components["solver"]`.

    An object receives the components that its constructor declares. If the config has no group `model`, the model is
    loaded from the given checkpoint or, by default, from the setting `checkpoint`.
    """

    def __init__(self, settings: Mapping[str, Any], checkpoint: Path | None = None) -> None:
        self.settings, self.checkpoint = settings, checkpoint
        self._built: dict[str, Any] = {}

    def __getitem__(self, group: str) -> Any:
        if group not in self._built:
            self._built[group] = self._build(group)
        return self._built[group]

    def needs(self, group: str) -> list[str]:
        """The components required by the chosen member of a group."""
        return registry.component_names(registry.get(group, self.settings[group]["name"]))

    def test_views(self, protocol: str = "ordered") -> PairDataModule:
        """The data, prepared for a protocol's pairs of test views."""
        data: PairDataModule = self["data"]
        data.evaluate_on(protocol, self.settings.get("seed", 0))
        data.prepare_data()
        return data

    def record(self) -> dict[str, Any]:
        """What results record about their run."""
        return {"seed": self.settings["seed"], "config": self.settings, "versions": versions()}

    def _build(self, group: str) -> Any:
        if group == "model" and group not in self.settings:
            if self.checkpoint is None:
                self.checkpoint = find_checkpoint(self.settings["checkpoint"])
            rank_zero_only(print)(f"model: {describe(self.checkpoint)}")
            return load_model(self.checkpoint)
        settings, components = self.settings[group], {each: self[each] for each in self.needs(group)}
        if group != "data":
            return registry.build(group, settings, **components)
        loader, _ = registry.parameters(PairDataModule)  # the rest of the settings belong to the source of views
        own = {key: value for key, value in settings.items() if key not in loader}
        shared = {key: value for key, value in settings.items() if key in loader}
        source: ViewSource = registry.build("data", own, **components)
        return PairDataModule(source, **registry.checked(PairDataModule.__init__, shared, "data."))


def warn_of_unused(components: Components) -> None:
    """Warn if a prior or checkpoint named on the command line has no effect on this solver; silent in sweeps."""
    job, name = HydraConfig.get(), components.settings["solver"]["name"]
    named = {override.partition("=")[0].strip("+~").partition(".")[0] for override in job.overrides.task}
    needed = {*components.needs("solver"), *(components.needs("start") if "start" in components.settings else ())}
    for key, component in (("prior", "prior"), ("checkpoint", "model")):
        if key in named and component not in needed and job.mode != RunMode.MULTIRUN:
            log.warning("%s=... has no effect: solver=%s takes no %s", key, name, component)


def warn_of_photographs(prior: Mapping[str, Any]) -> None:
    """Warn if the settings `prior` choose the bundled prior, which does not support photographs."""
    if prior["name"] == "tiny" and prior["path"] is None:
        log.warning("%s. For photographs: solver=ifusion prior=zero123xl prior.path=FOLDER", TINY_WARNING)


def begin(config: DictConfig) -> tuple[Path, torch.device, Components]:
    """Set up a run without a trainer: return its folder, the device of `accelerator`, and the components.

    `accelerator` is `auto` (a GPU if there is one), `cpu`, or the type of a GPU, `cuda` or `mps`.
    """
    folder = run_folder()
    seed_run(config.get("seed", 0))
    best = best_device()
    if config.accelerator not in ("auto", "cpu", best.type):
        choices = " or ".join(dict.fromkeys(["auto", "cpu", best.type]))
        raise UserError(f"accelerator={config.accelerator} is not available on this machine; choose {choices}")
    device = torch.device("cpu") if config.accelerator == "cpu" else best
    return folder, device, Components(plain(config))


def seed_run(seed: object) -> None:
    """Seed the global random state, which initializes weights."""
    if not isinstance(seed, int) or not 0 <= seed < 2**32:
        raise UserError(f"seed must be a whole number between 0 and 2^32 - 1, got {seed}")
    seed_everything(seed, verbose=False)


def build_trainer(
    settings: Mapping[str, Any], folder: Path, callbacks: list[Callback], logger: list[Logger]
) -> Trainer:
    """Build Lightning's trainer with `settings` as its arguments."""
    arguments = registry.checked(Trainer.__init__, settings, "trainer.")
    try:
        return Trainer(
            **arguments,
            default_root_dir=folder,
            callbacks=callbacks,
            logger=logger,
            plugins=[AtomicCheckpointIO()],
            use_distributed_sampler=False,  # the data module's samplers handle the processes
        )
    except (MisconfigurationException, ImportError, ValueError, TypeError) as error:
        raise UserError(f"trainer: {one_line(error)}") from error


def run_folder() -> Path:
    """Create and return the folder of this run, relative to the working directory if it is inside it."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    folder.mkdir(parents=True, exist_ok=True)
    return relative(folder)


@contextmanager
def resumable(folder: Path, kept: str) -> Iterator[None]:
    """Explain how to resume a run that is interrupted or fills the disk, if its `folder` has files in `kept`."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit, DiskFull) as error:  # Lightning exits after an interruption
        saved = any((folder / kept).glob("*"))
        if not isinstance(error, DiskFull):
            raise KeyboardInterrupt(f"interrupted; to continue: resume={folder}" if saved else "interrupted") from error
        if not saved:
            raise
        raise DiskFull(f"{error}; free some space, then continue with resume={folder}") from error


def with_overrides(previous: DictConfig, config: DictConfig, changeable: tuple[str, ...], saved: Path) -> DictConfig:
    """The config of a resumed run: `previous`, loaded from `saved`, with the changes of the command line.

    Raises `UserError` if a changed key does not start with one of `changeable`.
    """
    overrides = HydraConfig.get().overrides.task
    keys = {override.partition("=")[0].strip("+~") for override in overrides} - {"resume", "plugins"}
    for key in sorted(keys):
        if not key.startswith(changeable):
            raise UserError(f"{key} cannot be changed in a resumed run; leave it out ({saved} has its value)")
        OmegaConf.update(previous, key, OmegaConf.select(config, key), merge=False, force_add=True)
    return previous


def weights_fingerprint(networks: Sequence[nn.Module], sample: int = 1024) -> str:
    """Hash networks by the name, shape, dtype and first `sample` values of every parameter and buffer."""
    digest = hashlib.blake2b(digest_size=16)
    for network in networks:
        for name, value in network.state_dict().items():
            digest.update(f"{name} {tuple(value.shape)} {value.dtype}".encode())
            values = value.detach().flatten()[:sample].cpu().contiguous()
            digest.update(values.view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def versions() -> dict[str, str]:
    """Package versions and the commit of the source tree, if there is one, with `-dirty` if it was modified."""
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
