"""`bench`: speed and memory claims, contenders side by side in one run."""

from __future__ import annotations

import platform
import typing
from collections.abc import Callable, Iterator, Sequence

import torch
from omegaconf import DictConfig
from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from lp_framework import registry
from lp_framework.benchmarks import loader, second_stage
from lp_framework.benchmarks.section import Section
from lp_framework.commands.building import build_data, orderly_console, plain, run_folder, seed_run, versions
from lp_framework.commands.device import choose_device
from lp_framework.errors import UserError, nearest
from lp_framework.evaluation.tables import write_json
from lp_framework.priors.zero123.attention import Attention
from lp_framework.priors.zero123.networks import Dtype, require_packages

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
    for name in names:
        measurement = MEASUREMENTS[name](config, device)
        with _progress() as progress:
            task = progress.add_task(name, total=1.0)
            for section in measurement:
                sections[name] = section
                write_json(folder / RESULT, {**{key: each.record for key, each in sections.items()}, **facts})
                progress.update(task, completed=section.done)
    console = Console(highlight=False, width=None if Console().is_terminal else 110)
    console.print(table(list(sections.values())))
    for section in sections.values():
        if section.note:
            console.print(f"{section.title.partition(':')[0]}: {section.note}")
    console.print(f"results: {folder / RESULT}", soft_wrap=True)


def _loader(config: DictConfig, device: torch.device) -> Iterator[Section]:
    settings = config.loader
    _check_counts("loader", settings)
    data = build_data(config)
    data.prepare_data()
    backbone = registry.build("backbone", config.backbone)
    model = registry.build("model", config.model, backbone=backbone)
    batch, block = config.data.batch_pairs, config.data.block
    note = f"{config.backbone.get('arch', config.backbone.name)} at {backbone.image_size} px, {batch} pairs a batch"
    return loader.measure(data.data("train"), model, batch, block, settings.rounds, settings.steps, device, note)


def _second_stage(config: DictConfig, device: torch.device) -> Iterator[Section]:
    settings = plain(config.second_stage)
    _check_counts("second_stage", settings)
    for key, kind in (("architecture", second_stage.Architecture), ("dtype", Dtype), ("attention", Attention)):
        _check_choice(f"second_stage.{key}", settings[key], typing.get_args(kind))
    require_packages()
    return second_stage.SecondStage(device, **settings).measure()


MEASUREMENTS: dict[str, Callable[[DictConfig, torch.device], Iterator[Section]]] = {
    "loader": _loader,
    "second_stage": _second_stage,
}


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


def _check_counts(section: str, settings: DictConfig | dict[str, object]) -> None:
    for key in ("rounds", "steps"):
        value = settings[key]
        if not isinstance(value, int) or value < 1:
            raise UserError(f"{section}.{key} must be at least 1, got {value}")


def _check_choice(key: str, value: object, known: typing.Iterable[str]) -> None:
    known = list(known)
    if value not in known:
        raise UserError(f"{key}={value} is none of its values{nearest(str(value), known)} (known: {', '.join(known)})")
