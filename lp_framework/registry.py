"""Registry of classes by name: `@register("solver", "langevin")` makes a class available as `solver=langevin`.

The typed arguments of a class's constructor are its settings. An argument named after a group (`prior`, `model`,
`backbone`, ...) is a *component*: an object of that group that the caller builds and passes, never a setting.

Built-in classes are in the packages of `GROUPS`, which are imported on first use of the group. Plugins are

- *packages* with an entry point in the group `lp_framework.plugins`, whose value is a module to import;
- *folders*: `plugins/` of the working directory and those passed to `discover`. A folder that contains Python files or
  a pyproject.toml is one plugin; any other folder is searched for plugins one level down.

A plugin's modules are imported under their own names, with its folder at the end of `sys.path`, so that worker
processes can unpickle its classes. A `conf/` folder beside a module of a plugin (inside it, if it is a package) adds
config choices.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import inspect
import json
import re
import sys
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from lp_framework.errors import UserError, among, nearest

GROUPS = {  # each with the packages that register its built-in classes on import
    "model": ("lp_framework.models", "lp_framework.priors"),  # a prior is trained as a model
    "backbone": ("lp_framework.models",),
    "prior": ("lp_framework.priors",),
    "solver": ("lp_framework.solvers",),
    "start": ("lp_framework.solvers",),
    "data": ("lp_framework.data",),
    "renderer": ("lp_framework.data",),
    "figure": ("lp_framework.figures",),
}
PACKAGE = "lp_framework"
BUILT_IN = "built-in"
ENTRY_POINTS = "lp_framework.plugins"
MISSING = "???"  # OmegaConf's marker of a required value

Key = tuple[str, str]  # group, name
_Class = TypeVar("_Class", bound=type)


@dataclass
class _State:
    classes: dict[Key, tuple[type, str]] = field(default_factory=dict)  # with their origins
    conf_folders: dict[Path, str] = field(default_factory=dict)  # with their origins
    failures: dict[str, str] = field(default_factory=dict)  # by origin
    seen: set[str | Path] = field(default_factory=set)  # places already searched
    loading: str | None = None  # origin of the plugin being imported


_state = _State()


def register(group: str, name: str) -> Callable[[_Class], _Class]:
    """Class decorator that makes a class available as `group=name`.

    Raises `UserError` for an unknown group, and for a name already used by another class of the group.
    """
    if group not in GROUPS:
        raise UserError(f"there is no group '{group}'{among(group, GROUPS)}")

    def record(cls: _Class) -> _Class:
        built_in = cls.__module__.partition(".")[0] == PACKAGE
        origin = BUILT_IN if built_in else _state.loading or f"module {cls.__module__}"
        if not built_in and (conf_dir() / group / f"{name}.yaml").is_file():
            raise UserError(f"{group} '{name}' of {origin} has the name of a built-in {group}; give it another name")
        other, where = _state.classes.get((group, name), (cls, origin))
        if (other.__module__, other.__qualname__) != (cls.__module__, cls.__qualname__):
            raise UserError(
                f"{group} '{name}' is registered twice: by {other.__module__}.{other.__qualname__} ({where}) "
                f"and by {cls.__module__}.{cls.__qualname__} ({origin}); give one of them another name"
            )
        _state.classes[group, name] = cls, origin
        return cls

    return record


def conf_dir() -> Path:
    """The folder of the built-in configs: inside the installed package, or beside it in the source tree."""
    inside = Path(__file__).parent / "conf"
    return inside if inside.is_dir() else Path(__file__).parents[1] / "conf"


def names(group: str) -> list[str]:
    """The registered names of a group, sorted.

    >>> "score" in names("model")
    True
    """
    discover()
    for package in GROUPS[group]:
        importlib.import_module(package)
    return sorted(name for found, name in _state.classes if found == group)


def get(group: str, name: str) -> type:
    """The class registered as `group=name`; `UserError` with the known names if there is none."""
    known = names(group)
    if name not in known:
        raise UserError(f"there is no {group} '{name}'{among(name, known)}")
    return _state.classes[group, name][0]


def plugin_classes() -> dict[Key, tuple[type, str]]:
    """The classes registered by plugins, by group and name, each with its origin."""
    discover()
    return {key: (cls, origin) for key, (cls, origin) in _state.classes.items() if origin != BUILT_IN}


def failures() -> dict[str, str]:
    """Plugins that failed to load: origin to error."""
    discover()
    return dict(_state.failures)


def conf_folders() -> dict[Path, str]:
    """The `conf/` folders of plugins, each with its origin, in order of discovery."""
    discover()
    return dict(_state.conf_folders)


def build(group: str, settings: Mapping[str, Any] | str, **components: object) -> Any:
    """Build an instance from `settings`: `{"name": ..., setting: value, ...}`, or just the name.

    `components` are the available objects by group (`model=network, prior=prior`); the constructor gets those that it
    declares. Raises `UserError` for an unknown name or setting, a setting without a value, a value of the wrong type,
    and a missing required component; exceptions raised by the constructor propagate.
    """
    values = {"name": settings} if isinstance(settings, str) else dict(settings)
    name = values.pop("name", None)
    if not isinstance(name, str):
        raise UserError(f"the configuration of a {group} has no name: choose one with {group}=NAME")
    cls = get(group, name)
    arguments, wanted = parameters(cls)
    for key in values:
        if key not in arguments:
            raise UserError(f"{group} '{name}': '{key}' is not one of its settings{among(key, arguments)}")
    for key, parameter in arguments.items():
        if values.get(key, MISSING if parameter.default is parameter.empty else None) == MISSING:
            raise UserError(f"{group} '{name}' needs a value for '{key}': give {group}.{key}=VALUE")
    passed = {key: components[key] for key in wanted if components.get(key) is not None}
    for key, parameter in wanted.items():
        if key not in passed and parameter.default is parameter.empty:
            raise UserError(f"{group} '{name}' needs a {key}: choose one with {key}=NAME")
    return cls(**checked(cls.__init__, values, f"{group} '{name}': "), **passed)  # type: ignore[misc]


def component_names(cls: type) -> list[str]:
    """The components of a class's constructor, that is, its arguments named after a group."""
    return list(parameters(cls)[1])


