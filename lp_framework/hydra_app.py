"""A command as a Hydra application, and what goes wrong in it told in one sentence."""

from __future__ import annotations

import argparse
import difflib
import importlib
import logging
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    InterpolationResolutionError,
    MissingMandatoryValue,
    OmegaConfBaseException,
)
from yaml import YAMLError

from lp_framework import registry
from lp_framework.cli import COMMANDS
from lp_framework.composition import RegistrySearchPath, RegistrySource, conf_dir, experiments, group_names, one_line
from lp_framework.errors import UserError, nearest

log = logging.getLogger(__name__)

OPTIONS = (  # Hydra's
    *("--help", "-h", "--hydra-help", "--version", "--cfg", "-c", "--resolve", "--package", "-p", "--run", "-r"),
    *("--multirun", "-m", "--shell-completion", "-sc", "--config-path", "-cp", "--config-name", "-cn"),
    *("--config-dir", "-cd", "--experimental-rerun", "--info", "-i"),
)
WITH_VALUE = (
    *("--cfg", "-c", "--package", "-p", "--config-path", "-cp", "--config-name", "-cn", "--config-dir", "-cd"),
    *("--experimental-rerun", "--info", "-i"),
)
LAUNCHER = "hydra/launcher/"
LAUNCHERS = {  # those of Hydra's plugins, with the extra that brings each
    **{"joblib": "sweeps", "submitit_local": "sweeps", "submitit_slurm": "sweeps"},
    **{"ray": "ray", "ray_aws": "ray"},
}
COMPOSING = ("hydra._internal.config_loader_impl", "hydra.core.override_parser.overrides_parser")  # modules of Hydra
SHOWING = ("show_cfg", "show_info")  # functions of Hydra
HYDRA_VALUE_ERRORS = ("Config group override must be", "Only one of --run", "The --resolve flag")


class UsageError(UserError):
    """A command line that makes no sense."""


def run(command: str, arguments: Sequence[str]) -> None:
    """Compose `conf/COMMAND.yaml` with the arguments (overrides and Hydra's options), and run the command with it.

    The command is `lp_framework.commands.COMMAND.run(config)`, imported only when it runs. Raises `UsageError` for
    arguments that do not compose, `UserError` for bad input met while running; in a sweep the other jobs go on first.
    """
    arguments = _overrides_first(arguments)
    options = _options(arguments)
    try:
        registry.discover(_plugin_folders(arguments))
    except HydraException as error:
        raise UsageError(_explain(error)) from error
    for origin, failure in registry.failures().items():
        print(f"warning: plugin {origin} could not be loaded: {failure}", file=sys.stderr)
    RegistrySearchPath.config_dir = options.get("--config-dir")
    Plugins.instance().register(RegistrySource)
    Plugins.instance().register(RegistrySearchPath)
    failed: list[UserError] = []
    task = _task(command, [each for pair in options.items() for each in pair], failed)
    try:
        with _set_up_for_hydra(arguments):
            hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=command)(task)()
    except ConfigCompositionException as error:
        name = options.get("--config-name", command)
        raise UsageError(_wrong_experiment(name, str(error)) or _explain(error)) from error
    except (HydraException, YAMLError, MissingMandatoryValue, InterpolationResolutionError) as error:
        raise UsageError(_explain(error)) from error
    except UserError:
        raise
    except Exception as error:
        if str(error).startswith(HYDRA_VALUE_ERRORS):
            raise UsageError(one_line(error)) from error
        if isinstance(error, OSError) and not _in_a_job(error):
            raise UsageError(f"this run's folder cannot be made: {one_line(error)}") from error
        if _while_composing(error):
            raise UsageError(f"this makes no configuration ({type(error).__name__}: {one_line(error)})") from error
        raise
    if failed:
        raise failed[0]


@contextmanager
def _set_up_for_hydra(arguments: Sequence[str]) -> Iterator[None]:
    """The arguments where Hydra looks for them, and exceptions let through instead of printed."""
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


def _task(command: str, options: Sequence[str], failed: list[UserError]) -> Callable[[DictConfig], None]:
    def task(config: DictConfig) -> None:
        job = HydraConfig.get()
        sweep = job.mode == RunMode.MULTIRUN
        # What starts this very job again, and it alone: Lightning runs it for its other processes.
        own = [override for override in job.overrides.hydra if not override.startswith("hydra.mode=")]
        own += ["hydra.mode=RUN"] if sweep else []  # an experiment may ask for a sweep
        sys.argv = [sys.argv[0], command, *options, *own, *job.overrides.task]
        registry.discover(config.get("plugins", []))
        environment = dict(os.environ)
        try:
            experiment = job.runtime.choices.get("experiment")
            if experiment and (mistaken := _misplaced(str(job.job.config_name), experiment)):
                raise UsageError(mistaken)
            importlib.import_module(f"lp_framework.commands.{command}").run(config)
        except (UserError, MissingMandatoryValue, InterpolationResolutionError) as error:
            mistake = error if isinstance(error, UserError) else UserError(_explain(error))
            if sweep:
                log.error("job %s (%s): %s", job.job.num, ", ".join(job.overrides.task), mistake)
                raise mistake from error
            log.info("stopped: %s", mistake)  # for the log; the console gets it from the caller
            failed.append(mistake)
        except Exception:
            log.log(logging.ERROR if sweep else logging.INFO, "%s failed", command, exc_info=True)
            raise
        finally:
            _leave_processes()
            if sweep:  # the next job would take what Lightning leaves of this one's processes for its own
                os.environ.clear()
                os.environ.update(environment)

    task.__module__ = f"lp_framework.commands.{command}"  # gives the job its name
    return task


