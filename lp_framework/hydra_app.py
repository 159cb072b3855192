"""Run a command as a Hydra application and explain its errors in one sentence."""

from __future__ import annotations

import argparse
import importlib
import logging
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig, OmegaConf, errors
from yaml import YAMLError

from lp_framework import catalogue, registry
from lp_framework.errors import UserError, among, nearest, one_line
from lp_framework.overrides import quote_paths, values_of
from lp_framework.run_folders import HYDRA, Held, held, relative, remove_if_empty

log = logging.getLogger(__name__)

# Hydra's options; `OPTIONS` with their valid values.
FLAGS = ("--help -h", "--hydra-help", "--resolve", "--multirun -m")
OPTIONS = {
    **dict.fromkeys(("--config-dir -cd", "--config-name -cn", "--package -p")),
    "--cfg -c": ["job", "hydra", "all"],
    "--info -i": ["all", "config", "defaults", "defaults-tree", "plugins", "searchpath"],
}

# Start of warnings, mostly Lightning's, that users of a command cannot or need not act on.
IGNORED_WARNINGS = (
    r"The '\w+' does not have many workers",  # batches are loaded from memory, in this process
    r"Detected pickle protocol \d+ in the checkpoint",  # refused with our own message
    r"`isinstance\(treespec, LeafSpec\)` is deprecated",
    r"The number of training batches .* is smaller than the logging interval",
    r"Found \d+ module\(s\) in eval mode at the start of training",  # a frozen trunk
    r"Checkpoint directory .* exists and is not empty",
    r"Total length of `DataLoader` across ranks is zero",  # a resumed evaluation that only lacks its tables
)

TYPO_RATIO = 0.9  # similarity ratio above which a name is a misspelt known one: max_epoch, but not min_epochs


class UsageError(UserError):
    """An invalid command line."""

    status = 2


def run(command: str, arguments: Sequence[str]) -> None:
    """Compose `conf/COMMAND.yaml` with the arguments and pass the config to `lp_framework.commands.COMMAND.run`.

    Raises `UsageError` for arguments that cannot be composed, and `UserError` for bad input found at run time; in a
    sweep the other jobs run first.
    """
    overrides, options = _parse(arguments)
    overrides = _with_trainer_arguments(quote_paths(command, overrides))
    registry.discover(catalogue.plugin_folders(overrides))
    for source, failure in registry.failures().items():
        print(f"warning: plugin {source} could not be loaded: {failure}", file=sys.stderr)
    if options["help"]:
        print(catalogue.command_help(options["config_name"] or command, overrides, options["config_dir"]))
        return
    _store_plugin_configs(options["config_dir"])
    given = values_of(overrides)
    if options["config_name"] is None and "experiment" in given:
        single = options["cfg"] or options["info"] or "hydra.mode" in given
        options["multirun"] |= _is_sweep(command, given["experiment"]) and not single
    if "resume" in given and (Path(given["resume"].strip("'\"")) / HYDRA).is_dir():
        # Resume in the run's own folder with its log; leave Hydra's record there unchanged.
        overrides += ["hydra.run.dir=${resume}", "hydra.output_subdir=null"]
    failed: list[UserError] = []
    with _restored():
        sys.argv = [sys.argv[0], *overrides, *_as_words(options)]
        os.environ["HYDRA_FULL_ERROR"] = "1"  # raise exceptions instead of printing them
        task = _task(command, _as_words({key: options[key] for key in ("config_dir", "config_name")}), failed)
        try:
            hydra.main(version_base="1.3", config_path=str(registry.conf_dir()), config_name=command)(task)()
        except UserError:
            raise
        except Exception as error:
            if getattr(error, "raised_by_a_command", False):
                raise
            raise UsageError(explain(error)) from error
    if failed:
        raise failed[0]


def _task(command: str, options: Sequence[str], failed: list[UserError]) -> Callable[[DictConfig], None]:
    """The function that Hydra calls with the composed config of each job."""

    def task(config: DictConfig) -> None:
        job = HydraConfig.get()
        sweep = job.mode == RunMode.MULTIRUN
        folder = Path(job.runtime.output_dir)
        registry.discover(catalogue.plugin_folders(job.overrides.task))
        with _restored():  # otherwise the next job would reuse Lightning's environment variables from this one
            # The command line of this job alone, which Lightning runs to start its other processes.
            own = [override for override in job.overrides.hydra if not override.startswith("hydra.mode=")]
            own += ["hydra.mode=RUN"] if sweep else []  # an experiment may ask for a sweep
            sys.argv = [sys.argv[0], command, *options, *own, *job.overrides.task]
            try:
                _check_paths(config)  # before the heavy imports, which take seconds
                module = importlib.import_module(f"lp_framework.commands.{command}")
                with _quiet_console(), held(relative(Path(config.get("resume") or folder))):
                    module.run(config)
            except (UserError, errors.InterpolationResolutionError) as error:
                mistake = error if isinstance(error, UserError) else UserError(explain(error))
                if sweep and isinstance(error, Held):
                    print(f"skipped (in use by another command): {relative(folder)}")
                    return
                if not isinstance(error, Held):
                    remove_if_empty(folder, f"{job.job.name}.log")
                if sweep:
                    log.error("job %s (%s): %s", job.job.num, ", ".join(job.overrides.task), mistake)
                    raise mistake from error
                log.info("stopped: %s", mistake)  # for the log; the caller prints it
                failed.append(mistake)
            except (KeyboardInterrupt, SystemExit):
                remove_if_empty(folder, f"{job.job.name}.log")
                raise
            except Exception as error:
                log.log(logging.ERROR if sweep else logging.INFO, "%s failed", command, exc_info=True)
                error.raised_by_a_command = True  # type: ignore[attr-defined]  # survives pickling by a launcher
                raise
            finally:
                _leave_processes()

    task.__module__ = f"lp_framework.commands.{command}"  # gives the job its name
    return task


