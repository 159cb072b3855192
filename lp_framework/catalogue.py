"""What can be chosen and set: the YAML files of the conf folders, and the signatures of plugins that bring none.

`conf/GROUP/CHOICE.yaml` holds all settings of a choice with a comment each; its first comment says what the choice is.
Only YAML is read here, so that listings and `--help` answer at once.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from lp_framework import registry
from lp_framework.errors import UserError, nearest

KEY = re.compile(r"([\w@./-]+):( |$)")
PACKAGE = re.compile(r"# @package (\S+)")
# What every choice of a group begins with: the data module's settings for loading views.
SHARED = {"data": {"/loader@_here_": "pairs"}}


@dataclass
class ConfigFile:
    """A YAML file as text: its first comment, its defaults list, and each top-level key with its lines."""

    summary: str = ""
    defaults: list[Any] = field(default_factory=list)
    settings: dict[str, list[str]] = field(default_factory=dict)


def conf_folders(config_dir: str | None = None) -> list[Path]:
    """The folders of configs, in the order in which Hydra looks a file up."""
    return [*([Path(config_dir)] if config_dir else []), registry.conf_dir(), *registry.conf_folders()]


def choices(group: str, config_dir: str | None = None) -> list[str]:
    """What can be chosen by `group=CHOICE`, sorted."""
    files = {file.stem for folder in conf_folders(config_dir) for file in (folder / group).glob("*.yaml")}
    return sorted({*files, *(name for found, name in registry.plugin_classes() if found == group)})


def groups(config_dir: str | None = None) -> list[str]:
    """The groups that can be chosen from: the registry's and the folders of configs."""
    folders = {each.name for folder in conf_folders(config_dir) for each in folder.glob("*/") if each.is_dir()}
    return sorted({*registry.GROUPS, *folders} - {"hydra", "loader"})


def origin(group: str, choice: str) -> str:
    """Where a choice comes from: "built-in", or the plugin that brings it."""
    if (registry.conf_dir() / group / f"{choice}.yaml").is_file():
        return registry.BUILT_IN
    plugins = registry.plugin_classes()
    if (group, choice) in plugins:
        return plugins[group, choice][1]
    return next(str(folder) for folder in registry.conf_folders() if (folder / group / f"{choice}.yaml").is_file())


# ---------------------------------------------------------------- as text, for listings and help


def read(path: str, config_dir: str | None = None) -> ConfigFile:
    """`GROUP/CHOICE` or `COMMAND` as text, with the settings of the files of the same group that it builds on."""
    file = next((each for folder in conf_folders(config_dir) if (each := folder / f"{path}.yaml").is_file()), None)
    group, _, choice = path.rpartition("/")
    own = parse(file.read_text(encoding="utf-8")) if file else ConfigFile()
    below = _signature_as_text(group, own.settings.get("name", [choice])[0].removeprefix("name: "))
    own.summary = own.summary or below.summary
    if group in SHARED and below.settings:
        below.settings |= {key: lines for base in _paths(SHARED[group]) for key, lines in read(base).settings.items()}
    for entry in own.defaults if group else []:
        if isinstance(entry, dict):  # {/loader@_here_: pairs}
            below.settings |= {key: lines for base in _paths(entry) for key, lines in read(base).settings.items()}
        elif entry != "_self_":
            below.settings |= read(f"{group}/{entry}", config_dir).settings
    return ConfigFile(own.summary, own.defaults, {**below.settings, **own.settings})


def _paths(entry: Mapping[str, str]) -> list[str]:
    """The configs that an entry of a defaults list puts right here, as `{/loader@_here_: pairs}` does."""
    return [f"{key[1:-7]}/{choice}" for key, choice in entry.items() if key.endswith("@_here_")]


def parse(text: str) -> ConfigFile:
    """A YAML file's text in parts."""
    parts = ConfigFile()
    comments: list[str] = []
    block: list[str] | None = None
    for line in text.splitlines():
        if found := KEY.match(line):
            block = parts.settings[found[1]] = [*comments, line] if parts.settings else [line]
            if len(parts.settings) == 1:
                parts.summary = " ".join(comment[1:].strip() for comment in comments if not PACKAGE.match(comment))
            comments = []
        elif line.startswith("#"):
            comments.append(line)
        elif block is not None and line.strip():
            block.append(line)
    parts.settings.pop("defaults", None)
    values = yaml.safe_load(text)
    parts.defaults = (values.get("defaults") or []) if isinstance(values, dict) else []
    return parts


def _signature_as_text(group: str, name: str) -> ConfigFile:
    """A plugin's class: the first line of its docstring, and the defaults of its constructor."""
    if (group, name) not in registry.plugin_classes():
        return ConfigFile()
    cls, _ = registry.plugin_classes()[group, name]
    arguments, _ = registry.parameters(cls)
    values = {key: registry.MISSING if each.default is each.empty else each.default for key, each in arguments.items()}
    lines = {key: [f"{key}: {'null' if value is None else value}"] for key, value in {"name": name, **values}.items()}
    return ConfigFile((cls.__doc__ or "").strip().partition("\n")[0], settings=lines)


# ---------------------------------------------------------------- experiments


def experiments(command: str, config_dir: str | None = None) -> list[str]:
    """The experiments that belong to a command: it has all groups that they choose from, and they set nothing that
    only other commands have."""
    commands = {file.stem: _keys(file) for folder in conf_folders(config_dir) for file in folder.glob("*.yaml")}
    own = {"experiment", *commands[command], *commands["base"]}
    others = {key for keys in commands.values() for key in keys} - own
    found = []
    for folder in conf_folders(config_dir):
        for file in folder.glob("experiment/*.yaml"):
            keys = _keys(file)
            chosen = {key.partition("override /")[2] for key in keys} - {""}
            if chosen <= own and not keys & others:
                found.append(file.stem)
    return sorted(found)


