"""The harness of `bench`: two contenders at the same work, alternated round by round within one run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any, NamedTuple, TypeVar

import torch

from lp_framework.clock import now

Work = Callable[[], float]  # does it, and returns how many of the row's unit were done
_Result = TypeVar("_Result")


class Contest(NamedTuple):
    """Work that both contenders do; its row holds seconds a unit, or units a second if it is a `rate`."""

    label: str  # of the row, with the unit
    first: Work
    second: Work
    rate: bool = False


@dataclass(frozen=True)
class Row:
    """A quantity, named with its unit: of either contender a value a round, or a single one."""

    label: str
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
    """A measurement so far: `rows` for the table, `facts` for the JSON file alone, `done` in [0, 1]."""

    title: str
    contenders: tuple[str, str]
    note: str = ""
    races: int = 1  # how many there will be
    rows: list[Row] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)
    done: float = 0.0

    def race(
        self, contests: Sequence[Contest], rounds: int, device: torch.device, warm_up: bool = True
    ) -> Iterator[Section]:
        """The section after every stretch: each work once to warm up, then `rounds` of all of them in turn."""
        rows = [Row(contest.label) for contest in contests]
        self.rows += rows
        for contest in contests if warm_up else ():
            contest.first()
            contest.second()
        for _ in range(rounds):
            for contest, row in zip(contests, rows, strict=True):
                for work, values in ((contest.first, row.first), (contest.second, row.second)):
                    seconds, amount = timed(work, device)
                    values.append(amount / seconds if contest.rate else seconds / amount)
                    self.done += 1 / (2 * rounds * len(contests) * self.races)
                    yield self

    def add(self, label: str, first: float, second: float) -> None:
        """A row of single values."""
        self.rows.append(Row(label, [first], [second]))

    def measured(self) -> list[Row]:
        """The rows of which both contenders have a value."""
        return [row for row in self.rows if row.first and row.second]

    def record(self) -> dict[str, Any]:
        """For the JSON file: by the labels of the rows, and the facts."""
        rows = {
            row.label: {
                **{
                    name: _spread(values) for name, values in zip(self.contenders, (row.first, row.second), strict=True)
                },
                "ratio": row.ratio,
            }
            for row in self.measured()
        }
        return {**rows, **self.facts}


def _spread(values: Sequence[float]) -> dict[str, Any]:
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