def _check_paths(config: DictConfig) -> None:
    """Raise `UserError` for missing values, and for input files or folders that do not exist."""
    for key in sorted(OmegaConf.missing_keys(config)):
        raise UserError(f"{key} needs a value: give {key}=VALUE")
    for key in ("images", "image", "masks", "resume", "runs"):
        value = config.get(key)
        for path in value if isinstance(value, ListConfig) else [value]:
            if isinstance(path, str) and not Path(path).exists():
                raise UserError(f"{key}={path}: there is no such file or folder")
    checkpoint = str(config.get("checkpoint"))
    if checkpoint.startswith(("runs/", "./", "../", "/")) and not Path(checkpoint).exists():
        file = catalogue.find(f"experiment/{HydraConfig.get().runtime.choices.get('experiment')}")
        text = f"train hydra.run.dir={checkpoint}" if file is None else file.read_text(encoding="utf-8")
        train = re.search(rf"train [^`\n]*hydra\.run\.dir={re.escape(checkpoint)}(?!\w)", text)
        hint = f"; to train it: lp {train[0]}" if train else ""
        raise UserError(f"checkpoint={checkpoint}: there is no such file or folder{hint}")
    path = OmegaConf.select(config, "data.path")
    photographs = config.get("image") or config.get("images")  # used instead of the data
    if not photographs and path is not None and not Path(path).exists():
        (line, *_) = catalogue.read(f"data/{config.data.name}").settings.get("path", [""])
        if registry.MISSING in line:  # other folders are created if missing
            raise UserError(f"data.path={path}: there is no such file or folder")


def _leave_processes() -> None:
    """Leave the process group of a multi-process job, whose threads would prevent this process from exiting."""
    distributed = sys.modules.get("torch.distributed")
    if distributed is not None and distributed.is_available() and distributed.is_initialized():
        distributed.destroy_process_group()


@contextmanager
def _restored() -> Iterator[None]:
    """Restore the command line and the environment afterwards."""
    argv, environment = sys.argv, dict(os.environ)
    try:
        yield
    finally:
        sys.argv = argv
        for key in {*os.environ} - {*environment}:
            del os.environ[key]
        os.environ.update(environment)


@contextmanager
def _quiet_console() -> Iterator[None]:
    """Send Lightning's messages only to the run's log, and warnings to the log and, one line each, to the console."""
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        notes = logging.getLogger(name)
        notes.handlers.clear()  # Hydra's root handlers take over
        notes.propagate = True
    logging.getLogger("huggingface_hub").propagate = False  # it prints its own messages; avoid duplicates
    logging.raiseExceptions = False  # on a full disk, drop log lines without printing tracebacks
    with warnings.catch_warnings():
        for beginning in IGNORED_WARNINGS:
            warnings.filterwarnings("ignore", beginning)
        warnings.showwarning = lambda message, *_, **__: log.warning("%s", " ".join(str(message).split()))
        yield


def _store_plugin_configs(config_dir: str | None) -> None:
    """Register the choices of plugins with Hydra, unless a user's own or a built-in config of that name exists.

    A plugin's file is stored unchanged; for a class without a file, or named by one, all of its settings are stored.
    """
    classes, folders = registry.plugin_classes(), registry.conf_folders()
    choices = dict.fromkeys(classes)
    for folder in folders:
        files = sorted(folder.rglob("*.yaml"))
        choices |= dict.fromkeys((file.parent.relative_to(folder).as_posix(), file.stem) for file in files)
    for group, choice in choices:
        file = catalogue.find(f"{group}/{choice}", config_dir)
        if file is not None and not any(map(file.is_relative_to, folders)):
            continue
        try:
            text = "" if file is None else file.read_text(encoding="utf-8")
            values: Any = OmegaConf.to_container(OmegaConf.create(text))
            if not isinstance(values, dict):
                raise ValueError("a configuration is a mapping 'key: value', not a list")
            name, package = values.get("name", choice), catalogue.PACKAGE.search(text)
            if (group, name) in classes:
                shared = {"defaults": [catalogue.SHARED[group], "_self_"]} if group in catalogue.SHARED else {}
                values = {**shared, "name": name, **catalogue.plugin_defaults(classes[group, name][0]), **values}
            ConfigStore.instance().store(choice, values, group, package[1] if package else None, provider="plugin")
        except (YAMLError, ValueError) as error:
            where = file or f"{group} '{choice}'"
            print(f"warning: a plugin's configuration is left out: {where}: {one_line(error)}", file=sys.stderr)


