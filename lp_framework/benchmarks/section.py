"""What a measurement tells: figures of two contenders, and what is kept of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Figure:
    """A quantity, named with its unit, of the first and of the second contender."""

    label: str
    first: float
    second: float

    @property
    def ratio(self) -> float:
        """First over second."""
        return self.first / self.second


@dataclass(frozen=True)
class Section:
    """A measurement so far: a row a figure in the table, `record` in the JSON file, `done` in [0, 1]."""

    title: str
    contenders: tuple[str, str]
    figures: Sequence[Figure]
    record: Mapping[str, Any]
    done: float
    note: str = ""
