"""From a composed config to objects, and what every run records of itself."""

from __future__ import annotations

import importlib.metadata
import logging
import platform
import subprocess
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from lp_framework import registry
from lp_framework.data.module import PairDataModule

log = logging.getLogger(__name__)

# Beginnings of warnings, mostly Lightning's, on which a user of a command cannot or need not act.
OF_NO_USE = (
    r"The '\w+' does not have many workers",  # batches come from memory, in this process
    r"Detected pickle protocol \d+ in the checkpoint",  # it is refused with a sentence of ours
    r"`isinstance\(treespec, LeafSpec\)` is deprecated",
    r"The number of training batches .* is smaller than the logging interval",
    r"Found \d+ module\(s\) in eval mode at the start of training",  # a frozen trunk
    r"Experiment logs directory .* exists and is not empty",  # it is the run's folder
    r"Checkpoint directory .* exists and is not empty",
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


def run_folder() -> Path:
    """The folder of this run, made if need be."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def plain(config: DictConfig) -> dict[str, Any]:
    """A config as dicts, lists, names and numbers."""
    values: Any = OmegaConf.to_container(config, resolve=True)
    return {str(key): value for key, value in values.items()}


def versions() -> dict[str, str]:
    """Versions of what computes, and the state of the source tree where there is one."""
    packages = ("lp_framework", "torch", "torchvision", "lightning", "numpy", "trimesh", "pyrender")
    found = {name: importlib.metadata.version(name) for name in packages}
    return {"python": platform.python_version(), **found, "git": _git_state()}


def _git_state() -> str:
    here = Path(__file__).parents[2]
    if not (here / ".git").exists():
        return "not a checkout"
    try:
        command = ["git", "-C", str(here), "describe", "--always", "--dirty"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
