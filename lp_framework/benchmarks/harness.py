"""The harness of `bench`: time two contenders in turn, and measure their peak GPU memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from statistics import median
from typing import Any, TypeVar

import torch
from torch import nn

from lp_framework.clock import now

Work = Callable[[], float]  # does the work, and returns its amount in the row's unit
_Result = TypeVar("_Result")


@dataclass
class Section:
    """A measurement so far: `rows` by label with unit, and `facts` for the JSON file only.

    A row has one value per round for each contender, or a single one. The measurement sets the title, the contenders'
    names and the note.
    """

    device: torch.device
    title: str = ""
    contenders: tuple[str, str] = ("first", "second")
    note: str = ""
    rows: dict[str, tuple[list[float], list[float]]] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)

    def race(
        self, works: Mapping[str, tuple[Work, Work]], rounds: int, rate: bool = False, warm_up: bool = True
    ) -> None:
        """Run all works once to warm up, then `rounds` times in turn.

        `works` maps row labels to the works of both contenders. Values are seconds per unit; if `rate`, the inverse.
        """
        for first, second in works.values() if warm_up else ():
            first()
            second()
        for _ in range(rounds):
            for label, both in works.items():
                for work, values in zip(both, self.rows.setdefault(label, ([], [])), strict=True):
                    seconds, amount = timed(work, self.device)
                    values.append(amount / seconds if rate else seconds / amount)

    def add(self, label: str, first: float, second: float) -> None:
        """Add a row of single values."""
        self.rows[label] = [first], [second]

    def medians(self) -> dict[str, tuple[float, float]]:
        """Medians of the rows with values of both contenders."""
        return {label: (median(first), median(second)) for label, (first, second) in self.rows.items() if second}

    def record(self) -> dict[str, Any]:
        """The rows by label, and the facts, for the JSON file."""
        rows: dict[str, Any] = {}
        for label, (first, second) in self.medians().items():
            rows[label] = {"ratio": first / second}
            for name, values in zip(self.contenders, self.rows[label], strict=True):
                rows[label][name] = {"median": median(values), "min": min(values), "max": max(values), "rounds": values}
        return {**rows, **self.facts}


def work_of(amount: float, do: Callable[[], object]) -> Work:
    """Wrap `do` as work of `amount` units."""

    def work() -> float:
        do()
        return amount

    return work


def timed(work: Callable[[], _Result], device: torch.device) -> tuple[float, _Result]:
    """Run the work; returns the seconds and its result."""
    start = now(device)
    result = work()
    return now(device) - start, result


def peak_bytes(work: Callable[[], object], weights: nn.Module, device: torch.device) -> int:
    """Run the work; returns the peak GPU memory in bytes, for the weights and the work. Always 0 on other devices."""
    if device.type != "cuda":
        work()
        return 0
    torch.cuda.synchronize(device)
    torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_allocated(device)
    work()
    torch.cuda.synchronize(device)
    return torch.cuda.max_memory_allocated(device) - before + sum(each.nbytes for each in weights.parameters())
