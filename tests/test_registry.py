"""Names to classes: registering, looking up, building."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import pytest

from lp_framework import registry
from lp_framework.errors import UserError, optional_import
from lp_framework.registry import build, get, names, register

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.usefixtures("clean_registry")


@pytest.fixture
def step() -> type:
    @register("solver", "tmp_step")
    class Step:
        """One step.

        More about it.
        """

        def __init__(
            self, model: object, prior: object = None, gamma: float = 0.3, *, order: Literal["first", "last"] = "last"
        ) -> None:
            self.model, self.prior, self.gamma, self.order = model, prior, gamma, order

    return Step


def test_a_registered_class_is_found_by_its_name(step):
    assert get("solver", "tmp_step") is step
    assert "tmp_step" in names("solver") and "tmp_step" not in names("prior")


def test_a_class_says_what_are_its_settings_and_what_its_components(step):
    settings, components = registry.parameters(step)
    assert list(settings) == ["gamma", "order"] and list(components) == ["model", "prior"]
    assert registry.component_names(step) == ["model", "prior"]


def test_settings_come_from_the_config_and_components_from_the_caller(step):
    solver = build("solver", {"name": "tmp_step", "gamma": 0.5}, model="a model", data="not wanted")
    assert (solver.model, solver.prior, solver.gamma) == ("a model", None, 0.5)
    assert build("solver", "tmp_step", model="m", prior="p").prior == "p"


@pytest.mark.parametrize(
    ("config", "components", "sentence"),
    [
        ({"name": "tmp_stop"}, {}, "there is no solver 'tmp_stop'; did you mean 'tmp_step'? (known: "),
        ({"name": "tmp_step", "gama": 1}, {"model": 1}, "'gama' is not one of its settings; did you mean 'gamma'?"),
        ({"name": "tmp_step"}, {}, "solver 'tmp_step' needs a model: choose one with model=NAME"),
        ({"name": "tmp_step", "prior": 1}, {"model": 1}, "'prior' is not one of its settings"),
        ({"name": "tmp_step", "gamma": "???"}, {"model": 1}, "needs a value for 'gamma': give solver.gamma=VALUE"),
        (
            {"name": "tmp_step", "order": "frist"},
            {"model": 1},
            "order=frist does not fit; expected one of first, last; did you mean 'first'?",
        ),
        ({"gamma": 1}, {}, "the configuration of a solver has no name: choose one with solver=NAME"),
    ],
)
def test_a_mismatch_is_one_sentence(step, config, components, sentence):
    with pytest.raises(UserError) as error:
        build("solver", config, **components)
    assert sentence in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("hint", "fit", "unfit"),
    [
        (int, [0, -3], [0.5, True, "3", None]),
        (float, [1, 0.5, float("inf")], ["high", False, [1.0]]),
        (bool, [True], [1, "yes"]),
        (float | None, [None, 1], ["none"]),
        (float | Sequence[float], [0.3, [0, 0.3, 0], (1.0,)], ["a", [0, "a"]]),
        (list[int], [[], [1]], [1, [1.5]]),
        (tuple[int, float], [[1, 2.5]], [[1], [1, 2, 3], [0.5, 1]]),
        (tuple[int, ...], [[], [1, 2]], [["a"]]),
        (Literal["a", "b"], ["a"], ["c"]),
        (Path, ["folder", Path("folder")], [3]),
        (dict[str, int], [{"a": 1}], []),
    ],
)
def test_values_of_wrong_types_are_reported(hint, fit, unfit):
    def init(self, value):
        self.value = value

    init.__annotations__ = {"value": hint}
    register("start", "tmp_typed")(type("Typed", (), {"__init__": init}))
    for value in fit:
        built = build("start", {"name": "tmp_typed", "value": value}).value
        assert built == (type(built)(value) if isinstance(built, tuple | list | Path) else value)
        assert hint is not float or type(built) is float
    for value in unfit:
        with pytest.raises(UserError, match="start 'tmp_typed': value="):
            build("start", {"name": "tmp_typed", "value": value})


def test_an_unknown_group_is_an_error():
    with pytest.raises(UserError, match="there is no group 'solvr'; did you mean 'solver'"):
        register("solvr", "x")


def test_errors_of_a_constructor_pass_through():
    @register("start", "tmp_raising")
    class Raising:
        def __init__(self) -> None:
            raise ZeroDivisionError("inside")

    with pytest.raises(ZeroDivisionError, match="inside"):
        build("start", "tmp_raising")


def test_a_name_belongs_to_one_class(step):
    with pytest.raises(UserError, match=r"solver 'tmp_step' is registered twice: by .*Step .* and by .*Other "):

        @register("solver", "tmp_step")
        class Other:
            pass

    assert get("solver", "tmp_step") is step


def test_a_plugin_cannot_take_the_name_of_a_built_in():
    with pytest.raises(UserError, match=r"renderer 'raycast' of module .* has the name of a built-in renderer"):

        @register("renderer", "raycast")
        class Other:
            pass


def test_a_missing_optional_package_is_named_with_what_installs_it():
    with pytest.raises(UserError, match="x needs the Python package 'tmp_needed', which is not installed: y"):
        optional_import("tmp_needed", "x", "y")


def test_asking_for_plugins_imports_no_built_in(tmp_path):
    code = "import sys; from lp_framework import registry; registry.plugin_classes(); print({'torch'} & {*sys.modules})"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env={"PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    assert done.stdout.strip() == "set()", done.stderr
