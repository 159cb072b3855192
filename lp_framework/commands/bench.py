"""`bench`: speed and memory claims, contenders side by side in one run."""

from __future__ import annotations

import gc
import inspect
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
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
from lp_framework.benchmarks.harness import Section
from lp_framework.commands.building import Components, orderly_console, plain, run_folder, seed_run, versions
from lp_framework.commands.device import choose_device
from lp_framework.data.module import PairDataModule
from lp_framework.data.rendering.renderer import Renderer
from lp_framework.errors import UserError, nearest
from lp_framework.evaluation.tables import write_json
from lp_framework.models.checkpoints import SHIPPED, load_model
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.report.paper import paper_table

RESULT = "bench.json"


@orderly_console()
def run(config: DictConfig) -> None:
    """Run the measurements named in `measure`; what has been measured so far is always in `bench.json`."""
    settings = plain(config)
    names = [settings["measure"]] if isinstance(settings["measure"], str) else settings["measure"]
    for name in names:
        if name not in MEASUREMENTS:
            known = f"{nearest(str(name), MEASUREMENTS)} (known: {', '.join(MEASUREMENTS)})"
            raise UserError(f"measure={name} is none of the measurements{known}")
    device = choose_device(settings["accelerator"])
    folder = run_folder()
    seed_run(0)
    facts = {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or "cpu",
        "threads": torch.get_num_threads(),
        "config": settings,
        "versions": versions(),
    }
    bench, sections = Bench(settings, device, folder), dict[str, Section]()
    try:
        for name in names:
            with _progress() as progress:
                task = progress.add_task(name, total=1.0)
                for section in bench.measure(name):
                    sections[name] = section
                    write_json(folder / RESULT, {**{key: each.record() for key, each in sections.items()}, **facts})
                    progress.update(task, completed=section.done)
            gc.collect()  # the networks of a measurement, lest the next one finds the GPU full
            if device.type == "cuda":
                torch.cuda.empty_cache()
    finally:
        if sections:
            show(list(sections.values()), folder / RESULT)


# ---------------------------------------------------------------- what measurements need of the config

MEASUREMENTS: dict[str, Callable[..., Iterator[Section]]] = {
    "loader": loader.measure,
    "encoding": encoding.measure,
    "first_stage": first_stage.measure,
    "second_stage": second_stage.measure,
    "pair": pair.measure,
    "precision": precision.measure,
    "adam_gauss_newton": adam_gauss_newton.measure,
    "rendering": rendering.measure,
    "checkpoint": checkpoint.measure,
    "scaling": scaling.measure,
}


class Bench:
    """Calls measurements. Their arguments are the settings of their sections and, by name, the attributes here."""

    def __init__(self, settings: Mapping[str, Any], device: torch.device, place: Path) -> None:
        self.settings, self.components, self.device = settings, Components(settings), device
        self.place, self.paper_seconds = place, paper_seconds()
        backbone = settings["backbone"]
        self.names = {group: settings[group]["name"] for group in ("data", "prior")}
        self.names["backbone"] = backbone.get("arch", backbone["name"])

    def measure(self, name: str) -> Iterator[Section]:
        """The measurement of a name."""
        function = MEASUREMENTS[name]
        settings = self._settings(name, function)
        others = [key for key in inspect.signature(function).parameters if key not in settings]
        return function(**settings, **{key: getattr(self, key) for key in others})

    def _settings(self, section: str, taker: Callable[..., Any]) -> dict[str, Any]:
        """Of a section of the config what the taker has arguments for; whole numbers are counts."""
        wanted = inspect.signature(taker).parameters
        values = {key: value for key, value in self.settings[section].items() if key in wanted}
        values = registry.checked(taker, values, f"{section}.")
        for key, value in values.items():
            each = value if isinstance(value, list) else value.values() if isinstance(value, dict) else [value]
            if not each:
                raise UserError(f"{section}.{key} must not be empty")
            if any(isinstance(one, int) and one < 1 and one is not False for one in each):
                raise UserError(f"{section}.{key} must be at least 1, got {value}")
        return values

    @property
    def computing(self) -> second_stage.Computing:
        """How Zero123 computes."""
        return second_stage.Computing(**self._settings("second_stage", second_stage.Computing))

    @cached_property
    def model(self) -> PoseModel:
        """The one that ships: figures are to be compared, whatever has been trained here."""
        return load_model(SHIPPED / "score")

    @property
    def prior(self) -> Prior:
        """The chosen one."""
        return self.components["prior"]

    @cached_property
    def data(self) -> PairDataModule:
        """The chosen one, prepared, whose test views are evaluated in all ordered pairs."""
        data: PairDataModule = self.components["data"]
        data.evaluate_on("ordered", 0)
        data.prepare_data()
        return data

    @property
    def new_model(self) -> PoseModel:
        """The chosen one, untrained, on the chosen backbone."""
        return self.components["model"]

    @property
    def renderers(self) -> dict[str, Renderer]:
        """All of them, but for `auto`, which is one of the others."""
        return {name: registry.build("renderer", name) for name in registry.names("renderer") if name != "auto"}


def paper_seconds() -> dict[int, float]:
    """The paper's seconds a pair by the number of starts (appendix, Analysis of Inference Time)."""
    table = paper_table("starts")
    assert table is not None  # it is in this package
    rows = [row for row in table.rows if row.settings["solver.name"] == "two_stage"]
    return {int(str(row.settings["start.count"])): row.metrics["seconds_per_pair"] for row in rows}


# ---------------------------------------------------------------- the terminal


def show(sections: Sequence[Section], results: Path) -> None:
    """What has been measured, on the terminal."""
    console = Console(highlight=False, width=None if Console().is_terminal else 110)
    console.print(table(sections))
    for section in sections:
        if section.note:
            console.print(f"{section.title.partition(':')[0]}: {section.note}")
    console.print(f"results: {results}", soft_wrap=True)


def table(sections: Sequence[Section]) -> Table:
    """Medians, a section a measurement; ratios are those of the first contender to the second."""
    result = Table(box=box.SIMPLE, show_header=False, show_edge=False, pad_edge=False)
    result.add_column()
    for _ in range(3):
        result.add_column(justify="right")
    for section in sections:
        result.add_row(section.title, *section.contenders, "ratio", style="bold")
        for row in section.measured():
            result.add_row(row.label, *map(_number, row.medians), f"{row.ratio:.3g} x")
        result.add_section()
    return result


def _number(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def _progress() -> Progress:
    console = Console(stderr=True)
    columns = (TextColumn("measuring {task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
