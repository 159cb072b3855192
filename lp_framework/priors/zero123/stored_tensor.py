"""A tensor's place in a file, from which it is mapped alone.

PyTorch and safetensors map a whole file: each page that a tensor was copied from stays in memory until the last tensor
is done, so that loading into another dtype takes the file and the result. A mapping of its own for each tensor ends
with it; the peak of memory is then about the weights that are kept, a sixth of what whole mappings take of a checkpoint
with moving averages and optimizer states.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class StoredTensor:
    """A tensor's place in a file: `offset` in bytes, `stride` in elements."""

    path: Path
    offset: int
    dtype: torch.dtype
    shape: tuple[int, ...]
    stride: tuple[int, ...]

    def map(self) -> Tensor:
        """The tensor, mapped from the file: only the bytes that are looked at take memory, while it lives."""
        if 0 in self.shape:
            return torch.empty(self.shape, dtype=self.dtype)
        mapped = np.memmap(self.path, np.uint8, "c", self.offset, shape=(self.extent() * self.dtype.itemsize,))
        return torch.from_numpy(mapped).view(self.dtype).as_strided(self.shape, self.stride)

    def extent(self) -> int:
        """Elements from the first to the last, those in between included."""
        if 0 in self.shape:
            return 0
        return 1 + sum((size - 1) * stride for size, stride in zip(self.shape, self.stride, strict=True))
