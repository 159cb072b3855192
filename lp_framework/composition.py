"""The registry's groups as Hydra configs, and where configs come from.

A member of one of the registry's groups (`solver=langevin`) is a node of a name and numbers: `{name: langevin, alpha:
0.1, ...}`. hydra-zen derives its keys, types and defaults from the class's constructor; `solver/langevin.yaml` in any
conf folder overrides the defaults. A YAML with a key `name` is a preset, one more choice: `prior/zero123_xl.yaml` with
`name: zero123`. Everything else in the conf folders is ordinary Hydra.

Conf folders, later ones win: this package's, those of plugins, that of Hydra's `--config-dir`.
"""

from __future__ import annotations

import dataclasses
import os
import types
import typing
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.object_type import ObjectType
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from lp_framework import registry
from lp_framework.constructors import outline
from lp_framework.errors import UserError, nearest

_Names = list[str]  # the method `list` of Hydra's interface hides the type


def conf_dir() -> Path:
    """The folder of this package's configs: inside the package when installed, else beside it in the source tree."""
    inside = Path(__file__).parent / "conf"
    return inside if inside.is_dir() else Path(__file__).parents[1] / "conf"


def conf_folders(config_dir: str | None = None) -> list[Path]:
    """All conf folders, later ones win; `config_dir` is the command line's."""
    return [conf_dir(), *registry.conf_folders(), *([Path(config_dir).absolute()] if config_dir else [])]


def group_names() -> list[str]:
    """The groups that can be chosen from on the command line, the registry's and the folders of configs."""
    folders = [each for folder in conf_folders(RegistrySearchPath.config_dir) for each in folder.glob("*/")]
    return sorted({*registry.GROUPS, *(each.name for each in folders if each.is_dir())} - {"hydra"})


def experiments(command: str) -> list[str]:
    """The experiments that go with a command: it has all groups from which they choose, and they set nothing that other
    commands have and it has not."""
    commands = {file.stem: _keys(file) for file in conf_dir().glob("*.yaml")}
    own = commands[command] | commands["base"]
    others = {key for keys in commands.values() for key in keys} - own
    found = {}
    for folder in conf_folders(RegistrySearchPath.config_dir):
        for file in folder.glob("experiment/*.yaml"):
            keys = _keys(file)
            chosen = {key.partition("override /")[2] for key in keys} - {""}
            found[file.stem] = {"experiment", *chosen} <= own and not keys & others
    return sorted(name for name, fits in found.items() if fits)


def _keys(file: Path) -> set[str]:
    """The keys of a file and the groups in its defaults list; none of a file that does not load."""
    try:
        values = _load(file)
    except (UserError, OSError, UnicodeDecodeError):
        return set()
    defaults = values.get("defaults")
    entries = defaults if isinstance(defaults, ListConfig) else []
    return {*map(str, values), *(str(key) for each in entries if isinstance(each, DictConfig) for key in each)}


# ---------------------------------------------------------------- nodes of the registry's groups


def node(group: str, choice: str, folders: Sequence[Path]) -> DictConfig:
    """The typed config `{name, setting: value, ...}` of `group=choice`: the constructor's, overridden by YAML files.

    `folders` are conf folders, later ones win. Raises `UserError` for a choice that is no registered name and no
    preset, and for a file with an unknown key or a value of the wrong type.
    """
    files = [(file, _load(file)) for file in _files(group, choice, folders)]
    name = choice
    for _, values in files:
        name = str(values.get("name", name))
    known = registry.names(group)
    if files and name not in known:
        raise UserError(
            f"{files[0][0]}: '{name}' is no {group}{nearest(name, known)} (known: {', '.join(known)}); "
            f"a file of another name is a preset and says of what, as in 'name: {known[0] if known else 'NAME'}'"
        )
    with_defaults = any("defaults" in values for _, values in files)
    # A built-in's settings are read from its source: `--help`, and a mistake, then come without importing torch.
    cls = outline((group, name)) or registry.get(group, name)
    result = OmegaConf.structured(_schema(cls, name, with_defaults))
    assert isinstance(result, DictConfig)
    for file, values in files:
        for key in map(str, values):
            if key not in result:
                keys = [str(each) for each in result]
                raise UserError(
                    f"{file}: {group} '{name}' has no '{key}'{nearest(key, keys)} (known: {', '.join(keys)})"
                )
        try:
            result.merge_with(values)
        except OmegaConfBaseException as error:
            raise UserError(f"{file}: {one_line(error)}") from error
    return result