def _leave_processes() -> None:
    """End what a job's several processes speak by: its threads do not survive being cut off when this one ends."""
    distributed = sys.modules.get("torch.distributed")
    if distributed is not None and distributed.is_available() and distributed.is_initialized():
        distributed.destroy_process_group()


def _in_a_job(error: Exception) -> bool:
    """Whether an exception comes from a command, and not from Hydra before or after it."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    return any(frame.f_globals.get("__name__") == __name__ and frame.f_code.co_name == "task" for frame in frames)


def _while_composing(error: Exception) -> bool:
    """Whether an exception comes from Hydra's composing or showing a configuration, and not from a job."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    return any(frame.f_globals.get("__name__") in COMPOSING or frame.f_code.co_name in SHOWING for frame in frames)


def _options(arguments: Sequence[str]) -> dict[str, str]:
    """Those of Hydra's options that say where configs are; `UsageError` for a misspelt option."""
    for argument in arguments:
        option = argument.partition("=")[0]
        if option.startswith("-") and option not in OPTIONS:
            raise UsageError(f"there is no option '{option}'{nearest(option, OPTIONS)}")
    hydras = get_args_parser()
    hydras.error = _usage  # type: ignore[method-assign]  # instead of a page and an exit
    hydras.parse_args([argument for argument in arguments if argument != "--version"])
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--config-dir", "-cd")
    parser.add_argument("--config-path", "-cp")
    parser.add_argument("--config-name", "-cn")
    known = vars(parser.parse_known_args(arguments)[0])
    return {f"--{key.replace('_', '-')}": value for key, value in known.items() if value is not None}


def _usage(message: str) -> NoReturn:
    raise UsageError(f"{message} (--help shows the options)")


def _overrides_first(arguments: Sequence[str]) -> list[str]:
    """The arguments with Hydra's options behind the overrides: its parser wants all overrides in one piece."""
    overrides: list[str] = []
    options: list[str] = []
    for before, argument in zip(["", *arguments], arguments, strict=False):
        value = before in WITH_VALUE and ("=" not in argument or before not in ("--info", "-i"))
        (options if argument.startswith("-") or value else overrides).append(argument)
    return [*overrides, *options]


def _plugin_folders(arguments: Sequence[str]) -> list[str]:
    """The value of `plugins=[FOLDER, ...]`: plugins bring choices, so they are loaded before Hydra composes."""
    for argument in reversed(arguments):
        if argument.startswith("plugins="):
            value = OverridesParser.create().parse_override(argument).value()
            return list(map(str, value)) if isinstance(value, list) else [str(value)]
    return []


# ---------------------------------------------------------------- errors in one sentence


def _explain(error: Exception) -> str:
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
            as_list = "" if key in group_names() else f", or write a list, {key}=[{values}]"
            return f"'{override}' has several values: add --multirun to run each{as_list}"
    return one_line(error)


def _wrong_experiment(command: str, message: str) -> str | None:
    """What to say where an experiment does not compose since it is another command's."""
    found = re.match(r"In 'experiment/(.+?)': ", message)
    return found and _misplaced(command, found[1])


def _misplaced(command: str, experiment: str) -> str | None:
    """A sentence where an experiment goes with other commands and not with this one; a config of your own has all."""
    if command not in COMMANDS or experiment in (own := experiments(command)):
        return None
    others = [each for each in COMMANDS if (conf_dir() / f"{each}.yaml").is_file() and experiment in experiments(each)]
    if not others:
        return None
    known = _known(own)
    return f"experiment={experiment}: is none of {command}'s ({known}); it goes with {' or '.join(others)}"


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
        siblings = sorted({*siblings, *group_names()} - {"hydra"})
        inside = [f"{each}.{name}" for each in siblings if name in (error.parent_node.get(each) or ())]
        close = inside or difflib.get_close_matches(name, siblings, n=1, cutoff=0.5)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    return f"{key}: {parent or 'the configuration'} has no '{name}'{hint} ({_known(siblings)})"


def _known(names: Sequence[str]) -> str:
    return f"known: {', '.join(names) or 'none'}"
