"""Memory-map the tensors in PyTorch and safetensors files one at a time, without executing code from a file.

The libraries' own readers map a whole file, so every page that was copied stays in memory until the last tensor is
read. With one mapping per tensor, peak memory is about the size of the weights that are kept.

Published checkpoints reference classes of their training code, mostly PyTorch Lightning callbacks.
`torch.load(weights_only=True)` refuses these, and without that argument unpickling executes whatever a file names. Our
unpickler supports tensors and plain containers, replaces training code objects by empty ones, and refuses all else.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import re
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from lp_framework.errors import UserError

DTYPES = {
    **{"F64": torch.float64, "F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16, "BOOL": torch.bool},
    **{"I64": torch.int64, "I32": torch.int32, "I16": torch.int16, "I8": torch.int8, "U8": torch.uint8},
}
STORAGES = {
    **{"FloatStorage": torch.float32, "DoubleStorage": torch.float64, "HalfStorage": torch.float16},
    **{"BFloat16Storage": torch.bfloat16, "LongStorage": torch.int64, "IntStorage": torch.int32},
    **{"ShortStorage": torch.int16, "CharStorage": torch.int8, "ByteStorage": torch.uint8, "BoolStorage": torch.bool},
}

# Classes replaced by an empty one. Safety does not depend on this list: names are never looked up.
STAND_INS = re.compile(
    r"(pytorch_lightning|lightning|lightning_fabric|lightning_utilities|omegaconf|ldm)\..*"
    r"|numpy(\._?core\.multiarray)?\.\w+|torch\.optim(\.lr_scheduler)?\.\w+"
    r"|torch\.(Size|device|bool|u?int\d+|b?float\d+)"
    r"|builtins\.(set|frozenset|list|dict|tuple|slice|bytearray|int|float|complex|bool|str)"
    r"|pathlib\.\w*Path|collections\.(defaultdict|Counter)|argparse\.Namespace|typing\.Any|_codecs\.encode"
)


@dataclass(frozen=True)
class StoredTensor:
    """A tensor's place in a file: `offset` in bytes, `stride` in elements."""

    path: Path
    offset: int
    dtype: torch.dtype
    shape: tuple[int, ...]
    stride: tuple[int, ...]

    def map(self) -> Tensor:
        """Memory-map the tensor: only bytes that are read take memory, for its lifetime."""
        if 0 in self.shape:
            return torch.empty(self.shape, dtype=self.dtype)
        mapped = np.memmap(self.path, np.uint8, "c", self.offset, shape=(self.extent(),))
        return torch.from_numpy(mapped).view(self.dtype).as_strided(self.shape, self.stride)

    def extent(self) -> int:
        """Number of bytes from the first to the last element, including gaps."""
        steps = sum((size - 1) * stride for size, stride in zip(self.shape, self.stride, strict=True))
        return 0 if 0 in self.shape else (1 + steps) * self.dtype.itemsize


def read_safetensors(path: Path) -> dict[str, StoredTensor]:
    """Read the tensors of a file by name; raises `UserError` if it is not a safetensors file or is truncated."""
    try:
        with safe_open(path, "pt"), path.open("rb") as file:  # the library validates the header
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
        raise UserError(f"{path}: is not a safetensors file, or is cut short; download it again ({error})") from error


def read_state_dict(path: Path) -> dict[str, StoredTensor]:
    """Read the tensors of a checkpoint's `state_dict`, or of a bare state dict, by name; raises `UserError` for a file
    that is missing, not written by `torch.save`, damaged, or that would execute code when unpickled."""
    try:
        with zipfile.ZipFile(path) as archive, path.open("rb") as file:
            contents = _Unpickler(path, archive, file).load()
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from error
    except zipfile.BadZipFile as error:
        message = (
            f"{path}: is not a PyTorch checkpoint (a zip archive that torch.save wrote), or is cut short or damaged"
        )
        raise UserError(message) from error
    except Exception as error:  # a damaged pickle can raise anything
        raise UserError(f"{path}: its description of the tensors is damaged; download it again") from error
    if isinstance(contents, Mapping) and isinstance(contents.get("state_dict"), Mapping):
        contents = contents["state_dict"]
    named = contents.items() if isinstance(contents, Mapping) else ()
    tensors = {str(name): value for name, value in named if isinstance(value, StoredTensor)}
    if not tensors:
        raise UserError(f"{path}: holds no named tensors; expected a checkpoint with a 'state_dict'")
    return tensors


class _Storage(NamedTuple):
    """Location of a storage: first byte in the file, length in bytes, and dtype of the elements."""

    start: int
    length: int
    dtype: torch.dtype


class _StandIn:
    """Stand-in for objects of the training code: accepts everything, stores nothing, does nothing."""

    def __new__(cls, *arguments: Any, **named: Any) -> _StandIn:
        return super().__new__(cls)

    def __setitem__(self, key: Any, value: Any) -> None: ...

    def __getattr__(self, name: str) -> Any:
        return lambda *arguments: None


class _Unpickler(pickle.Unpickler):
    """Reads `NAME/data.pkl` of an archive, where each storage is a record `NAME/data/KEY`.

    `find_class`, the only way for a pickle to reach code, never looks up a name.
    """

    def __init__(self, path: Path, archive: zipfile.ZipFile, file: BinaryIO) -> None:
        pickles = [name for name in archive.namelist() if name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise UserError(f"{path}: is a zip archive, but not one that torch.save wrote")
        super().__init__(io.BytesIO(archive.read(pickles[0])), encoding="utf-8")
        self.path, self.archive, self.file, self.root = path, archive, file, pickles[0].removesuffix("/data.pkl")

    def find_class(self, module: str, name: str) -> Any:
        module = "builtins" if module == "__builtin__" else module  # its name in Python 2 and pickle protocol 2
        full = f"{module}.{name}"
        if full == "collections.OrderedDict":
            return OrderedDict
        if full == "torch._utils._rebuild_tensor_v2":
            return self._tensor
        if full == "torch._utils._rebuild_parameter":
            return lambda tensor, *rest: tensor  # requires_grad and hooks
        if module in ("torch", "torch.storage") and name in STORAGES:
            return STORAGES[name]
        if STAND_INS.fullmatch(full):
            return type(name, (_StandIn,), {})
        raise UserError(
            f"{self.path}: is refused, because unpickling it would run '{full}'; expected a checkpoint of tensors"
        )

    def persistent_load(self, pid: Any) -> _Storage:
        _, dtype, key, _, _ = pid  # "storage", type, key, device, number of elements
        info = self.archive.getinfo(f"{self.root}/data/{key}")
        self.file.seek(info.header_offset + 26)
        start = info.header_offset + 30 + sum(struct.unpack("<HH", self.file.read(4)))  # skip name and extra field
        if info.compress_type != zipfile.ZIP_STORED or start + info.file_size > os.fstat(self.file.fileno()).st_size:
            raise UserError(f"{self.path}: is cut short or damaged; download it again")
        return _Storage(start, info.file_size, dtype)

    def _tensor(self, storage: _Storage, offset: int, shape: Any, stride: Any, *rest: Any) -> StoredTensor:
        """Replaces `torch._utils._rebuild_tensor_v2`; `rest` is requires_grad, hooks and metadata."""
        skipped = offset * storage.dtype.itemsize
        tensor = StoredTensor(self.path, storage.start + skipped, storage.dtype, tuple(shape), tuple(stride))
        if min((offset, *shape, *stride)) < 0 or skipped + tensor.extent() > storage.length:
            raise UserError(f"{self.path}: holds a tensor that is larger than its record; download it again")
        return tensor
