"""The catalogue in conf/: every built-in's YAML against its constructor, and a comment for every setting."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

import lp_framework
from lp_framework import catalogue, registry
from lp_framework.data.module import PairDataModule
from lp_framework.errors import UserError

ROOT = Path(__file__).parents[1]
CONF = ROOT / "conf"
REGISTERED = re.compile(r'^@register\("(\w+)", "(\w+)"\)$', re.MULTILINE)
# From the sources: neither the registry nor the catalogue is asked what it holds.
BUILT_INS = sorted(
    (group, name)
    for file in (ROOT / "lp_framework").rglob("*.py")
    for group, name in REGISTERED.findall(file.read_text(encoding="utf-8"))
)
CHOICES = sorted((file.parent.name, file.stem) for group in registry.GROUPS for file in (CONF / group).glob("*.yaml"))
PRESETS = sorted({*CHOICES} - {*BUILT_INS})
EVERY_FILE = sorted(CONF.rglob("*.yaml"))
# All but experiments and Hydra's own settings, which say where they differ and why.
OTHERS = {"experiment", "hydra", "base.yaml", "sweep.yaml"}
COMMENTED = [file for file in EVERY_FILE if file.relative_to(CONF).parts[0] not in OTHERS]


def settings(group: str, name: str) -> dict[str, Any]:
    """The settings of a built-in with their defaults, in the order in which its YAML has them."""
    own = arguments(registry.get(group, name))
    return arguments(PairDataModule) | own if group == "data" else own


def arguments(cls: type) -> dict[str, Any]:
    """The settings of a constructor with their defaults; what is built for it is left out."""
    parameters = inspect.signature(cls).parameters
    return {key: in_yaml(each.default) for key, each in parameters.items() if key not in (*registry.GROUPS, "source")}


def in_yaml(default: Any) -> Any:
    """A constructor's default as YAML has it."""
    if default is inspect.Parameter.empty:
        return "???"
    return list(default) if isinstance(default, tuple) else default


def stated(file: Path) -> dict[str, Any]:
    """What a file itself sets."""
    values: Any = OmegaConf.to_container(OmegaConf.load(file))
    return {key: value for key, value in values.items() if key not in ("defaults", "name")}


def composed(group: str, choice: str) -> tuple[str, dict[str, Any]]:
    """The name and the settings that Hydra makes of `group=choice`."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        values: Any = OmegaConf.to_container(compose(overrides=[f"+{group}={choice}"])[group])
    return values.pop("name"), values


def typed(values: dict[str, Any]) -> list[str]:
    """Keys and values as text, in order: it tells 1 from 1.0 and from True."""
    return [f"{key}={value!r}" for key, value in values.items()]


def label(value: object) -> str:
    return value.relative_to(CONF).as_posix() if isinstance(value, Path) else str(value)


@pytest.mark.parametrize(("group", "name"), BUILT_INS, ids=label)
def test_yaml_has_the_settings_and_defaults_of_the_constructor(group: str, name: str) -> None:
    found, values = composed(group, name)
    assert found == name
    assert typed(values) == typed(settings(group, name))


@pytest.mark.parametrize(("group", "choice"), PRESETS, ids=label)
def test_other_yaml_is_a_preset_of_a_built_in_and_states_what_differs(group: str, choice: str) -> None:
    name, values = composed(group, choice)
    assert (group, name) in BUILT_INS
    base, own = composed(group, name)[1], stated(CONF / group / f"{choice}.yaml")
    assert typed(values) == typed(base | own)
    assert own and not {*typed(own)} & {*typed(base)}


@pytest.mark.parametrize("file", EVERY_FILE, ids=label)
def test_first_line_says_what_it_is(file: Path) -> None:
    lines = file.read_text(encoding="utf-8").splitlines()
    first = lines[1] if lines[0] == "# @package _global_" else lines[0]  # Hydra wants that one first
    assert re.match(r"# \w", first)


@pytest.mark.parametrize("file", COMMENTED, ids=label)
def test_every_setting_has_a_comment(file: Path) -> None:
    lines = file.read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if len(line) > 140] == []
    values = [line for line in lines if re.match(r" *\w+: [^ #]", line) and not line.startswith("name: ")]
    assert [line for line in values if " # " not in line] == []


def test_sources_register_classes_in_every_group() -> None:
    assert {group for group, _ in BUILT_INS} == {*registry.GROUPS}


# ---------------------------------------------------------------- what listings, help and the Python API read


@pytest.mark.parametrize(("group", "choice"), [*BUILT_INS, *PRESETS], ids=label)
def test_the_catalogue_reads_what_hydra_composes(group: str, choice: str) -> None:
    name, values = composed(group, choice)
    assert catalogue.values(group, choice) == {"name": name, **values}
    assert catalogue.origin(group, choice) == registry.BUILT_IN
    assert catalogue.read(f"{group}/{choice}").summary[-1] in ".)"


def test_a_preset_is_a_choice_of_the_python_api() -> None:
    solver = lp_framework.load_solver(
        "two_stage_without_noise", model=lp_framework.load_model(), prior=lp_framework.load_prior("tiny"), alpha=0.2
    )
    assert type(solver) is registry.get("solver", "two_stage")
    assert (solver.first.gamma, solver.first.alpha) == ([0.0, 0.0, 0.0], 0.2)
    with pytest.raises(UserError, match="there is no solver 'two_stag'; did you mean 'two_stage'"):
        lp_framework.load_solver("two_stag")


def test_a_file_is_read_with_the_comments_of_its_keys() -> None:
    parts = catalogue.parse(
        "# @package _global_\n# What it is,\n# in two lines.\ndefaults:\n  - base\n\na: 1 # one\n# of two parts\n"
        "b: # both\n  c: 2 # two\n"
    )
    assert parts.summary == "What it is, in two lines." and parts.defaults == ["base"]
    assert parts.settings == {"a": ["a: 1 # one"], "b": ["# of two parts", "b: # both", "  c: 2 # two"]}


def test_help_shows_the_choices_of_a_command_and_what_they_can_be_set_to() -> None:
    text = catalogue.command_help("eval", ["solver=two_stage_without_noise"])
    assert "solver=two_stage_without_noise: " in text and "  solver.gamma: 0.0 # " in text
    assert "  protocol: ordered # " in text and "backbone" not in text