@cache
def _schema(cls: type, name: str, with_defaults: bool) -> type:
    """A dataclass of the registered name and the constructor's typed arguments, components left out."""
    from hydra_zen import builds  # takes a while to import

    built: Any = builds(cls, populate_full_signature=True, zen_exclude=registry.component_names(cls))
    hints = typing.get_type_hints(cls.__init__)  # type: ignore[misc]
    fields: list[Any] = [("name", str, dataclasses.field(default=name))]
    if with_defaults:  # the defaults list of a YAML file, which Hydra takes out again
        fields.append(("defaults", list[Any], dataclasses.field(default_factory=list)))
    for each in dataclasses.fields(built):
        if each.name != "_target_":
            value = dataclasses.field(default=each.default, default_factory=each.default_factory)
            fields.append((each.name, _type(each.type, hints.get(each.name)), value))
    return dataclasses.make_dataclass(cls.__name__, fields, kw_only=True)


def _type(derived: Any, hint: Any) -> Any:
    """The type that hydra-zen derived, or a `X | Y` that it gives up on (`Any`) and OmegaConf can check."""
    if derived is not Any or not isinstance(hint, types.UnionType):
        return derived
    try:
        OmegaConf.structured(dataclasses.make_dataclass("Probe", [("value", hint)]))
    except (OmegaConfBaseException, ValueError):
        return Any
    return hint


def one_line(error: BaseException) -> str:
    """An error's message in one line, without the lines that OmegaConf and Hydra add for themselves."""
    lines = [line.strip() for line in str(error).splitlines()]
    return " ".join(line for line in lines if line and not line.startswith(("full_key:", "object_type=", "See https:")))


def _files(group: str, choice: str, folders: Sequence[Path]) -> list[Path]:
    files = [folder / group / f"{choice}.yaml" for folder in folders]
    return [file for file in files if file.is_file()]


def _load(file: Path) -> DictConfig:
    try:
        values = OmegaConf.load(file)
    except YAMLError as error:
        raise UserError(f"{file}: not valid YAML: {one_line(error)}") from error
    if not isinstance(values, DictConfig):
        raise UserError(f"{file}: a configuration is a mapping 'key: value', not a list")
    return values


class RegistrySource(ConfigSource):
    """The registry's groups as a source of Hydra configs; nothing is imported but what is chosen.

    Its path holds the conf folders, `registry://FOLDER:FOLDER`. A sweep's workers get the source pickled, and with it
    the plugin folders.
    """

    def __init__(self, provider: str, path: str) -> None:
        super().__init__(provider, path)
        self.folders = [Path(each) for each in self.path.split(os.pathsep) if each]
        self.plugins = registry.plugin_folders()

    @staticmethod
    def scheme() -> str:
        """How its path begins."""
        return "registry"

    def available(self) -> bool:
        """Always there."""
        return True

    def is_group(self, config_path: str) -> bool:
        """Whether the path is a group with members."""
        return config_path == "" or bool(self._choices(config_path))

    def is_config(self, config_path: str) -> bool:
        """Whether the path is `GROUP/CHOICE`."""
        group, _, choice = config_path.removesuffix(".yaml").partition("/")
        return choice in self._choices(group)

    def list(self, config_path: str, results_filter: ObjectType | None) -> _Names:
        """The groups, or the choices of a group."""
        if config_path == "":
            groups = [group for group in registry.GROUPS if self.is_group(group)]
            return [] if results_filter == ObjectType.CONFIG else groups
        return [] if results_filter == ObjectType.GROUP else self._choices(config_path)

    def load_config(self, config_path: str) -> ConfigResult:
        """The node of `GROUP/CHOICE`."""
        group, _, choice = config_path.removesuffix(".yaml").partition("/")
        header: dict[str, str | None] = {"package": None}
        for file in _files(group, choice, self.folders):
            header = {**header, **self._get_header_dict(file.read_text(encoding="utf-8"))}
        config = node(group, choice, self.folders)
        return ConfigResult(provider=self.provider, path=self.full_path(), config=config, header=header)

    def _choices(self, path: str) -> _Names:
        group = path.rstrip("/")
        if group not in registry.GROUPS:
            return []
        registry.discover(self.plugins)  # anew in a worker process
        presets = (file.stem for folder in self.folders for file in (folder / group).glob("*.yaml"))
        return sorted({*registry.names(group), *presets})


class RegistrySearchPath(SearchPathPlugin):
    """Puts the registry before the conf folders, and the conf folders of plugins after this package's."""

    config_dir: str | None = None  # of the command line

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Called by Hydra with the path that it has so far."""
        folders = os.pathsep.join(map(str, conf_folders(self.config_dir)))
        search_path.prepend("registry", f"{RegistrySource.scheme()}://{folders}")
        for folder in registry.conf_folders():
            search_path.append("plugin", f"file://{folder}")
