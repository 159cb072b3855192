"""Names to classes: `@register("solver", "langevin")` makes a class choosable as `solver=langevin`.

The typed arguments of a class's constructor are its settings and the first line of its docstring its description. An
argument that bears the name of a group (`prior`, `model`, `backbone`, ...) is a *component*: an object of that group
that the caller builds and hands over, never a setting.

Where classes come from:

- *built-in*: the sources of this package are read, not run; a module is imported when one of its classes is asked for;
- *packages* with an entry point in the group `lp_framework.plugins`, whose value is a module to import;
- *folders*: `plugins/` of the working directory and those given to `discover`. A folder that holds Python files or a
  pyproject.toml is one plugin; any other folder is looked through for plugins, one level down.

A plugin's modules are imported under their own names, with its folder at the end of `sys.path`, so that worker
processes can unpickle its classes. A plugin that fails is kept in `failures()` with its error, and the rest load.
A `conf/` folder beside a module of a plugin (inside it, if it is a package) is listed in `conf_folders()`.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import inspect
import numbers
import re
import sys
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from lp_framework.errors import UserError, nearest
from lp_framework.registry_sources import BUILT_IN, GROUPS, PACKAGE, Argument, Entry, Key, built_ins, first_line

__all__ = [
    "GROUPS",
    "build",
    "component_names",
    "conf_folders",
    "discover",
    "entries",
    "failures",
    "get",
    "names",
    "plugin_folders",
    "register",
]

ENTRY_POINTS = "lp_framework.plugins"
MISSING = "???"  # OmegaConf's mark of a value that has to be given

_Class = TypeVar("_Class", bound=type)


@dataclass
class _State:
    """What has been found so far."""

    classes: dict[Key, type]
    origins: dict[Key, str]
    failures: dict[str, str]
    conf_folders: list[Path]
    seen: set[str]  # plugins already tried, by folder or entry point
    folders: list[Path]  # those given to `discover`
    loading: str | None = None  # origin of the plugin being imported


_state = _State({}, {}, {}, [], set(), [])


# ---------------------------------------------------------------- registering


def register(group: str, name: str) -> Callable[[_Class], _Class]:
    """Class decorator: make the class choosable as `group=name`.

    Raises `UserError` for an unknown group, and for a name that another class of the group has already.
    """
    _check_group(group)

    def record(cls: _Class) -> _Class:
        built_in = cls.__module__.partition(".")[0] == PACKAGE
        origin = BUILT_IN if built_in else _state.loading or f"module {cls.__module__}"
        other = _owner(group, name, scan=not built_in)
        if other is not None and other[:2] != (cls.__module__, cls.__qualname__):
            raise UserError(
                f"{group} '{name}' is registered twice: by {other[0]}.{other[1]} ({other[2]}) and by "
                f"{cls.__module__}.{cls.__qualname__} ({origin}); give one of them another name"
            )
        _state.classes[group, name] = cls
        _state.origins[group, name] = origin
        return cls

    return record


def _owner(group: str, name: str, scan: bool) -> tuple[str, str, str] | None:
    """Module, class and origin that have the name already; `scan` looks among built-ins not yet imported, too."""
    if cls := _state.classes.get((group, name)):
        return cls.__module__, cls.__qualname__, _state.origins[group, name]
    entry = built_ins().get((group, name)) if scan else None
    return (entry.module, entry.qualname, entry.origin) if entry else None


# ---------------------------------------------------------------- looking up


def names(group: str) -> list[str]:
    """The names of a group, sorted.

    >>> "score" in names("model")
    True
    """
    _check_group(group)
    discover()
    return sorted(name for found, name in {*built_ins(), *_state.classes} if found == group)


def entries(group: str | None = None) -> list[Entry]:
    """Every registered class of a group, or of all groups, sorted by group and name; imports no built-in."""
    groups = GROUPS if group is None else (group,)
    return [_entry(each, name) for each in groups for name in names(each)]


def get(group: str, name: str) -> type:
    """The class registered as `group=name`; `UserError` with the known names where there is none."""
    known = names(group)
    if name not in known:
        raise UserError(f"there is no {group} '{name}'{nearest(name, known)} (known: {', '.join(known) or 'none'})")
    if (group, name) not in _state.classes:
        entry = built_ins()[group, name]
        try:
            module = importlib.import_module(entry.module)
        except ModuleNotFoundError as error:
            if error.name is None or error.name.partition(".")[0] == PACKAGE:
                raise
            raise UserError(
                f"{group} '{name}' needs the Python package '{error.name}', which is not installed: "
                f"pip install '{_requirement(error.name)}'"
            ) from error
        return typing.cast(type, getattr(module, entry.qualname))
    return _state.classes[group, name]


def failures() -> dict[str, str]:
    """Plugins that could not be loaded: origin to error."""
    discover()
    return dict(_state.failures)


def conf_folders() -> list[Path]:
    """The `conf/` folders that plugins bring, in the order in which the plugins were found."""
    discover()
    return list(_state.conf_folders)


def plugin_folders() -> list[Path]:
    """The folders given to `discover` so far."""
    return list(_state.folders)


# ---------------------------------------------------------------- building


def build(group: str, config: Mapping[str, Any] | str, **components: object) -> Any:
    """An instance of the class that `config` names: `{"name": ..., setting: value, ...}`, or the name alone.

    `components` are the objects at hand by group (`model=network, prior=prior`); the constructor gets those that it
    declares. Raises `UserError` for an unknown name or setting, a setting without a value, a value that
    does not fit its type, and a component that is needed and not at hand; what the constructor raises passes through.
    """
    settings = {"name": config} if isinstance(config, str) else _plain(config)
    name = settings.pop("name", None)
    if not isinstance(name, str):
        raise UserError(f"the configuration of a {group} has no name: choose one with {group}=NAME")
    cls = get(group, name)
    arguments, wanted = _parameters(cls)
    for key in settings:
        if key not in arguments:
            reason = "is handed over, it cannot be set there" if key in wanted else "is none of its settings"
            raise UserError(
                f"{group} '{name}': '{key}' {reason}{nearest(key, arguments)} (known: {', '.join(arguments) or 'none'})"
            )
    for key, parameter in arguments.items():
        value = settings.get(key, parameter.default)
        if value is inspect.Parameter.empty or (isinstance(value, str) and value == MISSING):
            raise UserError(f"{group} '{name}' needs a value for '{key}': give {group}.{key}=VALUE")
    _check_types(group, name, cls, settings)
    handed = {key: components[key] for key in wanted if components.get(key) is not None}
    for key, parameter in wanted.items():
        if key not in handed and parameter.default is inspect.Parameter.empty:
            raise UserError(f"{group} '{name}' needs a {key}: choose one with {key}=NAME")
    return cls(**settings, **handed)


def component_names(cls: type) -> list[str]:
    """The components that a class's constructor declares, that is its arguments named after a group."""
    return list(_parameters(cls)[1])


