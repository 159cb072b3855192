"""A progress bar for the steps of a single solve; evaluations have their own bar."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


class Bars(Protocol):
    """The interface used to show progress; `rich.progress.Progress` implements it."""

    def track(self, sequence: range, *, description: str) -> Iterable[int]:
        """Iterate over a range and advance the bar."""


_bars: ContextVar[Bars | None] = ContextVar("bars", default=None)


@contextmanager
def shown_progress() -> Iterator[None]:
    """Show the steps of solvers on the terminal, if there is one; finished bars disappear."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with (
        Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bars,
        progress_in(bars),
    ):
        yield


@contextmanager
def progress_in(bars: Bars) -> Iterator[None]:
    """Show the steps of solvers in these bars."""
    token = _bars.set(bars)
    try:
        yield
    finally:
        _bars.reset(token)


def steps_of(count: int, description: str) -> Iterable[int]:
    """0 to `count` - 1, with a bar inside `shown_progress` and `progress_in`."""
    bars = _bars.get()
    return range(count) if bars is None else bars.track(range(count), description=description)
