"""`bench`: speed and memory claims, contenders side by side in one run."""

from __future__ import annotations

import gc
import platform
import typing
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from lp_framework import registry
from lp_framework.benchmarks import (
    adam_gauss_newton,
    checkpoint,
    encoding,
    first_stage,
    loader,
    pair,
    precision,
    rendering,
    scaling,
    second_stage,
)
from lp_framework.benchmarks.section import Section
from lp_framework.commands.building import Components, orderly_console, plain, run_folder, seed_run, versions
from lp_framework.commands.device import choose_device
from lp_framework.data.pairs import PairData
from lp_framework.data.toy import toy_objects
from lp_framework.errors import UserError, nearest
from lp_framework.evaluation.tables import write_json
from lp_framework.models.checkpoints import SHIPPED, load_model
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.zero123.attention import Attention
from lp_framework.priors.zero123.networks import Dtype, require_packages
from lp_framework.solvers.starts import Ring

RESULT = "bench.json"


@orderly_console()
def run(config: DictConfig) -> None:
    """Run the measurements named in `measure`; what has been measured so far is always in `bench.json`."""
    names = [config.measure] if isinstance(config.measure, str) else list(config.measure)
    for name in names:
        _check_choice("measure", name, MEASUREMENTS)
    folder = run_folder()
    seed_run(0)
    device = choose_device(config.accelerator)
    facts = {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or "cpu",
        "threads": torch.get_num_threads(),
        "config": plain(config),
        "versions": versions(),
    }
    sections: dict[str, Section] = {}
    try:
        for name in names:
            with _progress() as progress:
                task = progress.add_task(name, total=1.0)
                for section in MEASUREMENTS[name](config, device):
                    sections[name] = section
                    write_json(folder / RESULT, {**{key: each.record for key, each in sections.items()}, **facts})
                    progress.update(task, completed=section.done)
            gc.collect()  # the networks of a measurement, lest the next one finds the GPU full
            if device.type == "cuda":
                torch.cuda.empty_cache()
    finally:
        if sections:
            show(list(sections.values()), folder / RESULT)


def show(sections: Sequence[Section], results: Path) -> None:
    """What has been measured, on the terminal."""
    console = Console(highlight=False, width=None if Console().is_terminal else 110)
    console.print(table(sections))
    for section in sections:
        if section.note:
            console.print(f"{section.title.partition(':')[0]}: {section.note}")
    console.print(f"results: {results}", soft_wrap=True)


# ---------------------------------------------------------------- the measurements, with what they need of the config


def _loader(config: DictConfig, device: torch.device) -> Iterator[Section]:
    settings = _settings(config, "loader", "rounds", "steps")
    data, model = _training(config)
    batch, block = config.data.batch_pairs, config.data.block
    return loader.measure(data, model, batch, block, **settings, device=device, note=_training_note(config, model))


def _encoding(config: DictConfig, device: torch.device) -> Iterator[Section]:
    settings = _settings(config, "encoding", "rounds")
    data, model = _training(config)
    prior = registry.build("prior", plain(config.prior))
    batch, block = config.data.batch_pairs, config.data.block
    note = f"{_training_note(config, model)}; prior={config.prior.name}"
    return encoding.measure(data, model, prior, batch, block, **settings, device=device, note=note)


def _first_stage(config: DictConfig, device: torch.device) -> Iterator[Section]:
    settings = _settings(config, "first_stage", "views", "starts", "rounds")
    if settings["views"] < 2:
        raise UserError(f"first_stage.views must be at least 2, got {settings['views']}")
    return first_stage.measure(_pose_model(), **settings, device=device)


def _second_stage(config: DictConfig, device: torch.device) -> Iterator[Section]:
    return _stage(config, device).measure()


def _pair(config: DictConfig, device: torch.device) -> Iterator[Section]:
    settings = _settings(config, "pair", "steps", "rounds")
    return pair.measure(_stage(config, device), _pose_model(), **settings)


def _stage(config: DictConfig, device: torch.device) -> second_stage.SecondStage:
    settings = _settings(config, "second_stage", "rounds", "steps")
    for key, kind in (("architecture", second_stage.Architecture), ("dtype", Dtype), ("attention", Attention)):
        _check_choice(f"second_stage.{key}", settings[key], typing.get_args(kind))
    require_packages()
    return second_stage.SecondStage(device, **settings)


def _precision(config: DictConfig, device: torch.device) -> Iterator[Section]:
    settings = _settings(config, "precision", "starts", "rounds", "steps")
    _check_choice("precision.architecture", settings["architecture"], typing.get_args(second_stage.Architecture))
    require_packages()
    return precision.Precision(device, **settings).measure()


