"""The harness of `bench`: two contenders at the same work, alternated round by round within one run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from statistics import median
from typing import Any, TypeVar

import torch

from lp_framework.clock import now

Work = Callable[[], float]  # does it, and returns how many of the row's unit were done
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Row:
    """A quantity of two contenders, of each a value a round, or a single one."""

    first: list[float] = field(default_factory=list)
    second: list[float] = field(default_factory=list)

    @property
    def medians(self) -> tuple[float, float]:
        """Those of the two contenders."""
        return median(self.first), median(self.second)

    @property
    def ratio(self) -> float:
        """First over second."""
        first, second = self.medians
        return first / second


@dataclass
class Section:
    """A measurement so far: `rows` by label with their unit, `facts` for the JSON file alone.

    `changed` is called after every stretch of work.
    """

    title: str
    contenders: tuple[str, str]
    device: torch.device
    changed: Callable[[], None] = lambda: None
    note: str = ""
    rows: dict[str, Row] = field(default_factory=dict)
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
                row = self.rows.setdefault(label, Row())
                for work, values in zip(both, (row.first, row.second), strict=True):
                    seconds, amount = timed(work, self.device)
                    values.append(amount / seconds if rate else seconds / amount)
                    self.changed()

    def add(self, label: str, first: float, second: float) -> None:
        """A row of single values."""
        self.rows[label] = Row([first], [second])

    def measured(self) -> dict[str, Row]:
        """The rows of which both contenders have a value."""
        return {label: row for label, row in self.rows.items() if row.first and row.second}

    def record(self) -> dict[str, Any]:
        """For the JSON file: by the labels of the rows, and the facts."""
        first, second = self.contenders
        rows = {
            label: {first: _spread(row.first), second: _spread(row.second), "ratio": row.ratio}
            for label, row in self.measured().items()
        }
        return {**rows, **self.facts}


def _spread(values: list[float]) -> dict[str, Any]:
    return {"median": median(values), "min": min(values), "max": max(values), "rounds": list(values)}


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
