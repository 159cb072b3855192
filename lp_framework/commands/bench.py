"""`bench`: measure speed and memory, with both contenders in one run."""

from __future__ import annotations

import gc
import inspect
import platform
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich import box
from rich.console import Console
from rich.table import Table

from lp_framework import registry
from lp_framework.benchmarks import batches, rendering, stages, zero123
from lp_framework.benchmarks.harness import Section
from lp_framework.commands.building import Components, begin, plain, versions
from lp_framework.errors import UserError, among
from lp_framework.evaluation.tables import write_json
from lp_framework.models.checkpoints import SHIPPED, load_model
from lp_framework.report.paper import paper_table

RESULT = "bench.json"
MEASUREMENTS: dict[str, Callable[..., None]] = {
    "loader": batches.measure_loading,
    "encoding": batches.measure_encoding,
    "first_stage": stages.measure_first_stage,
    "second_stage": zero123.measure_step,
    "pair": zero123.measure_pair,
    "precision": zero123.measure_precision,
    "adam_gauss_newton": stages.measure_descent,
    "rendering": rendering.measure,
}


def run(config: DictConfig) -> None:
    """Run the measurements named in `measure`. An interrupted run saves its results so far in `bench.json`."""
    folder, device, _ = begin(config)
    settings = plain(config)
    names = [settings["measure"]] if isinstance(settings["measure"], str) else settings["measure"]
    for name in names:
        if name not in MEASUREMENTS:
            raise UserError(f"measure={name} is not a measurement{among(str(name), MEASUREMENTS)}")
    facts = {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or "cpu",
        "threads": torch.get_num_threads(),
        "config": settings,
        "versions": versions(),
    }
    sections: dict[str, Section] = {}
    try:
        for name in names:
            wanted = arguments(name, settings, device)
            sections[name] = Section(device)
            with Console(stderr=True).status(f"measuring {name}"):
                MEASUREMENTS[name](sections[name], **wanted)
            del wanted
            gc.collect()
            torch.cuda.empty_cache()
    finally:
        if sections:
            write_json(folder / RESULT, {**{name: each.record() for name, each in sections.items()}, **facts})
            show(sections, folder / RESULT)


def arguments(name: str, settings: Mapping[str, Any], device: torch.device) -> dict[str, Any]:
    """The arguments of a measurement besides its section: its settings, and the objects it needs by name."""
    components = Components(settings)  # rebuilt, so that no networks of another measurement fill the GPU
    makers: dict[str, Callable[[], object]] = {
        "computing": lambda: zero123.Computing(**_settings(settings, "second_stage", zero123.Computing)),
        # Always the bundled model, so that results are comparable across machines.
        "model": lambda: load_model(SHIPPED / "score").to(device),
        "new_model": lambda: components["model"].to(device),
        "prior": lambda: components["prior"].to(device),
        "data": components.test_views,
        "renderer": lambda: components["renderer"],
        "paper_seconds": paper_seconds,
    }
    wanted = inspect.signature(MEASUREMENTS[name]).parameters
    objects = {key: make() for key, make in makers.items() if key in wanted}
    return {**_settings(settings, name, MEASUREMENTS[name]), **objects}


def _settings(settings: Mapping[str, Any], section: str, taker: Callable[..., Any]) -> dict[str, Any]:
    """The settings in a config section that `taker` has arguments for; integers must be at least 1."""
    wanted = inspect.signature(taker).parameters
    values = {key: value for key, value in settings[section].items() if key in wanted}
    values = registry.checked(taker, values, f"{section}.")
    for key, value in values.items():
        each = value if isinstance(value, list) else [value]
        if not each:
            raise UserError(f"{section}.{key} must not be empty")
        if any(isinstance(one, int) and one < 1 and one is not False for one in each):
            raise UserError(f"{section}.{key} must be at least 1, got {value}")
    return values


def paper_seconds() -> dict[int, float]:
    """The paper's seconds per pair, by number of starts (appendix, Analysis of Inference Time)."""
    table = paper_table("starts")
    assert table is not None  # it ships with the package
    rows = [row for row in table.rows if row.settings["solver.name"] == "two_stage"]
    return {int(str(row.settings["start.count"])): row.metrics["seconds_per_pair"] for row in rows}


def show(sections: Mapping[str, Section], results: Path) -> None:
    """Print the measurements."""
    console = Console(highlight=False, width=None if Console().is_terminal else 110)
    console.print(table(list(sections.values())))
    for name, section in sections.items():
        if section.note:
            console.print(f"{name}: {section.note}")
    console.print(f"results: {results}", soft_wrap=True)


def table(sections: list[Section]) -> Table:
    """Table of medians, one section per measurement; ratios are first contender to second."""
    result = Table(box=box.SIMPLE, show_header=False, show_edge=False, pad_edge=False)
    result.add_column()
    for _ in range(3):
        result.add_column(justify="right")
    for section in sections:
        result.add_row(section.title, *section.contenders, "ratio", style="bold")
        for label, (first, second) in section.medians().items():
            result.add_row(label, _number(first), _number(second), f"{first / second:.3g} x")
        result.add_section()
    return result


def _number(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"
