"""Training and evaluation runs that take about a second: a tiny backbone as a plugin, commands here or in a process."""

from __future__ import annotations

import contextlib
import copy
import io
import json
import os
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.core.config_store import ConfigStore
from matplotlib.figure import Figure
from view_folders import write_objects

from lp_framework import cli, registry

ROOT = Path(__file__).parents[1]
OBJECTS = {"cup": "unique", "mug": "unique", "tram": "twofold", "vase": "continuous"}

BACKBONE = '''
    import time

    import torch
    from torch import Tensor, nn

    from lp_framework.models.backbones import Backbone
    from lp_framework.registry import register


    class Pause(nn.Module):
        def __init__(self, seconds: float) -> None:
            super().__init__()
            self.seconds = seconds

        def forward(self, features: Tensor) -> Tensor:
            time.sleep(self.seconds)
            return features


    @register("backbone", "tmp_tiny")
    class Tiny(Backbone):
        """One fixed convolution and a linear head that takes its time."""

        def __init__(self, frozen: bool = True, draw: int = 0, pause: float = 0.0) -> None:
            super().__init__()
            self.image_size, self.trunk_dim, self.feature_dim, self.frozen = 16, 32, 8, frozen
            self.net = nn.Sequential(nn.Conv2d(3, 8, 5), nn.ReLU(), nn.AdaptiveAvgPool2d(2), nn.Flatten())
            weight = self.net[0].weight
            with torch.no_grad():
                weight.copy_(torch.randn(weight.shape, generator=torch.Generator().manual_seed(draw)) / 5)
                self.net[0].bias.zero_()
            self.net.requires_grad_(not frozen)
            self.head = nn.Sequential(Pause(pause), nn.Linear(32, 8))

        def trunk_module(self) -> nn.Module:
            return self.net

        def trunk_features(self, images: Tensor) -> Tensor:
            return self.net(images)
'''


@dataclass
class Ran:
    """A finished command: exit status, output and folder."""

    status: int
    out: str
    err: str
    folder: Path

    def json(self, name: str = "results.json") -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.folder / name).read_text())
        return content

    def checkpoint(self, name: str = "last.ckpt") -> dict[str, Any]:
        content: dict[str, Any] = torch.load(self.folder / "checkpoints" / name, weights_only=True)
        return content

    @property
    def error(self) -> str:
        """The message of a user error, one sentence."""
        lines = self.err.splitlines()
        assert self.status == 1 and len(lines) == 1 and lines[0].startswith("error: "), self.err
        return lines[0].removeprefix("error: ")


class Commands:
    """Commands, a folder each, in a working folder with views in `views` and the tiny backbone in `plugins`.

    The training runs in the folder `trained` are copied into it.
    """

    def __init__(self, folder: Path, train_views: int = 9, test_views: int = 4, trained: Path | None = None) -> None:
        self.folder = folder
        if trained is not None:
            shutil.copytree(trained, folder, dirs_exist_ok=True)
        write_objects(folder / "views", OBJECTS, train=train_views, test=test_views)
        (folder / "plugins" / "tmp_tiny").mkdir(parents=True)
        (folder / "plugins" / "tmp_tiny" / "tmp_tiny.py").write_text(textwrap.dedent(BACKBONE))

    def arguments(self, name: str, command: str, *overrides: str) -> list[str]:
        """A command line with the tiny settings; what is given overrides them."""
        settings = {"data": "renderings", "data.path": "views", "data.image_size": "16", "hydra.run.dir": name}
        if command == "train":
            settings |= {
                "backbone": "tmp_tiny", "data.block": "3", "data.batch_pairs": "40",
                "data.validation_views": "3", "trainer.max_epochs": "3", "logger": "csv",
            }  # fmt: skip
            if "model=prior" not in overrides:
                settings["model.hidden"] = "16"
        if command == "eval":
            settings["pictures"] = "false"  # they take most of a run's time
        if command in ("convert", "estimate", "report") or any(
            override.startswith("resume=") for override in overrides
        ):
            settings = {"hydra.run.dir": name}
        settings |= dict(override.split("=", 1) for override in overrides if not override.startswith("-"))
        options = [override for override in overrides if override.startswith("-")]
        return [command, *options, *(f"{key}={value}" for key, value in settings.items())]

    def here(self, name: str, command: str, *overrides: str) -> Ran:
        """Run in this process. A training's picture, which other tests are about, is left empty."""
        out, err = io.StringIO(), io.StringIO()
        drawing = undrawn() if command == "train" else contextlib.nullcontext()
        with _aside(self.folder), drawing, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            sys.argv = ["lp", *self.arguments(name, command, *overrides)]
            status = cli.main()
        return Ran(status, out.getvalue(), err.getvalue(), self.folder / name)

    def start(self, name: str, command: str, *overrides: str) -> subprocess.Popen[str]:
        """Start a subprocess."""
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        line = [sys.executable, "-m", "lp_framework", *self.arguments(name, command, *overrides)]
        pipe = subprocess.PIPE
        return subprocess.Popen(line, cwd=self.folder, env=environment, stdout=pipe, stderr=pipe, text=True)

    def process(self, name: str, command: str, *overrides: str) -> Ran:
        """Run in a subprocess."""
        process = self.start(name, command, *overrides)
        out, err = process.communicate(timeout=300)
        return Ran(process.returncode, out, err, self.folder / name)


@contextlib.contextmanager
def undrawn() -> Iterator[None]:
    """Figures are made, but saved without drawing them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda self, file, **_: Path(file).touch())
        yield


@contextlib.contextmanager
def _aside(folder: Path) -> Iterator[None]:
    """Restore what a command changes in this process."""
    here, argv, path = Path.cwd(), sys.argv, list(sys.path)
    state, deterministic = registry._state, torch.are_deterministic_algorithms_enabled()
    registry._state = copy.deepcopy(state)
    store, configs = ConfigStore.instance(), copy.deepcopy(ConfigStore.instance().repo)
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(here)
        sys.argv, sys.path[:] = argv, path
        registry._state = state
        store.repo = configs
        torch.use_deterministic_algorithms(deterministic)
        for name in [name for name in sys.modules if name.startswith("tmp_tiny")]:
            del sys.modules[name]