def _parse(arguments: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """Split arguments, in any order, into overrides and Hydra's options; `UsageError` for an unknown option."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for option in FLAGS:
        parser.add_argument(*option.split(), action="store_true")
    for option, choices in OPTIONS.items():
        parser.add_argument(*option.split(), choices=choices)
    try:
        options, overrides = parser.parse_known_args(arguments)
    except argparse.ArgumentError as error:
        raise UsageError(f"{error} (--help shows the options)") from error
    for override in overrides:
        if override.startswith("-"):
            known = " ".join([*FLAGS, *OPTIONS]).split()
            raise UsageError(f"there is no option '{override}'{nearest(override.partition('=')[0], known)}")
    return overrides, vars(options)


def _with_trainer_arguments(overrides: Sequence[str]) -> list[str]:
    """Add `+` to arguments of Lightning's Trainer that the YAML files lack, unless they look like misspellings."""
    files = [catalogue.read(f"trainer/{choice}") for choice in catalogue.choices("trainer")]
    known = {key for file in files for key in file.settings}

    def is_other(override: str) -> bool:
        group, _, name = override.partition("=")[0].partition(".")
        return group == "trainer" and name.isidentifier() and name not in known and not nearest(name, known, TYPO_RATIO)

    return [f"+{override}" if is_other(override) else override for override in overrides]


def _as_words(options: Mapping[str, Any]) -> list[str]:
    """Convert options to command-line arguments."""
    given = {f"--{name.replace('_', '-')}": value for name, value in options.items() if value}
    return [word for name, value in given.items() for word in ([name] if value is True else [name, value])]


def _is_sweep(command: str, experiment: str) -> bool:
    """Whether an experiment is a sweep; `UsageError` if it belongs to another command."""
    own = catalogue.experiments(command)
    if experiment not in own and catalogue.find(f"experiment/{experiment}"):
        message = f"experiment={experiment} belongs to another command, not to {command}"
        raise UsageError(f"{message} (known: {', '.join(own)})")
    return "/sweep" in catalogue.read(f"experiment/{experiment}").defaults


def explain(error: Exception) -> str:
    """Turn an error raised by Hydra or OmegaConf into a message for the user."""
    cause = error.__cause__ or error.__context__
    match error:
        case MissingConfigException(missing_cfg_file=str(file)) if "/" in file:
            group, _, choice = file.rpartition("/")
            known = error.options or catalogue.choices(group)  # Hydra lists no options for choices made in a file
            message = f"{group}={choice}: there is no {group} '{choice}'{among(choice, known)}"
            if group == "hydra/launcher":
                return f"{message}; for more: pip install 'lp_framework[{'ray' if 'ray' in choice else 'sweeps'}]'"
            return message + ("; some plugins could not be loaded, see above" if registry.failures() else "")
        case OverrideParseException():
            key, equals, value = error.override.partition("=")
            quoted = f"text with special characters as \"{key}='{value}'\", a list as {key}=[A,B]"
            return f"cannot read '{error.override}': write {quoted if equals else 'KEY=VALUE'}"
        case HydraException() if isinstance(cause, errors.ConfigKeyError | errors.ConfigAttributeError):
            return _location(error) + _unknown_key(cause)
        case HydraException() if isinstance(cause, errors.OmegaConfBaseException):
            return _location(error) + (f"{cause.full_key}: " if cause.full_key else "") + one_line(cause)
        case HydraException() if str(error).startswith("Ambiguous value for argument"):
            override = str(error).split("'")[1]
            key, _, values = override.partition("=")
            as_list = "" if (registry.conf_dir() / key).is_dir() else f", or write a list, {key}=[{values}]"
            return f"'{override}' has several values: add --multirun to run each{as_list}"
        case OSError() if not isinstance(error, HydraException):
            return f"the folder of this run cannot be created: {one_line(error)}"
    return one_line(error) or type(error).__name__


def _location(error: Exception) -> str:
    """`"In 'experiment/paper': "` if Hydra reports that an error is in a file."""
    place, colon, _ = str(error).partition(": ")
    return place + colon if place.startswith("In '") else ""


def _unknown_key(error: errors.OmegaConfBaseException) -> str:
    key = str(error.full_key)
    parent, _, name = key.rpartition(".")
    node = OmegaConf.to_container(error.parent_node) if isinstance(error.parent_node, DictConfig) else None
    siblings = {str(each): value for each, value in node.items()} if isinstance(node, dict) else {}
    inside = [f"{each}.{name}" for each, value in siblings.items() if isinstance(value, dict) and name in value]
    known = list(siblings) if parent else sorted({*siblings, "experiment"} - {"hydra"})
    hint = f"; did you mean '{inside[0]}'? (known: {', '.join(known)})" if inside else among(name, known)
    return f"{key}: {parent or 'the configuration'} has no '{name}'{hint}"
