"""Tensors of a safetensors file, mapped one at a time.

The format: the length of the header (8 bytes, little-endian), the header in JSON, which gives each tensor's type, shape
and place, and the bytes. There is a reader of our own beside the safetensors library because the library maps a file as
a whole, so that what has been copied from it stays in memory (see `stored_tensor`).
"""

from __future__ import annotations

import json
import math
from itertools import accumulate
from pathlib import Path

import torch

from lp_framework.errors import UserError
from lp_framework.priors.zero123.stored_tensor import StoredTensor

DTYPES = {
    **{"F64": torch.float64, "F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16, "BOOL": torch.bool},
    **{"I64": torch.int64, "I32": torch.int32, "I16": torch.int16, "I8": torch.int8, "U8": torch.uint8},
}


def read_safetensors(path: Path) -> dict[str, StoredTensor]:
    """The tensors of a file by name; `UserError` for a file that is no safetensors file or is cut short."""
    try:
        with path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            size = path.stat().st_size
            header = json.loads(file.read(length)) if length <= size else None
        start = 8 + length
        tensors = {}
        for name, entry in header.items():  # type: ignore[union-attr]
            if name != "__metadata__":
                first, last = entry["data_offsets"]
                shape, dtype = tuple(entry["shape"]), DTYPES[entry["dtype"]]
                if last - first != math.prod(shape) * dtype.itemsize or not 0 <= first <= last <= size - start:
                    raise ValueError(f"'{name}' does not fit into the file")
                tensors[name] = StoredTensor(path, start + first, dtype, shape, _row_major(shape))
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(f"{path}: is no safetensors file, or is cut short; download it again") from error
    return tensors


def _row_major(shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(accumulate(shape[:0:-1], lambda stride, extent: stride * extent, initial=1))[::-1] if shape else ()
