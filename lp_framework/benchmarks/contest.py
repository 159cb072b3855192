"""Two contenders at the same work, alternated round by round within one run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import torch

from lp_framework.benchmarks.section import Figure, Section
from lp_framework.clock import now

Work = Callable[[], float]  # does it, and says how many of the figure's unit were done


@dataclass(frozen=True)
class Match:
    """Work that both contenders do: its figure is units a second, or seconds a unit where it is no `rate`."""

    key: str  # in the JSON file
    label: str  # in the table, with the unit
    first: Work
    second: Work
    rate: bool = True


def compete(
    title: str,
    contenders: tuple[str, str],
    matches: Sequence[Match],
    rounds: int,
    device: torch.device,
    note: str = "",
    warm_up: bool = True,
) -> Iterator[Section]:
    """The section after every stretch: each work once to warm up, then `rounds` of all of them in turn."""
    works = {match.key: dict(zip(contenders, (match.first, match.second), strict=True)) for match in matches}
    values: dict[str, dict[str, list[float]]] = {key: {name: [] for name in contenders} for key in works}
    for both in works.values() if warm_up else ():
        for work in both.values():
            work()
    stretch, stretches = 0, 2 * rounds * len(matches)
    for _ in range(rounds):
        for match in matches:
            for name, work in works[match.key].items():
                seconds, amount = timed(work, device)
                values[match.key][name].append(amount / seconds if match.rate else seconds / amount)
                stretch += 1
                yield _section(title, contenders, matches, values, stretch / stretches, note)


def timed(work: Work, device: torch.device) -> tuple[float, float]:
    """Seconds of a piece of work, and what it returns."""
    began = now(device)
    amount = work()
    return now(device) - began, amount


def _section(
    title: str,
    contenders: tuple[str, str],
    matches: Sequence[Match],
    values: dict[str, dict[str, list[float]]],
    done: float,
    note: str,
) -> Section:
    figures: list[Figure] = []
    record: dict[str, Any] = {}
    for match in matches:
        both = values[match.key]
        if all(both.values()):
            figure = Figure(match.label, *(median(both[name]) for name in contenders))
            entry = {name: {"median": median(both[name]), "rounds": list(both[name])} for name in contenders}
            record[match.key] = {**entry, "ratio": figure.ratio}
            figures.append(figure)
    return Section(title, contenders, figures, record, done, note)
