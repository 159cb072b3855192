"""Floating-point operations: how many a piece of work needs, in how many launches, and how many a device can do."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from lp_framework.benchmarks.harness import timed

MATMUL_SIDE = {"cpu": 1024, "cuda": 8192}
REPEATS = 5


class Arithmetic(NamedTuple):
    """The operations of a piece of work, and how many a second the device can do: those of a matrix product."""

    operations: int
    peak: float
    launches: int | None = None  # where they were counted

    def share(self, seconds: float) -> float:
        """The share of the device's peak that is reached when the work takes so long."""
        return self.operations / seconds / self.peak

    def __str__(self) -> str:
        launches = "" if self.launches is None else f" in {self.launches:,} launches"
        return f"{self.operations / 1e9:.3g} GFLOP{launches}, the device's peak {self.peak / 1e12:.3g} TFLOP/s"


def counted(work: Callable[[], object]) -> int:
    """Floating-point operations of the matrix products, convolutions and attentions in a piece of work.

    Their number depends on shapes alone: tensors on the meta device do, on which nothing is computed.
    """
    with FlopCounterMode(display=False) as counter:
        work()
    return int(counter.get_total_flops())


def launched(work: Callable[[], object]) -> int:
    """Operators in a piece of work that compute something, each at least one launch of a kernel on a GPU.

    Views and memory that is only taken do not count; on the meta device nothing is computed, as for `counted`.
    """
    with _Launches() as launches:
        work()
    return launches.count


class _Launches(TorchDispatchMode):
    FREE = ("aten::_unsafe_view", "aten::empty", "aten::new_empty")  # and what begins so

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(
        self, function: Any, types: Sequence[type], args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        self.count += not (function.is_view or function.name().startswith(self.FREE))
        return function(*args, **(kwargs or {}))


def peak_rate(device: torch.device, dtype: torch.dtype) -> float:
    """Operations a second of the fastest of a few products of square matrices."""
    side = MATMUL_SIDE["cuda" if device.type == "cuda" else "cpu"]
    matrix = torch.randn(side, side, device=device).to(dtype)
    matrix @ matrix
    return 2 * side**3 / min(timed(lambda: matrix @ matrix, device)[0] for _ in range(REPEATS))
