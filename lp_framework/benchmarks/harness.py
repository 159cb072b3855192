"""The harness of `bench`: two contenders at work in turn, and the memory that they take."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from lp_framework.clock import now

Work = Callable[[], float]  # does it, and returns how many of the row's unit were done
_Result = TypeVar("_Result")


@dataclass
class Section:
    """A measurement so far: `rows` by label with their unit, `facts` for the JSON file alone.

    A row has of either contender a value a round, or a single one. `changed` is called after every stretch of work.
    """

    title: str
    contenders: tuple[str, str]
    device: torch.device
    changed: Callable[[], None] = lambda: None
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
                    self.changed()

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


def peak_bytes(work: Callable[[], object], device: torch.device) -> int:
    """Bytes that the tensors made by some work take at most at once, beyond those that were there before.

    On a GPU PyTorch's allocator counts; on a CPU every operation's results are followed until they are gone, which
    takes time and leaves out what a kernel needs for itself.
    """
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        work()
        torch.cuda.synchronize(device)
        return torch.cuda.max_memory_allocated(device) - before
    with _Storages() as storages:
        work()
    return storages.peak


class _Storages(TorchDispatchMode):
    """Counts the bytes of the storages that operators make, from their making to their end."""

    def __init__(self) -> None:
        super().__init__()
        self.now = self.peak = 0
        self.alive: dict[int, int] = {}

    def __torch_dispatch__(
        self, function: Any, types: Sequence[type], args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        arguments = {*_storages((args, kwargs))}
        result = function(*args, **(kwargs or {}))
        for key, storage in _storages(result).items():
            if key not in self.alive and key not in arguments:  # else a view, or changed in place
                self.alive[key] = storage.nbytes()
                self.now += storage.nbytes()
                weakref.finalize(storage, self._end, key)
        self.peak = max(self.peak, self.now)
        return result

    def _end(self, key: int) -> None:
        self.now -= self.alive.pop(key)


def _storages(tree: Any) -> dict[int, torch.UntypedStorage]:
    """The memory of the tensors in nested containers, by its address in PyTorch."""
    storages = [leaf.untyped_storage() for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)]
    return {storage._cdata: storage for storage in storages}