def parameters(cls: type) -> tuple[dict[str, inspect.Parameter], dict[str, inspect.Parameter]]:
    """The settings and the components of a class's constructor, by name."""
    named = inspect.signature(cls).parameters.items()
    wanted = {key: each for key, each in named if each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)}
    settings = {key: each for key, each in wanted.items() if key not in GROUPS}
    return settings, {key: each for key, each in wanted.items() if key in GROUPS}


def checked(function: Callable[..., Any], values: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Convert the values to the function's type hints, for example an int to a float or a list to a tuple.

    Raises `UserError` for a value that does not match the type hint of its argument. Objects other than names and
    numbers are passed through unchanged.
    """
    from pydantic import TypeAdapter, ValidationError
    from pydantic.errors import PydanticUserError

    try:
        hints = typing.get_type_hints(function)
    except NameError:  # names imported only for type checking
        return dict(values)
    found = dict(values)
    for key, value in values.items():
        hint = hints.get(key, Any)
        try:
            # Validate as JSON, where a list matches a tuple and text a path; strictly, so that text is never a number.
            found[key] = TypeAdapter(hint).validate_json(json.dumps(value), strict=True)
        except (TypeError, PydanticUserError):
            continue
        except ValidationError as error:
            if typing.get_origin(hint) is typing.Literal:
                choices = list(map(str, typing.get_args(hint)))
                expected = f"one of {', '.join(choices)}{nearest(str(value), choices)}"
            else:
                expected = inspect.formatannotation(hint).replace("collections.abc.", "").replace("typing.", "")
            raise UserError(f"{prefix}{key}={value} does not fit; expected {expected}") from error
    return found


def discover(folders: Iterable[str | Path] = ()) -> None:
    """Load all plugins, each once: entry points, `plugins/` of the working directory, and `folders`.

    Raises `UserError` if one of the `folders` does not exist or contains no plugin.
    """
    if _state.loading is not None:  # called by a plugin during its own import
        return
    if ENTRY_POINTS not in _state.seen:
        _state.seen.add(ENTRY_POINTS)
        for point in importlib.metadata.entry_points(group=ENTRY_POINTS):
            package = f"{point.dist.name} {point.dist.version}" if point.dist else point.name
            with _guarded(f"package {package}"):
                _import(point.module)
    named = [Path(folder) for folder in folders]
    for folder in (Path("plugins"), *named):
        plugins = _plugins(folder)
        if not plugins and folder in named:
            raise UserError(
                f"plugins=[{folder}]: is not a folder with Python files, and holds none (below {Path.cwd()})"
            )
        for plugin in plugins:
            _load_plugin(plugin)


def _plugins(folder: Path) -> list[Path]:
    """The folder itself if it is a plugin, otherwise the plugins one level down."""

    def is_plugin(place: Path) -> bool:
        return place.is_dir() and ((place / "pyproject.toml").exists() or any(place.glob("*.py")))

    return [folder] if is_plugin(folder) else sorted(filter(is_plugin, folder.glob("*")))


def _load_plugin(folder: Path) -> None:
    """Import the modules and packages in a plugin's folder, or only the package if the folder itself is one."""
    place = folder.resolve()
    if place in _state.seen:
        return
    _state.seen.add(place)
    files = [*place.glob("*.py"), *place.glob("*/__init__.py")]
    if (place / "__init__.py").exists():
        place, files = place.parent, [place / "__init__.py"]
    modules = {file.parent.name if file.stem == "__init__" else file.stem: file for file in sorted(files)}
    wanted = {name: modules[name] for name in modules if not re.fullmatch("setup|conftest|tests|test_.*", name)}
    with _guarded(f"folder {folder}"):
        if not wanted:
            raise ImportError("it holds no Python module or package")
        if str(place) not in sys.path:
            sys.path.append(str(place))
        importlib.invalidate_caches()
        for name, file in wanted.items():
            _import(name, file)


def _import(name: str, wanted: Path | None = None) -> None:
    """Import a module, check that it is the file `wanted`, and record the `conf/` folder beside it."""
    file = getattr(importlib.import_module(name), "__file__", None)
    if wanted is not None and (file is None or Path(file).resolve() != wanted):
        raise ImportError(f"the name of its module '{name}' is already used by {file or 'another'}")
    if file is not None and (conf := Path(file).parent / "conf").is_dir():
        _state.conf_folders.setdefault(conf, str(_state.loading))


@contextmanager
def _guarded(origin: str) -> Iterator[None]:
    """Import a plugin: its classes get `origin`; if it fails, everything is rolled back and only the error is kept."""
    _state.loading, before = origin, (dict(_state.classes), dict(_state.conf_folders))
    try:
        yield
    except (Exception, SystemExit) as error:
        _state.classes, _state.conf_folders = before
        _state.failures[origin] = f"{type(error).__name__}: {error}"
    finally:
        _state.loading = None
