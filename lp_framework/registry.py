"""Names to classes: `@register("solver", "langevin")` makes a class choosable as `solver=langevin`.

The typed arguments of a class's constructor are its settings. An argument that bears the name of a group (`prior`,
`model`, `backbone`, ...) is a *component*: an object of that group that the caller builds and passes, never a setting.

Built-in classes are in the packages of `GROUPS`, imported when a class of the group is asked for; others are in

- *packages* with an entry point in the group `lp_framework.plugins`, whose value is a module to import;
- *folders*: `plugins/` of the working directory and those given to `discover`. A folder that holds Python files or a
  pyproject.toml is one plugin; any other folder is searched for plugins one level down.

A plugin's modules are imported under their own names, with its folder at the end of `sys.path`, so that worker
processes can unpickle its classes. A `conf/` folder beside a module of a plugin (inside it, if it is a package) holds
choices of its own.
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

GROUPS = {  # each with the packages whose import registers its built-in classes
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
MISSING = "???"  # OmegaConf's mark of a value that has to be given

Key = tuple[str, str]  # group, name
_Class = TypeVar("_Class", bound=type)


@dataclass
class _State:
    classes: dict[Key, tuple[type, str]] = field(default_factory=dict)  # with their origins
    conf_folders: dict[Path, str] = field(default_factory=dict)  # with their origins
    failures: dict[str, str] = field(default_factory=dict)  # by origin
    seen: set[str | Path] = field(default_factory=set)  # where has been looked already
    loading: str | None = None  # origin of the plugin being imported


_state = _State()


def register(group: str, name: str) -> Callable[[_Class], _Class]:
    """Class decorator: make the class choosable as `group=name`.

    Raises `UserError` for an unknown group, and for a name that another class of the group already has.
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
    """The folder of the built-in configs: inside the package when installed, else beside it in the source tree."""
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
    """The class registered as `group=name`; `UserError` with the known names where there is none."""
    known = names(group)
    if name not in known:
        raise UserError(f"there is no {group} '{name}'{among(name, known)}")
    return _state.classes[group, name][0]


def plugin_classes() -> dict[Key, tuple[type, str]]:
    """The classes that plugins have registered, by group and name, each with its origin."""
    discover()
    return {key: (cls, origin) for key, (cls, origin) in _state.classes.items() if origin != BUILT_IN}


def failures() -> dict[str, str]:
    """Plugins that could not be loaded: origin to error."""
    discover()
    return dict(_state.failures)


def conf_folders() -> dict[Path, str]:
    """The `conf/` folders that plugins bring, each with its origin, in the order in which the plugins were found."""
    discover()
    return dict(_state.conf_folders)


def build(group: str, settings: Mapping[str, Any] | str, **components: object) -> Any:
    """An instance of the class that `settings` names: `{"name": ..., setting: value, ...}`, or the name alone.

    `components` are the available objects by group (`model=network, prior=prior`); the constructor gets those that it
    declares. Raises `UserError` for an unknown name or setting, a setting without a value, a value that does not fit
    its type, and a component that is needed and missing; what the constructor raises passes through.
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
    """The components that a class's constructor declares, that is its arguments named after a group."""
    return list(parameters(cls)[1])


def parameters(cls: type) -> tuple[dict[str, inspect.Parameter], dict[str, inspect.Parameter]]:
    """The settings and the components of a class's constructor, by name."""
    named = inspect.signature(cls).parameters.items()
    wanted = {key: each for key, each in named if each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)}
    settings = {key: each for key, each in wanted.items() if key not in GROUPS}
    return settings, {key: each for key, each in wanted.items() if key in GROUPS}


def checked(function: Callable[..., Any], values: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """The values as the function's type hints want them: a whole number for a float becomes one, a list a tuple.

    Raises `UserError` for a value that does not fit the hint of the argument of its name. Objects other than names and
    numbers are passed on as they are.
    """
    from pydantic import TypeAdapter, ValidationError
    from pydantic.errors import PydanticUserError

    try:
        hints = typing.get_type_hints(function)
    except NameError:  # names that only a type checker imports
        return dict(values)
    found = dict(values)
    for key, value in values.items():
        hint = hints.get(key, Any)
        try:
            # As JSON, in which a list fits a tuple and text fits a path; strictly, so that text never fits a number.
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
    """Load the plugins: entry points, `plugins/` of the working directory, and `folders`; each of them once.

    Raises `UserError` for one of the `folders` that does not exist or holds no plugin.
    """
    if _state.loading is not None:  # a plugin that asks for names while it is being imported
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
    """The folder itself where it is a plugin, otherwise the plugins one level down."""

    def is_plugin(place: Path) -> bool:
        return place.is_dir() and ((place / "pyproject.toml").exists() or any(place.glob("*.py")))

    return [folder] if is_plugin(folder) else sorted(filter(is_plugin, folder.glob("*")))


def _load_plugin(folder: Path) -> None:
    """Import the modules and packages of a plugin's folder; of a folder that is a package, only that package."""
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
    """Import a module, which has to be that of the file `wanted`, and note the `conf/` folder beside it."""
    file = getattr(importlib.import_module(name), "__file__", None)
    if wanted is not None and (file is None or Path(file).resolve() != wanted):
        raise ImportError(f"the name of its module '{name}' is already used by {file or 'another'}")
    if file is not None and (conf := Path(file).parent / "conf").is_dir():
        _state.conf_folders.setdefault(conf, str(_state.loading))


@contextmanager
def _guarded(origin: str) -> Iterator[None]:
    """Import a plugin: what it registers gets `origin`; when it fails, nothing of it stays but the error."""
    _state.loading, before = origin, (dict(_state.classes), dict(_state.conf_folders))
    try:
        yield
    except (Exception, SystemExit) as error:
        _state.classes, _state.conf_folders = before
        _state.failures[origin] = f"{type(error).__name__}: {error}"
    finally:
        _state.loading = None