def _parameters(cls: type) -> tuple[dict[str, inspect.Parameter], dict[str, inspect.Parameter]]:
    """The constructor's settings and components, by name."""
    named = {
        key: parameter
        for key, parameter in inspect.signature(cls).parameters.items()
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
    }
    settings = {key: value for key, value in named.items() if key not in GROUPS}
    return settings, {key: value for key, value in named.items() if key in GROUPS}


def _plain(config: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration with OmegaConf's containers turned into dicts and lists, interpolations resolved."""
    from omegaconf import OmegaConf

    def plain(value: Any) -> Any:
        return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value

    whole: Mapping[str, Any] = plain(config)
    return {str(key): plain(value) for key, value in whole.items()}


def _check_types(group: str, name: str, cls: type, settings: Mapping[str, Any]) -> None:
    try:
        hints = typing.get_type_hints(cls.__init__)  # type: ignore[misc]
    except NameError:  # names that only a type checker imports
        return
    for key, value in settings.items():
        hint = hints.get(key, Any)
        if not fits(value, hint):
            if typing.get_origin(hint) is typing.Literal:
                choices = list(map(str, typing.get_args(hint)))
                reason = f"is none of its values{nearest(str(value), choices)} (known: {', '.join(choices)})"
            else:
                reason = f"is not of its type, {inspect.formatannotation(hint).replace('collections.abc.', '')}"
            raise UserError(f"{group} '{name}': {key}={value} {reason}")


def fits(value: object, hint: Any) -> bool:
    """Whether a plain value can be passed for a type hint; hints that are not of plain values take anything."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, each) for each in arguments)
    if origin is typing.Literal:
        return value in arguments
    if origin in (list, tuple, Sequence):
        if not isinstance(value, list | tuple):
            return False
        if origin is tuple and arguments[-1] is not Ellipsis:
            return len(value) == len(arguments) and all(map(fits, value, arguments))
        return all(fits(each, arguments[0]) for each in value)
    if hint in (int, float):
        kind = numbers.Integral if hint is int else numbers.Real
        return isinstance(value, kind) and not isinstance(value, bool)
    if hint is Path:
        return isinstance(value, str | Path)
    return isinstance(value, hint) if hint in (bool, str, type(None)) else True


def _requirement(module: str) -> str:
    """What pip has to install for a module: the extra of this package that brings it, or the module's own name."""
    wanted = module.partition(".")[0].replace("_", "-").lower()
    try:
        requirements = importlib.metadata.requires(PACKAGE) or []
    except importlib.metadata.PackageNotFoundError:
        requirements = []
    for requirement in requirements:
        match = re.match(r"([\w.-]+).*;.*extra == ['\"]([\w-]+)", requirement)
        if match and match[1].replace("_", "-").lower() == wanted:
            return f"{PACKAGE}[{match[2]}]"
    return wanted


# ---------------------------------------------------------------- discovery of plugins


def discover(folders: Iterable[str | Path] = ()) -> None:
    """Load the plugins: entry points, `plugins/` of the working directory, and `folders`; each of them once.

    Raises `UserError` for a folder that does not exist or holds no plugin.
    """
    if _state.loading is not None:  # a plugin that asks for names while it is being imported
        return
    for point in _entry_points():
        if _first_time(f"entry point {point.name}={point.value}"):
            package = f"{point.dist.name} {point.dist.version}" if point.dist else point.name
            _load_entry_point(point.module, f"package {package}")
    here = Path("plugins")
    if here.is_dir():
        _load_folder(here.resolve())
    for folder in map(Path, folders):
        if not folder.is_dir():
            raise UserError(f"plugins=[{folder}]: there is no such folder (looked in {Path.cwd()})")
        path = folder.resolve()
        if not _load_folder(path):
            raise UserError(f"plugins=[{folder}]: neither this folder nor a folder in it holds Python files")
        if path not in _state.folders:
            _state.folders.append(path)


@cache
def _entry_points() -> tuple[importlib.metadata.EntryPoint, ...]:
    """Looked for once: that means to read the metadata of every package that is installed."""
    return tuple(importlib.metadata.entry_points(group=ENTRY_POINTS))


def _first_time(plugin: str) -> bool:
    if plugin in _state.seen:
        return False
    _state.seen.add(plugin)
    return True


def _load_entry_point(module: str, origin: str) -> None:
    with _guarded(origin):
        importlib.import_module(module)
        spec = importlib.util.find_spec(module)
        if spec is not None and spec.origin is not None:
            _add_conf(Path(spec.origin))


def _load_folder(folder: Path) -> bool:
    """Load the folder's plugin, or the plugins one level down; whether there is any."""
    plugins = [folder] if _is_plugin(folder) else sorted(filter(_is_plugin, folder.iterdir()))
    for plugin in plugins:
        if _first_time(str(plugin)):
            _load_plugin(plugin)
    return bool(plugins)


def _is_plugin(folder: Path) -> bool:
    return folder.is_dir() and ((folder / "pyproject.toml").exists() or any(folder.glob("*.py")))


def _load_plugin(folder: Path) -> None:
    relative = folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder
    with _guarded(f"folder {relative}"):
        modules = _modules(folder)
        if not modules:
            raise ImportError("it holds no Python module or package")
        place = folder.parent if (folder / "__init__.py").exists() else folder
        if str(place) not in sys.path:
            sys.path.append(str(place))
        importlib.invalidate_caches()
        for name, file in modules.items():
            spec = importlib.util.find_spec(name)
            if spec is None or spec.origin is None or Path(spec.origin).resolve() != file:
                raise ImportError(f"the name of its module '{name}' is taken by {spec.origin if spec else 'another'}")
            importlib.import_module(name)
            _add_conf(file)


def _modules(folder: Path) -> dict[str, Path]:
    """The modules and packages of a plugin's folder by name; of a folder that is a package, only that package."""
    if (folder / "__init__.py").exists():
        return {folder.name: folder / "__init__.py"}
    modules = {file.stem: file for file in sorted(folder.glob("*.py"))}
    packages = {file.parent.name: file for file in sorted(folder.glob("*/__init__.py"))}
    return {
        name: file
        for name, file in {**modules, **packages}.items()
        if name not in ("setup", "conftest", "tests") and not name.startswith("test_")
    }


def _add_conf(module: Path) -> None:
    folder = module.parent / "conf"
    if folder.is_dir() and folder not in _state.conf_folders:
        _state.conf_folders.append(folder)


@contextmanager
def _guarded(origin: str) -> Iterator[None]:
    """Import a plugin: what it registers gets `origin`; when it fails nothing of it stays but the error."""
    classes, origins = dict(_state.classes), dict(_state.origins)
    _state.loading = origin
    try:
        yield
    except (Exception, SystemExit) as error:
        _state.classes, _state.origins = classes, origins
        _state.failures[origin] = f"{type(error).__name__}: {error}"
    finally:
        _state.loading = None


# ---------------------------------------------------------------- describing


def _check_group(group: str) -> None:
    if group not in GROUPS:
        raise UserError(f"there is no group '{group}'{nearest(group, GROUPS)} (known: {', '.join(GROUPS)})")


def _entry(group: str, name: str) -> Entry:
    built_in = built_ins().get((group, name))
    if built_in is not None:
        return built_in
    cls = _state.classes[group, name]
    settings, components = _parameters(cls)
    return Entry(
        group,
        name,
        cls.__module__,
        cls.__qualname__,
        _state.origins[group, name],
        first_line(cls.__doc__),
        tuple(map(_argument, settings.values())),
        tuple(map(_argument, components.values())),
    )


def _argument(parameter: inspect.Parameter) -> Argument:
    empty = inspect.Parameter.empty
    annotation = "" if parameter.annotation is empty else inspect.formatannotation(parameter.annotation).strip("'")
    return Argument(parameter.name, annotation, None if parameter.default is empty else repr(parameter.default))
