"""Find finished runs on disk, and read the settings and metrics of evaluations."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from lp_framework.errors import UserError
from lp_framework.evaluation.journal import dotted
from lp_framework.evaluation.tables import RESULT

HYDRA = Path(".hydra") / "hydra.yaml"  # Hydra's record of a job: its command and its choices
COSTS = ("seconds_per_pair", "network_passes_per_pair")
# Settings that are not compared because they change no result. The checkpoint has `checkpoint_setting`.
IGNORED_SETTINGS = ("plugins", "checkpoint", "seed", "batch_pairs", "pictures", "resume")
Kind = Literal["eval", "train", "estimate", "landscape"]  # the commands whose runs have a page
# Without a Hydra folder, the first of these files that exists identifies the command.
FILES: dict[str, Kind] = {
    "training.json": "train", "metrics.csv": "train", "landscape.json": "landscape", "azimuth.json": "landscape",
    "poses.csv": "estimate", RESULT: "eval",
}  # fmt: skip


@dataclass(frozen=True)
class Run:
    """A finished evaluation: its folder, its experiment's name, if any, and its settings.

    `settings` come from `settings` and `checkpoint_setting`. `metrics` are over `all` objects, and over those with a
    `unique_answer` (None if no object is labelled so), with `COSTS`. A median error that is not finite is infinite.
    """

    folder: Path
    experiment: str | None
    seed: int
    settings: Mapping[str, Any]
    metrics: Mapping[str, Mapping[str, float] | None]
    pairs: int
    checkpoint: str | None


class LeftOut(NamedTuple):
    """A run that is left out, and why."""

    folder: Path
    reason: str


def run_folders(folders: Sequence[Path]) -> list[tuple[Path, Kind]]:
    """All runs with a page in and below `folders`, sorted, without duplicates; `UserError` if a folder is missing."""
    found: dict[Path, tuple[Path, Kind]] = {}
    for folder in folders:
        if not folder.is_dir():
            raise UserError(f"runs={folder}: there is no such folder")
        for path, inside, files in os.walk(folder):
            if not {HYDRA.parent.name, *FILES}.isdisjoint([*inside, *files]) and (kind := run_kind(Path(path))):
                found[Path(path).resolve()] = Path(path), kind
    return sorted(found.values(), key=lambda run: [(len(part), part) for part in run[0].parts])


def run_kind(folder: Path) -> Kind | None:
    """The command that made the folder; None if that command has no page."""
    command, _ = _job(folder)
    if command is None:
        return next((kind for file, kind in FILES.items() if (folder / file).is_file()), None)
    return next((kind for kind in get_args(Kind) if kind == command), None)


def find_runs(folders: Sequence[Path]) -> tuple[list[Run], list[LeftOut]]:
    """Find all finished evaluations in and below `folders` (`UserError` if one is missing), and those left out because
    they are unfinished, damaged or duplicates.
    """
    runs: dict[str, Run] = {}
    left_out: list[LeftOut] = []
    for folder in [folder for folder, kind in run_folders(folders) if kind == "eval"]:
        try:
            run = read_run(folder)
        except UserError as error:
            left_out.append(LeftOut(folder, str(error)))
            continue
        first = runs.setdefault(json.dumps([run.settings, run.seed, run.checkpoint, run.experiment]), run)
        if first is not run:
            left_out.append(LeftOut(folder, f"duplicate of {first.folder} (same settings and seed)"))
    return [*runs.values()], left_out


def read_run(folder: Path) -> Run:
    """Read the evaluation in `folder`; `UserError` if its `results.json` is missing, damaged or of another kind."""
    file = folder / RESULT
    try:
        result = json.loads(file.read_text(encoding="utf-8"))
        costs = {name: float(result[name]) for name in COSTS}
        metrics = {"all": result["metrics"], "unique_answer": result["metrics_unique_answer"]}
        return Run(
            folder,
            _job(folder)[1],
            int(result["seed"]),
            {**settings(result["config"]), "protocol": result["protocol"], **checkpoint_setting(result["checkpoint"])},
            {over: None if each is None else {**_metrics(each), **costs} for over, each in metrics.items()},
            int(result["pairs"]),
            result["checkpoint"],
        )
    except FileNotFoundError as error:
        raise UserError(f"unfinished: no {RESULT}") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        cause = f"{type(error).__name__}: {error}"
        raise UserError(f"damaged: {file} cannot be read as the result of an evaluation ({cause})") from error


def settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Flatten a config to dotted keys, without seeds, plugin folders and the checkpoint; whole numbers become int.

    >>> settings({"seed": 1, "data": {"name": "toy", "seed": 1}, "solver": {"gamma": 0.3}})
    {'data.name': 'toy', 'solver.gamma': 0.3}
    """
    values = {key: _number(value) for key, value in dotted(config).items() if key not in IGNORED_SETTINGS}
    return {key: value for key, value in values.items() if not key.endswith(".seed")}


def checkpoint_setting(checkpoint: str | None) -> dict[str, Any]:
    """`{"checkpoint": ...}`; empty for a solver without a model.

    Models that differ only in their training seed share one value: the settings of the training run and the file's name
    as JSON, if the run's folder exists, else the path.
    """
    if checkpoint is None:
        return {}
    path = Path(checkpoint)
    for file in (path.parent / "config.yaml", path.parent.parent / "config.yaml"):
        try:
            return {"checkpoint": json.dumps({**settings(saved_config(file)), "file": path.name}, sort_keys=True)}
        except UserError:
            continue
    return {"checkpoint": checkpoint}


def saved_config(file: Path) -> dict[str, Any]:
    """Read the resolved `config.yaml` of a training run; `UserError` if it is missing or damaged."""
    try:
        content: Any = OmegaConf.to_container(OmegaConf.load(file), resolve=True)
        return dict(content)
    except (OSError, ValueError, TypeError, YAMLError, OmegaConfBaseException, RecursionError) as error:
        raise UserError(f"{file}: is missing or damaged ({type(error).__name__})") from error


def checkpoint_names(runs: Sequence[Run]) -> dict[str, str]:
    """A name for every value of the setting `checkpoint`: the model's name if it is unambiguous, else the path."""
    paths = {run.settings["checkpoint"]: run.checkpoint for run in runs if run.checkpoint is not None}
    named = {value: path for value, path in paths.items() if value != path}
    models = paths | {value: json.loads(value).get("model.name", path) for value, path in named.items()}
    return models if len(set(models.values())) == len(models) else paths


def _job(folder: Path) -> tuple[str | None, str | None]:
    """The command and the experiment of the job in `folder`; None if unknown."""
    try:
        hydra = yaml.load((folder / HYDRA).read_text(encoding="utf-8"), yaml.CSafeLoader)["hydra"]
        return hydra["job"]["name"], hydra["runtime"]["choices"].get("experiment")
    except (OSError, YAMLError, ValueError, KeyError, TypeError, AttributeError):
        return None, None


def _metrics(values: Mapping[str, float | None]) -> dict[str, float]:
    return {name: math.inf if value is None else float(value) for name, value in values.items()}


def _number(value: Any) -> Any:
    """Convert whole numbers to int, so that 0.0 becomes 0."""
    if isinstance(value, list):
        return [_number(each) for each in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value
