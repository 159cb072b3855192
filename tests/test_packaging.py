"""Packaging: the wheel with its configs, a plugin as a package, compatible and incompatible torchvision."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest
from omegaconf import OmegaConf

pytest.importorskip("hatchling", reason="the wheels are built with hatchling, of the extra dev")
pytestmark = pytest.mark.heavy

ROOT = Path(__file__).parents[1]


def run(*command: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(list(map(str, command)), cwd=cwd, env={}, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def wheels(tmp_path_factory) -> list[Path]:
    """This package and the example plugin, built as wheels."""
    folder = tmp_path_factory.mktemp("wheels")
    options = ("--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", folder)
    run(sys.executable, "-m", "pip", "wheel", *options, ROOT, ROOT / "plugins" / "color_grid", cwd=folder)
    return sorted(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheels, tmp_path_factory) -> Path:
    """A clean environment with both wheels; the other packages are those of the environment that runs the tests."""
    environment = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", "--without-pip", environment, cwd=environment)
    python = environment / "bin" / "python"
    pip = (sys.executable, "-m", "pip", "--python", python)
    run(*pip, "install", "--quiet", "--no-deps", "--no-index", *wheels, cwd=environment)
    (packages,) = environment.glob("lib/python*/site-packages")
    # A path in a .pth file is searched last, and .pth files there are not read: an editable install stays out.
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return environment / "bin"


def test_the_wheel_holds_every_file_of_the_package_the_configs_and_the_licence(wheels):
    names = zipfile.ZipFile(next(wheel for wheel in wheels if wheel.name.startswith("lp_framework"))).namelist()
    for config in (ROOT / "conf").rglob("*.yaml"):
        assert f"lp_framework/{config.relative_to(ROOT).as_posix()}" in names
    for file in (ROOT / "lp_framework").rglob("*.*"):
        if file.is_file() and file.suffix != ".pyc":
            assert file.relative_to(ROOT).as_posix() in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert {name.partition("/")[0] for name in names} == {"lp_framework", "lp_framework-0.1.0.dist-info"}


def test_the_installed_command_finds_its_configs_plugins_and_weights_from_another_folder(installed, tmp_path):
    """In few processes, because each imports PyTorch."""
    assert run(installed / "lp", "--version", cwd=tmp_path).stdout == "lp_framework 0.1.0\n"
    module, conf, config, listing, prior = run(installed / "python", "-c", INSTALLED, cwd=tmp_path).stdout.split(PART)
    assert Path(conf) == Path(module).parent / "conf" and ROOT not in Path(conf).parents
    chosen = OmegaConf.create(config)
    assert chosen.model.name == "score"
    assert chosen.backbone == {"name": "color_grid", "grid": 8, "features": 128, "image_size": 64}
    assert re.search(r"^color_grid +package lp-color-grid 0\.1\.0 +grid=8, ", listing, re.MULTILINE)
    assert prior == "(192, 1, 1) 9\n"


PART = "-" * 20
INSTALLED = f"""
import sys
import lp_framework
from lp_framework import cli, registry
print(registry.__file__, registry.conf_dir(), sep="{PART}", end="{PART}")
for arguments in (["train", "backbone=color_grid", "--cfg", "job"], ["plugins"]):
    sys.argv = ["lp", *arguments]
    assert cli.main() == 0
    print("{PART}", end="")
from lp_framework.report.paper import paper_tables
print(lp_framework.load_prior("tiny").latent_shape, len(paper_tables()))
"""


def test_every_dependency_is_pinned_once_for_a_python():
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(r"[a-z0-9-]+==[\w.]+( ; python_version (>=|<) \"3\.11\")?", line) for line in lines)
    pinned = {line.partition("==")[0] for line in lines}
    project = (ROOT / "pyproject.toml").read_text()
    wanted = re.findall(r"^ +\"([\w-]+)[><=]", project, re.MULTILINE)
    wanted += re.findall(
        r"\"([\w-]+)(?:\[\w+\])?>=",
        "".join(re.findall(r"^(?:features|masks|sweeps|zero123) = .*$", project, re.MULTILINE)),
    )
    assert {"torch", "diffusers", "plotly", "ruff"} <= set(wanted)
    assert {name.replace("_", "-").lower() for name in wanted} <= pinned


# ---------------------------------------------------------------- torchvision


def python(code: str, cwd: Path) -> str:
    return run(sys.executable, "-c", f"import sys; sys.path[:0] = ['.', {str(ROOT)!r}]; {code}", cwd=cwd).stdout.strip()


@pytest.mark.parametrize("call", ["t.install(); t.install(); t.ensure(); t.ensure()", "t.install(); import lightning"])
def test_torchvision_can_be_imported_whatever_its_operators(tmp_path, call):
    code = f"from lp_framework import torchvision_ops as t; {call}; import torch, torchvision.models as m"
    assert python(f"{code}; print(m.resnet18().eval()(torch.zeros(1, 3, 32, 32)).shape[1])", tmp_path) == "1000"


def test_watching_for_torchvision_imports_nothing(tmp_path):
    code = (
        "from lp_framework import torchvision_ops as t; t.install(); print({'torch', 'torchvision'} & {*sys.modules})"
    )
    assert python(code, tmp_path) == "set()"


@pytest.mark.parametrize("healthy", [True, False])
def test_operators_are_declared_only_where_the_compiled_ones_do_not_load(tmp_path, healthy):
    stand_in = tmp_path / "torchvision"
    stand_in.mkdir()
    (stand_in / "__init__.py").touch()
    loads = importlib.util.find_spec("torch._C").origin
    (stand_in / "_C.so").write_bytes(Path(loads).read_bytes() if healthy else b"compiled for another torch")
    code = "from lp_framework import torchvision_ops as t; t.ensure(); print(len(t._declared))"
    assert python(code, tmp_path) == ("0" if healthy else "1")
