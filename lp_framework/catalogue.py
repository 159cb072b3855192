"""All choices and settings: the YAML files of the conf folders, and the signatures of plugins without YAML files.

`conf/GROUP/CHOICE.yaml` holds all settings of a choice, each with a comment; its first comment describes the choice.
This module only reads text, so that listings and `--help` respond instantly.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from lp_framework import registry
from lp_framework.errors import UserError, among
from lp_framework.overrides import values_of

KEY = re.compile(r"([\w@./-]+):( |$)")
PACKAGE = re.compile(r"# @package (\S+)")
# The keys of a config and the groups in its defaults list; in an experiment these follow `override`.
WORD = re.compile(r"^(?:  - |.*override /)?([\w/]+):", re.MULTILINE)
# Settings shared by all choices of a group: those of the data module for loading views.
SHARED = {"data": {"/loader@_here_": "pairs"}}


@dataclass
class ConfigFile:
    """A YAML file as text: its first comment, its defaults list, and each top-level key with its lines."""

    summary: str = ""
    defaults: list[Any] = field(default_factory=list)
    settings: dict[str, list[str]] = field(default_factory=dict)


def conf_folders(config_dir: str | None = None) -> list[Path]:
    """The config folders, in lookup order."""
    return [*([Path(config_dir)] if config_dir else []), registry.conf_dir(), *registry.conf_folders()]


def find(path: str, config_dir: str | None = None) -> Path | None:
    """Find the file of `GROUP/CHOICE` or `COMMAND`."""
    files = (folder / f"{path}.yaml" for folder in conf_folders(config_dir))
    return next((file for file in files if file.is_file()), None)


def choices(group: str, config_dir: str | None = None) -> list[str]:
    """The valid values of `group=CHOICE`, sorted."""
    files = {file.stem for folder in conf_folders(config_dir) for file in (folder / group).glob("*.yaml")}
    return sorted({*files, *(name for found, name in registry.plugin_classes() if found == group)})


def origin(group: str, choice: str) -> str:
    """Where a choice comes from: "built-in", or the plugin that provides it."""
    for folder, where in {registry.conf_dir(): registry.BUILT_IN, **registry.conf_folders()}.items():
        if (folder / group / f"{choice}.yaml").is_file():
            return where
    return registry.plugin_classes()[group, choice][1]


def plugin_folders(overrides: Iterable[str]) -> list[str]:
    """The folders given by `plugins=[FOLDER,...]` on a command line."""
    folders = (folder.strip(" '\"") for folder in values_of(overrides).get("plugins", "").strip("[]").split(","))
    return [folder for folder in folders if folder]


def read(path: str, config_dir: str | None = None) -> ConfigFile:
    """Read `GROUP/CHOICE` or `COMMAND` as text, including settings inherited from files of the same group."""
    file = find(path, config_dir)
    own = parse(file.read_text(encoding="utf-8") if file else "")
    group, _, choice = path.rpartition("/")
    if not group:  # the defaults list of a command holds choices
        return own
    name = own.settings.get("name", [choice])[0].removeprefix("name: ")
    below, entries = ConfigFile(), own.defaults
    if (group, name) in registry.plugin_classes():
        cls, _ = registry.plugin_classes()[group, name]
        values = {key: "null" if value is None else value for key, value in plugin_defaults(cls).items()}
        lines = {key: [f"{key}: {value}"] for key, value in {"name": name, **values}.items()}
        below = ConfigFile((cls.__doc__ or "").strip().partition("\n")[0], settings=lines)
        entries = [*([SHARED[group]] if group in SHARED else []), *entries]
    for entry in entries:
        if isinstance(entry, dict):  # {/loader@_here_: pairs}
            bases = [f"{key[1:-7]}/{value}" for key, value in entry.items() if key.endswith("@_here_")]
        else:
            bases = [f"{group}/{entry}"] if entry != "_self_" else []
        for base in bases:
            below.settings |= read(base, config_dir).settings
    return ConfigFile(own.summary or below.summary, own.defaults, {**below.settings, **own.settings})


def parse(text: str) -> ConfigFile:
    """Split the text of a YAML file into its parts."""
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
    defaults = yaml.safe_load("\n".join(parts.settings.pop("defaults", []))) or {}
    parts.defaults = defaults.get("defaults") or []
    return parts


def plugin_defaults(cls: type) -> dict[str, Any]:
    """The settings of a constructor, each with its default or the marker of a required value."""
    settings, _ = registry.parameters(cls)
    return {key: registry.MISSING if each.default is each.empty else each.default for key, each in settings.items()}


def experiments(command: str, config_dir: str | None = None) -> list[str]:
    """The experiments for a command: those without choices or settings that only other commands have."""
    folders = conf_folders(config_dir)
    words = {file.stem: _words(file) for folder in folders for file in folder.glob("*.yaml")}
    others = {word for each in words.values() for word in each} - words[command] - words["base"] - {"experiment"}
    files = [file for folder in folders for file in folder.glob("experiment/*.yaml")]
    return sorted(file.stem for file in files if not _words(file) & others)


def _words(file: Path) -> set[str]:
    return set(WORD.findall(file.read_text(encoding="utf-8", errors="replace")))


def values(group: str, choice: str) -> dict[str, Any]:
    """The settings of a choice or preset, by name."""
    from omegaconf import OmegaConf

    known = choices(group)
    if choice not in known:
        raise UserError(f"there is no {group} '{choice}'{among(choice, known)}")
    text = "\n".join(line for lines in read(f"{group}/{choice}").settings.values() for line in lines)
    found: Any = OmegaConf.to_container(OmegaConf.create(text))
    return {str(key): value for key, value in found.items()}


def command_help(command: str, overrides: Sequence[str], config_dir: str | None = None) -> str:
    """The help of a command: its purpose, its choices, and each setting with the comment from its YAML file."""
    config = read(command, config_dir)
    given = values_of(overrides)
    entries = [entry for entry in config.defaults if isinstance(entry, dict)]
    groups = {group: given.get(group, choice) for entry in entries for group, choice in entry.items()}
    lines = [f"Usage: lp {command} [key=value ...] [options]", "", config.summary]
    lines += ["", "Choose (group=choice):", ""] if groups else []
    for group in groups:
        known = experiments(command, config_dir) if group == "experiment" else choices(group, config_dir)
        lines.append(f"  {group + ':':12}{', '.join(known)}")
    lines += ["", "Settings (key=value):", ""]
    lines += [f"  {line}" for key, block in config.settings.items() if key not in groups for line in block]
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
