"""Shared fixtures: a clean registry, the command line in this process, temporary plugins."""

from __future__ import annotations

import copy
import importlib
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hypothesis import settings
from omegaconf import OmegaConf
from tiny_runs import Commands, undrawn

from lp_framework import cli, registry, torchvision_ops

torchvision_ops.install()
Plugins.instance()  # Hydra stores the configs of its own plugins once, too
torch.set_num_threads(1)  # as in subprocesses of tests, so that results are bit-identical
# The same examples in every run; `--hypothesis-profile=default` searches for new ones.
settings.register_profile("same", derandomize=True, database=None, deadline=None)
settings.load_profile("same")
for group in registry.GROUPS:  # built-ins register only on first import, which must not be inside `clean_registry`
    for package in registry.GROUPS[group]:
        importlib.import_module(package)


def parsed_once(load: Callable[..., Any]) -> Callable[[Any], Any]:
    """OmegaConf's reader of YAML, which takes a quarter of a command's composition, but once for the same text."""
    read: dict[str, Any] = {}

    def load_once(file: Any) -> Any:
        if not hasattr(file, "read"):
            return load(file)
        begin, text = file.tell(), file.read()
        if text not in read:
            file.seek(begin)
            read[text] = load(file)
        return copy.deepcopy(read[text])

    return load_once


OmegaConf.load = staticmethod(parsed_once(OmegaConf.load))  # type: ignore[method-assign]
ROOT = Path(__file__).parents[1]
collect_ignore = ["mock_device.py", "on_mock_device.py"]  # run in a separate process


@dataclass
class Finished:
    """A finished command: exit status and output."""

    status: int
    out: str
    err: str

    @property
    def error(self) -> str:
        """The error message, one sentence."""
        lines = self.err.splitlines()
        assert len(lines) == 1 and lines[0].startswith("error: "), self.err
        return lines[0].removeprefix("error: ")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run modules with heavy tests first: short tests at the end keep all test processes busy until then."""
    heavy = {item.path for item in items if item.get_closest_marker("heavy")}
    items.sort(key=lambda item: item.path not in heavy)


@pytest.fixture
def clean_registry(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Undo what a test registers or discovers."""
    before = set(sys.modules)
    monkeypatch.setattr(registry, "_state", copy.deepcopy(registry._state))
    monkeypatch.setattr(ConfigStore.instance(), "repo", copy.deepcopy(ConfigStore.instance().repo))
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield
    for name in set(sys.modules) - before:
        if name.partition(".")[0].startswith("tmp_"):  # modules that tests write are named so
            del sys.modules[name]


@pytest.fixture
def lp(
    clean_registry: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., Finished]:
    """`lp("train", "model=score")` in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)

    def run(*arguments: str) -> Finished:
        monkeypatch.setattr(sys, "argv", ["lp", *arguments])
        capsys.readouterr()
        try:
            status = cli.main()
        except SystemExit as stop:  # Hydra's --help
            status = int(stop.code or 0)
        return Finished(status, *capsys.readouterr())

    return run


@pytest.fixture
def no_drawing() -> Iterator[None]:
    """Figures are made, but saved without drawing them, which takes most of a command's time."""
    with undrawn():
        yield


@pytest.fixture
def lp_process(tmp_path: Path) -> Callable[..., Finished]:
    """The same in a subprocess."""

    def run(*arguments: str, cwd: Path = tmp_path) -> Finished:
        environment = {key: value for key, value in os.environ.items() if key != "HYDRA_FULL_ERROR"}
        environment["PYTHONPATH"] = str(ROOT)
        command = [sys.executable, "-m", "lp_framework", *arguments]
        done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=120)
        return Finished(done.returncode, done.stdout, done.stderr)

    return run


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a training run of a score model in `score` and of an energy model in `energy`, one epoch each."""
    commands = Commands(tmp_path_factory.mktemp("trained"))
    folder = tmp_path_factory.mktemp("models")
    for model in ("score", "energy"):
        ran = commands.here(model, "train", f"model={model}", "trainer.max_epochs=1")
        assert ran.status == 0, ran.err
        ran.folder.rename(folder / model)
    return folder


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str, str], Path]:
    """`write("folder/file", text)` under the test's folder."""

    def write_file(path: str, text: str) -> Path:
        file = tmp_path / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(textwrap.dedent(text))
        return file

    return write_file


@pytest.fixture
def walker(tmp_path: Path, write: Callable[[str, str], Path]) -> Path:
    """A working folder whose `plugins/` has a solver and a model, and whose `configs/demo.yaml` chooses them."""
    write(
        "plugins/walker/tmp_walker.py",
        '''
        from __future__ import annotations

        from typing import Literal

        from lp_framework.registry import register


        @register("solver", "walk")
        class Walk:
            """Walks downhill."""

            def __init__(
                self, model: object, gamma: float = 0.3, steps: int = 50, limit: float | None = None,
                order: Literal["first", "second"] = "first", sizes: tuple[int, int] = (1, 2),
            ) -> None:
                self.model, self.gamma, self.steps, self.limit, self.sizes = model, gamma, steps, limit, sizes


        @register("solver", "jump")
        class Jump:
            """Jumps."""

            def __init__(self, height: float) -> None:
                self.height = height


        @register("model", "net")
        class Net:
            """A network."""

            def __init__(self, width: int = 3) -> None:
                self.width = width
        ''',
    )
    write("plugins/walker/conf/solver/walk.yaml", "steps: 7\n")
    write("plugins/walker/conf/solver/long_walk.yaml", "name: walk\nsteps: 700\n")
    write(
        "configs/demo.yaml",
        """
        # A demo of the help.
        defaults:
          - base
          - solver: walk
          - model: net
          - experiment: null
          - _self_
        seed: 0 # of every draw
        """,
    )
    write("configs/experiment/hike.yaml", "# @package _global_\nsolver: {steps: 60}\n")
    write("configs/experiment/broken.yaml", "# @package _global_\nsolver: {stepz: 60}\n")
    return tmp_path
