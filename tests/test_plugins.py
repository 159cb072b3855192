"""Plugins: found in folders and packages, listed, and harmless when broken."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from lp_framework import registry
from lp_framework.errors import UserError

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "plugins" / "color_grid"
START = """
from lp_framework.registry import register

@register("start", "{name}")
class Start:
    "One pose."

    def __init__(self, count: int = {count}) -> None:
        self.count = count
"""


def start(name: str, count: int = 1) -> str:
    return START.format(name=name, count=count)


@pytest.fixture
def here(clean_registry, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


# ---------------------------------------------------------------- folders


def test_plugins_of_the_working_directory_are_found(here, write):
    write("plugins/one/tmp_one.py", start("one", 5))
    assert registry.build("start", "one").count == 5
    assert registry.plugin_classes()["start", "one"][1] == "folder plugins/one"


@pytest.mark.parametrize("named", ["elsewhere", "elsewhere/two"])
def test_a_named_folder_is_a_plugin_or_holds_plugins(here, write, named):
    write("elsewhere/two/tmp_two.py", start("two"))
    assert "two" not in registry.names("start")
    registry.discover([named])
    assert "two" in registry.names("start")


def test_a_plugin_may_be_a_package_or_a_project_with_packages(here, write):
    write("plugins/tmp_package/__init__.py", "from tmp_package import poses")
    write("plugins/tmp_package/poses.py", start("packaged"))
    write("plugins/project/pyproject.toml", "")
    write("plugins/project/tmp_inner/__init__.py", start("inner"))
    write("plugins/project/tests/__init__.py", "raise RuntimeError('tests are not imported')")
    assert {"packaged", "inner"} <= set(registry.names("start"))
    assert registry.failures() == {}


def test_tests_and_setup_scripts_are_not_imported(here, write):
    write("plugins/three/tmp_three.py", start("three"))
    for name in ("setup.py", "conftest.py", "test_three.py"):
        write(f"plugins/three/{name}", "raise RuntimeError('not to be imported')")
    assert "three" in registry.names("start") and registry.failures() == {}


def test_a_conf_folder_beside_the_module_is_collected(here, write):
    write("plugins/four/tmp_four.py", start("four"))
    write("plugins/four/conf/start/four.yaml", "count: 4\n")
    write("plugins/five/pyproject.toml", "")
    write("plugins/five/tmp_five/__init__.py", start("five"))
    write("plugins/five/tmp_five/conf/start/five.yaml", "count: 5\n")
    folders = list(registry.conf_folders())
    assert [folder.relative_to(here).as_posix() for folder in folders[-2:]] == [
        "plugins/five/tmp_five/conf",
        "plugins/four/conf",
    ]


def test_classes_of_a_plugin_can_be_pickled_for_worker_processes(here, write):
    write("plugins/six/tmp_six.py", start("six"))
    cls = registry.get("start", "six")
    assert cls.__module__ == "tmp_six" and str(here / "plugins" / "six") in sys.path


@pytest.mark.parametrize("folder", ["nowhere", "empty"])
def test_missing_and_empty_folders_are_reported(here, folder):
    (here / "empty").mkdir()
    with pytest.raises(UserError, match=rf"plugins=\[{folder}\]: is not a folder with Python files, and holds none"):
        registry.discover([folder])


# ---------------------------------------------------------------- what goes wrong


@pytest.mark.parametrize(
    ("source", "error"),
    [
        ("import tmp_missing_package", "ModuleNotFoundError: No module named 'tmp_missing_package'"),
        ("def f(:", "SyntaxError: "),
        ("raise SystemExit(3)", "SystemExit: 3"),
        (start("fine") + "\n1 / 0", "ZeroDivisionError: division by zero"),
        (start("taken"), "UserError: start 'taken' is registered twice"),
    ],
)
def test_a_broken_plugin_is_named_and_the_rest_load(here, write, source, error):
    write("plugins/a/tmp_a.py", start("taken"))
    write("plugins/b/tmp_b.py", source)
    write("plugins/c/tmp_c.py", start("last"))
    assert {"taken", "last"} <= set(registry.names("start"))
    assert "fine" not in registry.names("start")  # nothing of a plugin that stops half way
    (origin, failure), = registry.failures().items()  # fmt: skip
    assert origin == "folder plugins/b" and failure.startswith(error)


def test_a_plugin_whose_module_has_the_name_of_another_is_named(here, write):
    write("plugins/json/json.py", start("json"))
    write("plugins/x/tmp_same.py", start("first"))
    write("plugins/y/tmp_same.py", start("second"))
    assert "first" in registry.names("start") and "second" not in registry.names("start")
    failures = registry.failures()
    assert set(failures) == {"folder plugins/json", "folder plugins/y"}
    assert "the name of its module 'tmp_same' is already used by" in failures["folder plugins/y"]


def test_a_project_without_a_module_is_named(here, write):
    write("plugins/empty/pyproject.toml", "")
    assert registry.failures() == {"folder plugins/empty": "ImportError: it holds no Python module or package"}


def test_a_command_warns_of_a_broken_plugin_and_runs(lp, walker, write):
    write("plugins/broken/tmp_broken.py", "import tmp_missing_package")
    finished = lp("train", "-cd", "configs", "-cn", "demo", "--cfg", "job")
    assert finished.status == 0 and "name: walk" in finished.out
    assert finished.err == (
        "warning: plugin folder plugins/broken could not be loaded: "
        "ModuleNotFoundError: No module named 'tmp_missing_package'\n"
    )


# ---------------------------------------------------------------- the command


def test_the_listing_has_one_line_per_name(lp, walker, write):
    write("plugins/broken/tmp_broken.py", "import tmp_missing_package")
    finished = lp("plugins")
    assert finished.status == 0
    line = next(line for line in finished.out.splitlines() if line.startswith("walk "))
    for part in ("folder plugins/walker", "gamma=0.3, steps=7, limit=null, order=first", "Walks downhill."):
        assert part in line
    assert any(line.startswith("raycast ") and " built-in " in line for line in finished.out.splitlines())
    assert "plugin folder plugins/broken could not be loaded: ModuleNotFoundError: " in finished.out


def test_the_listing_takes_folders(lp, write):
    write("elsewhere/seven/tmp_seven.py", start("seven"))
    for argument in ("plugins=elsewhere", "plugins=[elsewhere]", "plugins=[elsewhere/seven]"):
        assert "\nseven " in lp("plugins", argument).out
    assert lp("plugins", "plugin=elsewhere").error == (
        "'plugin=elsewhere' is not an argument of this command; it takes plugins=FOLDER,..."
    )
    assert "Usage: lp plugins" in lp("plugins", "--help").out


# ---------------------------------------------------------------- the example


def test_the_example_is_found_and_its_yaml_applies(lp, walker, monkeypatch):
    monkeypatch.delitem(sys.modules, "lp_color_grid", raising=False)  # a test of its own may have imported it
    for choice, grid in (("color_grid", 8), ("color_grid_coarse", 2)):
        arguments = (f"plugins=[{EXAMPLE}]", f"+backbone={choice}", "--cfg", "job")
        finished = lp("train", "-cd", "configs", "-cn", "demo", *arguments)
        assert finished.status == 0 and finished.err == ""
        backbone = OmegaConf.create(finished.out).backbone
        assert (backbone.name, backbone.grid) == ("color_grid", grid)
