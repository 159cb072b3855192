"""Names to classes: registering, looking up, building; the built-ins read from their sources."""

from __future__ import annotations

import inspect
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import pytest
from omegaconf import OmegaConf

from lp_framework import registry, registry_sources
from lp_framework.composition import node
from lp_framework.errors import UserError
from lp_framework.registry import build, entries, get, names, register

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


def test_an_entry_describes_settings_and_components(step):
    entry = next(each for each in entries("solver") if each.name == "tmp_step")
    assert entry.summary == "One step."
    assert list(map(str, entry.settings)) == ["gamma=0.3", "order='last'"]
    assert list(map(str, entry.components)) == ["model", "prior=None"]
    assert entry.settings[0].annotation == "float"


def test_settings_come_from_the_config_and_components_from_the_caller(step):
    solver = build("solver", {"name": "tmp_step", "gamma": 0.5}, model="a model", data="not wanted")
    assert (solver.model, solver.prior, solver.gamma) == ("a model", None, 0.5)
    assert build("solver", "tmp_step", model="m", prior="p").prior == "p"


def test_configs_of_omegaconf_arrive_as_plain_values():
    @register("start", "tmp_listing")
    class Listing:
        def __init__(self, values: list[float], table: dict[str, int]) -> None:
            self.values, self.table = values, table

    config = OmegaConf.create({"name": "tmp_listing", "values": [1.0, "${table.a}"], "table": {"a": 2}})
    for given in (config, {key: config[key] for key in config}):
        start = build("start", given)
        assert (type(start.values), type(start.table)) == (list, dict)
        assert start.values == [1.0, 2] and start.table == {"a": 2}


@pytest.mark.parametrize(
    ("config", "components", "sentence"),
    [
        ({"name": "tmp_stop"}, {}, "there is no solver 'tmp_stop'; did you mean 'tmp_step'? (known: "),
        ({"name": "tmp_step", "gama": 1}, {"model": 1}, "'gama' is none of its settings; did you mean 'gamma'?"),
        ({"name": "tmp_step"}, {}, "solver 'tmp_step' needs a model: choose one with model=NAME"),
        ({"name": "tmp_step", "prior": 1}, {"model": 1}, "'prior' is handed over, it cannot be set there"),
        ({"name": "tmp_step", "gamma": "???"}, {"model": 1}, "needs a value for 'gamma': give solver.gamma=VALUE"),
        (
            {"name": "tmp_step", "order": "frist"},
            {"model": 1},
            "order=frist is none of its values; did you mean 'first'?",
        ),
        ({"gamma": 1}, {}, "the configuration of a solver has no name: choose one with solver=NAME"),
    ],
)
def test_what_does_not_fit_is_told_in_one_sentence(step, config, components, sentence):
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
def test_values_fit_their_types_or_are_told(hint, fit, unfit):
    def init(self, value):
        self.value = value

    init.__annotations__ = {"value": hint}
    register("start", "tmp_typed")(type("Typed", (), {"__init__": init}))
    for value in fit:
        assert build("start", {"name": "tmp_typed", "value": value}).value == value
    for value in unfit:
        with pytest.raises(UserError, match="start 'tmp_typed': value="):
            build("start", {"name": "tmp_typed", "value": value})


def test_an_unknown_group_is_told():
    for call in (lambda: names("solvr"), lambda: register("solvr", "x"), lambda: entries("solvr")):
        with pytest.raises(UserError, match="there is no group 'solvr'; did you mean 'solver'"):
            call()


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


def test_a_built_in_name_is_taken_even_before_its_module_is_imported():
    taken = entries("renderer")[0]
    with pytest.raises(UserError, match=f"{taken.module}.{taken.qualname} .built-in."):

        @register("renderer", taken.name)
        class Other:
            pass


def test_a_missing_package_is_named_with_what_installs_it(tmp_path, monkeypatch):
    (tmp_path / "tmp_needy.py").write_text("import diffusers_of_another_kind")
    entry = registry.Entry("prior", "tmp_needy", "tmp_needy", "Needy", registry.BUILT_IN, "", (), ())
    built_ins = {**registry.built_ins(), ("prior", "tmp_needy"): entry}
    monkeypatch.setattr(registry, "built_ins", lambda: built_ins)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(UserError, match="needs the Python package 'diffusers_of_another_kind', which is not installed"):
        get("prior", "tmp_needy")


BUILT_INS = [(entry.group, entry.name) for entry in entries() if entry.origin == registry.BUILT_IN]


@pytest.mark.parametrize(("group", "name"), BUILT_INS)
def test_what_is_read_from_the_source_of_a_built_in_is_what_its_class_says(group, name):
    entry = next(each for each in entries(group) if each.name == name)
    cls = get(group, name)
    parameters = list(inspect.signature(cls).parameters)
    assert sorted(each.name for each in (*entry.settings, *entry.components)) == sorted(parameters)
    assert (entry.module, entry.qualname) == (cls.__module__, cls.__qualname__)
    assert entry.summary and entry.summary == inspect.getdoc(cls).partition("\n")[0]


@pytest.mark.parametrize(("group", "name"), BUILT_INS)
def test_every_built_in_has_a_config_of_its_settings(group, name):
    config = node(group, name, [])
    settings = next(each for each in entries(group) if each.name == name).settings
    assert list(config) == ["name", *(each.name for each in settings)]
    assert config.name == name


def test_the_value_of_a_default_that_is_a_constant_is_read(tmp_path):
    source = "A, B = 1, (2, 3)\nC = 'c'\nclass X:\n    def __init__(self, a=A, *, b=B, c=C, d=D, e=4): pass\n"
    (tmp_path / "x.py").write_text(source)
    arguments = registry_sources._signature(*registry_sources.constructor_of(tmp_path / "x.py", "X"))
    assert list(map(str, arguments)) == ["a=1", "b=(2, 3)", "c='c'", "d=D", "e=4"]


def test_names_and_entries_import_no_built_in(tmp_path):
    code = (
        "import sys; from lp_framework import registry; registry.entries(); print({'torch', 'hydra'} & {*sys.modules})"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env={"PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    assert done.stdout.strip() == "set()", done.stderr
