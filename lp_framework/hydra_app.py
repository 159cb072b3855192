"""A command as a Hydra application, and what goes wrong in it explained in one sentence."""

from __future__ import annotations

import argparse
import difflib
import importlib
import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    InterpolationResolutionError,
    MissingMandatoryValue,
    OmegaConfBaseException,
)

from lp_framework import catalogue, registry
from lp_framework.errors import UserError, nearest, one_line

log = logging.getLogger(__name__)

INFO = ["all", "config", "defaults", "defaults-tree", "plugins", "searchpath"]
OPTIONS: dict[tuple[str, ...], dict[str, Any]] = {  # Hydra's, as argparse takes them
    ("--help", "-h"): {"action": "store_true"},
    ("--hydra-help",): {"action": "store_true"},
    ("--version",): {"action": "store_true"},
    ("--cfg", "-c"): {"choices": ["job", "hydra", "all"]},
    ("--resolve",): {"action": "store_true"},
    ("--package", "-p"): {},
    ("--run", "-r"): {"action": "store_true"},
    ("--multirun", "-m"): {"action": "store_true"},
    ("--config-path", "-cp"): {},
    ("--config-name", "-cn"): {},
    ("--config-dir", "-cd"): {},
    ("--info", "-i"): {"nargs": "?", "const": "all", "choices": INFO},
}
CONFIG_OPTIONS = ("config_dir", "config_path", "config_name")
LAUNCHER = "hydra/launcher/"
LAUNCHERS = {  # those of Hydra's plugins, with the extra that brings each
    **{"joblib": "sweeps", "submitit_local": "sweeps", "submitit_slurm": "sweeps"},
    **{"ray": "ray", "ray_aws": "ray"},
}


class UsageError(UserError):
    """A command line that makes no sense."""


def run(command: str, arguments: Sequence[str]) -> None:
    """Compose `conf/COMMAND.yaml` with the arguments (overrides and Hydra's options), and run the command with it.

    The command is `lp_framework.commands.COMMAND.run(config)`, imported only when it runs. Raises `UsageError` for
    arguments that do not compose, `UserError` for bad input met while running; in a sweep the other jobs go on first.
    """
    overrides, options = _parse(arguments)
    try:
        registry.discover(_plugin_folders(overrides))
    except HydraException as error:
        raise UsageError(explain(error)) from error
    for source, failure in registry.failures().items():
        print(f"warning: plugin {source} could not be loaded: {failure}", file=sys.stderr)
    if options["help"]:
        print(catalogue.command_help(options["config_name"] or command, overrides, options["config_dir"]))
        return
    _store_plugin_configs()
    if options["config_name"] is None:
        _check_experiment(command, overrides)
    options_line = [word for action, value in options.items() for word in _as_words(action, value)]
    own = [word for action in CONFIG_OPTIONS for word in _as_words(action, options[action])]
    failed: list[UserError] = []
    try:
        with _as_hydra_wants_it([*overrides, *options_line]):
            task = _task(command, own, failed)
            hydra.main(version_base="1.3", config_path=str(registry.conf_dir()), config_name=command)(task)()
    except UserError:
        raise
    except Exception as error:
        if getattr(error, "raised_by_a_command", False):
            raise
        if isinstance(error, OSError) and not isinstance(error, HydraException):
            raise UsageError(f"the folder of this run cannot be made: {one_line(error)}") from error
        raise UsageError(explain(error)) from error
    if failed:
        raise failed[0]


def _task(command: str, options: Sequence[str], failed: list[UserError]) -> Callable[[DictConfig], None]:
    """What Hydra calls with the composed config of each job."""

    def task(config: DictConfig) -> None:
        job = HydraConfig.get()
        sweep = job.mode == RunMode.MULTIRUN
        # The command line that starts this job alone: Lightning runs it for its other processes.
        own = [override for override in job.overrides.hydra if not override.startswith("hydra.mode=")]
        own += ["hydra.mode=RUN"] if sweep else []  # an experiment may ask for a sweep
        sys.argv = [sys.argv[0], command, *options, *own, *job.overrides.task]
        registry.discover(_as_list(config.get("plugins", [])))
        environment = dict(os.environ)
        try:
            importlib.import_module(f"lp_framework.commands.{command}").run(config)
        except (UserError, MissingMandatoryValue, InterpolationResolutionError) as error:
            mistake = error if isinstance(error, UserError) else UserError(explain(error))
            if sweep:
                log.error("job %s (%s): %s", job.job.num, ", ".join(job.overrides.task), mistake)
                raise mistake from error
            log.info("stopped: %s", mistake)  # for the log; the console gets it from the caller
            failed.append(mistake)
        except Exception as error:
            log.log(logging.ERROR if sweep else logging.INFO, "%s failed", command, exc_info=True)
            error.raised_by_a_command = True  # type: ignore[attr-defined]  # also after it was pickled by a launcher
            raise
        finally:
            _leave_processes()
            if sweep:  # the next job would take what Lightning leaves of this one's processes for its own
                os.environ.clear()
                os.environ.update(environment)

    task.__module__ = f"lp_framework.commands.{command}"  # gives the job its name
    return task


def _leave_processes() -> None:
    """Leave the process group of a job with several processes: its threads would block the end of this one."""
    distributed = sys.modules.get("torch.distributed")
    if distributed is not None and distributed.is_available() and distributed.is_initialized():
        distributed.destroy_process_group()


@contextmanager
def _as_hydra_wants_it(arguments: Sequence[str]) -> Iterator[None]:
    """The arguments where Hydra reads them, and exceptions passed on instead of printed."""
    argv, full_error = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    sys.argv = [argv[0], *arguments]
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        yield
    finally:
        sys.argv = argv
        if full_error is None:
            del os.environ["HYDRA_FULL_ERROR"]
        else:
            os.environ["HYDRA_FULL_ERROR"] = full_error


