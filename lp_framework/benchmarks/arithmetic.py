"""Floating-point operations: how many a piece of work needs, in how many launches, and how many a device can do."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from lp_framework.clock import now

# Dense tensor-core rates by NVIDIA's data sheets, TFLOP/s: of bfloat16 and float16, and of TF32, in which PyTorch lets
# cuDNN convolve float32 unless told otherwise. The first name that is found in the device's counts.
PEAKS = (
    (r"H200 NVL|H100 NVL", 835, 418),
    (r"H100 PCIe", 756, 378),
    (r"H100|H200|GH200", 989, 495),
    (r"\bA100\b", 312, 156),
    (r"L40S", 362, 183),
    (r"\bL4\b", 121, 60),
    (r"RTX 6000 Ada", 364, 182),
    (r"RTX 4090", 165, 83),
    (r"RTX A6000", 155, 77),
    (r"RTX 3090\b", 71, 36),
)
MATMUL_SIDE = {"cpu": 1024, "cuda": 8192}
REPEATS = 5


class Peak(NamedTuple):
    """Operations a second of a device in some dtype, and where the number is from."""

    rate: float
    source: str

    def __str__(self) -> str:
        return f"{self.rate / 1e12:.3g} TFLOP/s ({self.source})"


class Arithmetic(NamedTuple):
    """The operations of a piece of work, what the device could do, and the launches where they were counted."""

    operations: int
    peak: Peak
    launches: int | None = None

    def share(self, seconds: float) -> float:
        """The share of the device's peak that is reached when the work takes so long."""
        return self.operations / seconds / self.peak.rate

    def record(self) -> dict[str, float | str]:
        """For the JSON file."""
        return {
            "operations": self.operations,
            **({} if self.launches is None else {"launches": self.launches}),
            "peak_operations_per_second": self.peak.rate,
            "peak_source": self.peak.source,
        }

    def __str__(self) -> str:
        launches = "" if self.launches is None else f" in {self.launches:,} launches"
        return f"{self.operations / 1e9:.3g} GFLOP{launches}, the device's peak {self.peak}"


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


def peak(device: torch.device, dtype: torch.dtype) -> Peak:
    """The data sheet's rate of a GPU that is known here, else the rate of a matrix product on the device."""
    if device.type == "cuda":
        name = torch.cuda.get_device_name(device)
        for pattern, half, single in PEAKS:
            if re.search(pattern, name):
                return Peak(1e12 * (single if dtype == torch.float32 else half), "data sheet")
    return Peak(matmul_rate(device, dtype), "matrix product")


def matmul_rate(device: torch.device, dtype: torch.dtype) -> float:
    """Operations a second of the fastest of a few products of square matrices."""
    side = MATMUL_SIDE["cuda" if device.type == "cuda" else "cpu"]
    matrix = torch.randn(side, side, device=device).to(dtype)
    matrix @ matrix
    seconds = []
    for _ in range(REPEATS):
        began = now(device)
        matrix @ matrix
        seconds.append(now(device) - began)
    return 2 * side**3 / min(seconds)