def _adam_gauss_newton(config: DictConfig, device: torch.device) -> Iterator[Section]:
    settings = _settings(config, "adam_gauss_newton", "pairs", "starts", "newton_steps", "adam_steps", "rounds")
    components = Components(plain(config))
    data, prior = components["data"], components["prior"]
    data.evaluate_on("ordered", 0)
    data.prepare_data()
    views, count = data.data("test"), settings.pop("pairs")
    starts = Ring(settings.pop("starts"))
    pairs = adam_gauss_newton.some_pairs(views, count, device)
    note = f"{len(pairs)} pairs of {config.data.name}'s test views, {starts.count} starts, prior={config.prior.name}"
    poses = starts.make(pairs, seed=0)
    return adam_gauss_newton.measure(pairs, poses, _pose_model(), prior, **settings, device=device, note=note)


def _rendering(config: DictConfig, device: torch.device) -> Iterator[Section]:
    settings = _settings(config, "rendering", "views", "resolution", "rounds")
    objects = {obj.name: obj for obj in toy_objects()}
    _check_choice("rendering.object", settings["object"], objects)
    obj = objects[settings.pop("object")]
    names = [name for name in registry.names("renderer") if name != "auto"]  # which is one of the others
    renderers = {name: registry.build("renderer", {"name": name}) for name in names}
    return rendering.measure(obj, renderers, **settings, device=device)


def _checkpoint(config: DictConfig, device: torch.device) -> Iterator[Section]:
    settings = _settings(config, "checkpoint", "rounds")
    _check_choice("checkpoint.architecture", settings["architecture"], typing.get_args(second_stage.Architecture))
    for dtype in settings["dtypes"]:
        _check_choice("checkpoint.dtypes", dtype, typing.get_args(Dtype))
    require_packages()
    return checkpoint.measure(**settings, device=device, place=run_folder())


def _scaling(config: DictConfig, device: torch.device) -> Iterator[Section]:
    settings = _settings(config, "scaling", "steps", "rounds")
    prior = registry.build("prior", plain(config.prior))
    return scaling.Scaling(device, _pose_model(), prior, **settings).measure()


MEASUREMENTS: dict[str, Callable[[DictConfig, torch.device], Iterator[Section]]] = {
    "loader": _loader,
    "encoding": _encoding,
    "first_stage": _first_stage,
    "second_stage": _second_stage,
    "pair": _pair,
    "precision": _precision,
    "adam_gauss_newton": _adam_gauss_newton,
    "rendering": _rendering,
    "checkpoint": _checkpoint,
    "scaling": _scaling,
}


def _training(config: DictConfig) -> tuple[PairData, PoseModel]:
    """Training views, and a new model on the chosen backbone."""
    components = Components(plain(config))
    data = components["data"]
    data.prepare_data()
    return data.data("train"), components["model"]


def _training_note(config: DictConfig, model: PoseModel) -> str:
    arch = config.backbone.get("arch", config.backbone.name)
    return f"{arch} at {model.backbone.image_size} px, {config.data.batch_pairs} pairs a batch"


def _pose_model() -> PoseModel:
    """The one that ships: figures are to be compared, whatever has been trained here."""
    return load_model(SHIPPED / "score")


def table(sections: Sequence[Section]) -> Table:
    """All figures, a section a measurement; ratios are those of the first contender to the second."""
    result = Table(box=box.SIMPLE, show_header=False, show_edge=False, pad_edge=False)
    result.add_column()
    for _ in range(3):
        result.add_column(justify="right")
    for section in sections:
        result.add_row(section.title, *section.contenders, "ratio", style="bold")
        for figure in section.figures:
            result.add_row(figure.label, _number(figure.first), _number(figure.second), f"{figure.ratio:.3g} x")
        result.add_section()
    return result


def _number(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def _progress() -> Progress:
    console = Console(stderr=True)
    columns = (TextColumn("measuring {task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


def _settings(config: DictConfig, section: str, *counts: str) -> dict[str, Any]:
    """The settings of a measurement; those named `counts` must be at least 1."""
    settings = plain(config[section])
    for key in counts:
        value = settings[key]
        if not isinstance(value, int) or value < 1:
            raise UserError(f"{section}.{key} must be at least 1, got {value}")
    return settings


def _check_choice(key: str, value: object, known: typing.Iterable[str]) -> None:
    known = list(known)
    if value not in known:
        raise UserError(f"{key}={value} is none of its values{nearest(str(value), known)} (known: {', '.join(known)})")
