"""Floating-point operations: how many a piece of work needs, and how many a device can do."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch.utils.flop_counter import FlopCounterMode

from lp_framework.clock import now

# Dense tensor-core rates by NVIDIA's data sheets, TFLOP/s: of bfloat16 and float16, and of TF32, in which PyTorch lets
# cuDNN convolve float32 unless told otherwise. The first name that is found in the device's counts.
PEAKS = (
    (r"H200 NVL|H100 NVL", 835, 418),
    (r"H100 PCIe", 756, 378),
    (r"H100|H200|GH200", 989, 495),
    (r"A100", 312, 156),
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


class Arithmetic(NamedTuple):
    """The operations of a piece of work, and what the device could do."""

    operations: int
    peak: Peak

    def share(self, seconds: float) -> float:
        """The share of the device's peak that is reached when the work takes so long."""
        return self.operations / seconds / self.peak.rate

    def record(self) -> dict[str, float | str]:
        """For the JSON file."""
        return {
            "operations": self.operations,
            "peak_operations_per_second": self.peak.rate,
            "peak_source": self.peak.source,
        }

    def __str__(self) -> str:
        rate = f"{self.peak.rate / 1e12:.3g} TFLOP/s ({self.peak.source})"
        return f"{self.operations / 1e9:.3g} GFLOP, the device's peak {rate}"


def counted(work: Callable[[], object]) -> int:
    """Floating-point operations of the matrix products, convolutions and attentions in a piece of work.

    Their number depends on shapes alone: tensors on the meta device do, on which nothing is computed.
    """
    with FlopCounterMode(display=False) as counter:
        work()
    return int(counter.get_total_flops())


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