def _keys(file: Path) -> set[str]:
    """The keys of a file and the groups in its defaults list; nothing of a file that is not valid."""
    try:
        parts = parse(file.read_text(encoding="utf-8"))
    except (yaml.YAMLError, OSError, UnicodeDecodeError):
        return set()
    entries = parts.defaults if isinstance(parts.defaults, list) else []
    return {*parts.settings, *(str(key) for entry in entries if isinstance(entry, dict) for key in entry)}


# ---------------------------------------------------------------- as values


def values(group: str, choice: str) -> dict[str, Any]:
    """The settings of a built-in choice, presets included, by name."""
    from omegaconf import OmegaConf

    known = choices(group)
    if choice not in known:
        raise UserError(f"there is no {group} '{choice}'{nearest(choice, known)} (known: {', '.join(known)})")
    text = "\n".join(line for lines in read(f"{group}/{choice}").settings.values() for line in lines)
    found: Any = OmegaConf.to_container(OmegaConf.create(text))
    return {str(key): value for key, value in found.items()}


class Node(NamedTuple):
    """A config that a plugin brings, as Hydra's config store takes it."""

    group: str
    name: str
    package: str | None
    values: dict[str, Any]


def plugin_nodes() -> Iterator[Node | str]:
    """The configs of all plugins; instead of one that is not valid, a sentence that says what is wrong with it.

    A class's settings are those of its constructor, with the values of the YAML files that name it. Everything else in
    a plugin's conf folder is passed on as it is.
    """
    classes = registry.plugin_classes()
    with_file = set()
    for folder in registry.conf_folders():
        for file in sorted(folder.rglob("*.yaml")):
            group = file.parent.relative_to(folder).as_posix()
            try:
                text = file.read_text(encoding="utf-8")
                content = yaml.safe_load(text)
                if not isinstance(content, dict):
                    raise UserError("a configuration is a mapping 'key: value', not a list")
                found = group, str(content.get("name", file.stem))
                if found in classes:
                    content = _merged(classes[found][0], *found, content)
                    with_file.add((group, file.stem))
            except (UserError, yaml.YAMLError, UnicodeDecodeError) as error:
                yield f"{file}: {' '.join(str(error).split())}"
                continue
            package = PACKAGE.search(text)
            yield Node(group, file.stem, package[1] if package else None, content)
    for (group, name), (cls, where) in classes.items():
        if (group, name) not in with_file:
            try:
                yield Node(group, name, None, _merged(cls, group, name, {}))
            except UserError as error:
                yield f"{where}: {error}"


def _merged(cls: type, group: str, name: str, content: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a plugin's class: its constructor's, and `content` over them."""
    from hydra_zen import builds  # takes a while to import
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        built: Any = builds(cls, populate_full_signature=True, zen_exclude=registry.component_names(cls))
        defaults: Any = OmegaConf.to_container(OmegaConf.structured(built))
    except (TypeError, ValueError, OmegaConfBaseException) as error:
        raise UserError(f"{group} '{name}' has a setting that no configuration can hold ({error})") from error
    defaults.pop("_target_", None)
    known = ["name", *defaults]
    for key in content:
        if key not in known and key != "defaults" and group not in SHARED:
            raise UserError(f"{group} '{name}' has no '{key}'{nearest(str(key), known)} (known: {', '.join(known)})")
    shared = {"defaults": [SHARED[group], "_self_"]} if group in SHARED else {}
    return {**shared, "name": name, **defaults, **content}


# ---------------------------------------------------------------- the help of a command


def chosen(command: str, overrides: Sequence[str], config_dir: str | None = None) -> dict[str, str | None]:
    """The groups of a command's config, each with what is chosen of it by default or by `group=CHOICE`."""
    entries = [entry for entry in read(command, config_dir).defaults if isinstance(entry, dict)]
    found = {str(group): choice for entry in entries for group, choice in entry.items()}
    given = dict(override.lstrip("+").split("=", 1) for override in overrides if "=" in override)
    return {group: given.get(group, choice) for group, choice in found.items()}


def command_help(command: str, overrides: Sequence[str], config_dir: str | None = None) -> str:
    """What a command is for, what can be chosen, and each setting with the comment from its YAML file."""
    config = read(command, config_dir)
    groups = chosen(command, overrides, config_dir)
    lines = [f"Usage: lp {command} [key=value ...] [options]", "", config.summary, "", "Choose (group=choice):", ""]
    for group in groups:
        known = experiments(command, config_dir) if group == "experiment" else choices(group, config_dir)
        lines.append(f"  {group + ':':12}{', '.join(known)}")
    lines += ["", "Settings (key=value):", ""]
    plain = {key: block for key, block in config.settings.items() if key not in groups}
    lines += [f"  {line}" for block in plain.values() for line in block]
    for group, choice in groups.items():
        if choice is None or group == "experiment":
            continue
        part = read(f"{group}/{choice}", config_dir)
        lines += ["", f"{group}={choice}: {part.summary}", ""]
        for key, block in part.settings.items():
            if key != "name":
                lines += [f"  {group}.{line}" if KEY.match(line) else f"  {line}" for line in block]
    return "\n".join([*lines, "", OPTIONS_HELP])


OPTIONS_HELP = """\
Options:

  --multirun, -m         run every combination of key=value,value,...
  --cfg job, -c job      print the configuration without running
  --config-dir, -cd DIR  a folder with your own configs
  plugins=[DIR]          folders with plugins, besides plugins/ of the working directory
  --info defaults        which files the configuration comes from
  --hydra-help           Hydra's own settings"""