def _store_plugin_configs() -> None:
    """Give Hydra the configs of plugins; a file with a mistake is named, and the others are there."""
    store = ConfigStore.instance()
    for each in catalogue.plugin_nodes():
        if isinstance(each, str):
            print(f"warning: a plugin's configuration is left out: {each}", file=sys.stderr)
        else:
            store.store(each.name, each.values, group=each.group, package=each.package, provider="plugin")


# ---------------------------------------------------------------- the command line


def _parse(arguments: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """The overrides and Hydra's options, in any order; `UsageError` for an option that does not exist."""
    known = [name for names in OPTIONS for name in names]
    for argument in arguments:
        option = argument.partition("=")[0]
        if option.startswith("-") and option not in known:
            raise UsageError(f"there is no option '{option}'{nearest(option, known)}")
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.error = _usage  # type: ignore[method-assign]  # a sentence instead of a page and an exit
    for names, settings in OPTIONS.items():
        parser.add_argument(*names, **settings)
    options, overrides = parser.parse_known_args(arguments)
    return overrides, vars(options)


def _usage(message: str) -> NoReturn:
    raise UsageError(f"{message} (--help shows the options)")


def _as_words(action: str, value: object) -> list[str]:
    """An option as words of a command line."""
    name = f"--{action.replace('_', '-')}"
    return [] if value in (None, False) else [name] if value is True else [name, str(value)]


def _plugin_folders(overrides: Sequence[str]) -> list[str]:
    """The value of `plugins=[FOLDER, ...]`: plugins bring choices, so they are loaded before Hydra composes."""
    for override in reversed(overrides):
        if override.startswith("plugins="):
            return _as_list(OverridesParser.create().parse_override(override).value())
    return []


def _as_list(value: Any) -> list[str]:
    return [str(value)] if isinstance(value, str | int | float) else list(map(str, value or ()))


def _check_experiment(command: str, overrides: Sequence[str]) -> None:
    """`UsageError` for an experiment that belongs to other commands."""
    chosen = [override.partition("=")[2] for override in overrides if override.startswith("experiment=")]
    for experiment in chosen[-1:]:
        own = catalogue.experiments(command)
        commands = [file.stem for file in registry.conf_dir().glob("*.yaml")]
        others = sorted(each for each in commands if experiment in catalogue.experiments(each))
        if experiment not in own and others:
            raise UsageError(
                f"experiment={experiment} belongs to {' and '.join(others)}, not to {command} ({_known(own)})"
            )


# ---------------------------------------------------------------- errors in one sentence


def explain(error: Exception) -> str:
    """What to tell a user of an error that Hydra or OmegaConf raised."""
    cause = error.__cause__ or error.__context__
    match error:
        case MissingConfigException(missing_cfg_file=str(file)) if file.removeprefix(LAUNCHER) in LAUNCHERS:
            launcher = file.removeprefix(LAUNCHER)
            return f"hydra/launcher={launcher} is not installed: pip install 'lp_framework[{LAUNCHERS[launcher]}]'"
        case MissingConfigException(missing_cfg_file=str(file), options=options) if options is not None:
            group, _, choice = file.rpartition("/")
            return f"{group}={choice}: there is no {group} '{choice}'{nearest(choice, options)} ({_known(options)})"
        case OverrideParseException() if "=" not in error.override:
            return f"cannot read '{error.override}': write KEY=VALUE"
        case OverrideParseException():
            return f"cannot read '{error.override}': {one_line(error)}"
        case MissingMandatoryValue():
            return f"{error.full_key} needs a value: give {error.full_key}=VALUE"
        case HydraException() if isinstance(cause, ConfigKeyError | ConfigAttributeError):
            return _place(error) + _unknown_key(cause)
        case HydraException() if isinstance(cause, OmegaConfBaseException):
            return _place(error) + (f"{cause.full_key}: " if cause.full_key else "") + one_line(cause)
        case HydraException() if str(error).startswith("Ambiguous value for argument"):
            override = str(error).split("'")[1]
            key, _, values = override.partition("=")
            as_list = "" if key in catalogue.groups() else f", or write a list, {key}=[{values}]"
            return f"'{override}' has several values: add --multirun to run each{as_list}"
    return one_line(error) or type(error).__name__


def _place(error: Exception) -> str:
    """`"In 'experiment/paper': "` where Hydra says that an error is in a file."""
    place, colon, _ = str(error).partition(": ")
    return place + colon if place.startswith("In '") else ""


def _unknown_key(error: OmegaConfBaseException) -> str:
    key = str(error.full_key)
    parent, _, name = key.rpartition(".")
    siblings = [str(each) for each in error.parent_node or {}]
    if parent:
        close = [f"{parent}.{each}" for each in difflib.get_close_matches(name, siblings, n=1, cutoff=0.5)]
    else:
        siblings = sorted({*siblings, *catalogue.groups()} - {"hydra"})
        inside = [f"{each}.{name}" for each in siblings if _has(error.parent_node, each, name)]
        close = inside or difflib.get_close_matches(name, siblings, n=1, cutoff=0.5)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    return f"{key}: {parent or 'the configuration'} has no '{name}'{hint} ({_known(siblings)})"


def _has(config: Any, key: str, name: str) -> bool:
    """Whether a config has a mapping `key` with an entry `name`; a value may be missing (`???`) or anything else."""
    try:
        return name in config[key]
    except (OmegaConfBaseException, TypeError):
        return False


def _known(names: Sequence[str]) -> str:
    return f"known: {', '.join(names) or 'none'}"
