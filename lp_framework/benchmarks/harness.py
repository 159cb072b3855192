"""The harness of `bench`: two contenders at work in turn, and the memory that they take on a GPU."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from statistics import median
from typing import Any, TypeVar

import torch
from torch import nn

from lp_framework.clock import now

Work = Callable[[], float]  # does it, and returns how many of the row's unit were done
_Result = TypeVar("_Result")


@dataclass
class Section:
    """A measurement so far: `rows` by label with their unit, `facts` for the JSON file alone.

    A row has a value per round of either contender, or a single one. The measurement sets the title, the contenders'
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
        """Each work once to warm up, then `rounds` of all of them in turn.

        `works` are the two contenders' by the row's label; values are seconds a unit, units a second if it is a `rate`.
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
        """A row of single values."""
        self.rows[label] = [first], [second]

    def medians(self) -> dict[str, tuple[float, float]]:
        """Of the rows of which both contenders have a value."""
        return {label: (median(first), median(second)) for label, (first, second) in self.rows.items() if second}

    def record(self) -> dict[str, Any]:
        """For the JSON file: by the labels of the rows, and the facts."""
        rows: dict[str, Any] = {}
        for label, (first, second) in self.medians().items():
            rows[label] = {"ratio": first / second}
            for name, values in zip(self.contenders, self.rows[label], strict=True):
                rows[label][name] = {"median": median(values), "min": min(values), "max": max(values), "rounds": values}
        return {**rows, **self.facts}


def worth(amount: float, do: Callable[[], object]) -> Work:
    """Work that is worth so many units."""

    def work() -> float:
        do()
        return amount

    return work


def timed(work: Callable[[], _Result], device: torch.device) -> tuple[float, _Result]:
    """Seconds of a piece of work, and what it returns."""
    began = now(device)
    result = work()
    return now(device) - began, result


def peak_bytes(work: Callable[[], object], weights: nn.Module, device: torch.device) -> int:
    """The peak of a GPU's memory, in bytes: the weights, and what the work takes. Elsewhere the work is done, and 0."""
    if device.type != "cuda":
        work()
        return 0
    torch.cuda.synchronize(device)
    torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_allocated(device)
    work()
    torch.cuda.synchronize(device)
    return torch.cuda.max_memory_allocated(device) - before + sum(each.nbytes for each in weights.parameters())
