"""A tensor's place in a file, from which it is mapped alone; those of a safetensors file.

PyTorch and safetensors map a whole file, and each page that a tensor was copied from stays in memory until the last
tensor is done. A mapping of its own for each tensor ends with it: the peak of memory is then about the weights that are
kept, a sixth of what whole mappings take of a checkpoint with moving averages and optimizer states.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from lp_framework.errors import UserError

DTYPES = {
    **{"F64": torch.float64, "F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16, "BOOL": torch.bool},
    **{"I64": torch.int64, "I32": torch.int32, "I16": torch.int16, "I8": torch.int8, "U8": torch.uint8},
}


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
        mapped = np.memmap(self.path, np.uint8, "c", self.offset, shape=(self.extent(),))
        return torch.from_numpy(mapped).view(self.dtype).as_strided(self.shape, self.stride)

    def extent(self) -> int:
        """Bytes from the first to the last element, those in between included."""
        steps = sum((size - 1) * stride for size, stride in zip(self.shape, self.stride, strict=True))
        return 0 if 0 in self.shape else (1 + steps) * self.dtype.itemsize


def read_safetensors(path: Path) -> dict[str, StoredTensor]:
    """The tensors of a file by name; `UserError` for a file that is no safetensors file or is cut short."""
    try:
        with safe_open(path, "pt"), path.open("rb") as file:  # the library sees to it that the header is sound
            length = int.from_bytes(file.read(8), "little")
            header = json.loads(file.read(length))
        header.pop("__metadata__", None)
        return {
            name: StoredTensor(
                path, 8 + length + entry["data_offsets"][0], DTYPES[entry["dtype"]], tuple(entry["shape"]),
                torch.empty(entry["shape"], device="meta").stride(),
            )
            for name, entry in header.items()
        }  # fmt: skip
    except (OSError, ValueError, KeyError, RuntimeError, SafetensorError) as error:
        raise UserError(f"{path}: is no safetensors file, or is cut short; download it again ({error})") from error
