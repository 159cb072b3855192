"""Tensors in a PyTorch file, read one at a time; nothing that the file says is ever run.

A file of `torch.save` is a zip archive: a pickle that describes the contents, and the bytes of each tensor as a record.
`torch.load` reads it, too, but there are two reasons for a reader of our own:

- *No code is run.* Published checkpoints mention classes of their training code, callbacks of PyTorch Lightning above
  all, which `torch.load(weights_only=True)` refuses, and without that argument unpickling runs whatever a file names.
  The unpickler here knows tensors and plain containers, and makes objects of an empty class of the training code's;
  a name from anywhere else is refused. (Before torch 2.6 `weights_only` itself could be made to run code,
  CVE-2025-32434.)
- *Memory.* Tensors are mapped one by one when they are asked for (see `stored_tensor`), so optimizer states take none.
"""

from __future__ import annotations

import io
import pickle
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from lp_framework.errors import UserError
from lp_framework.priors.zero123.stored_tensor import StoredTensor

STORAGES = {
    "FloatStorage": torch.float32,
    "DoubleStorage": torch.float64,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
}

# Classes of which an empty one stands in. None of this is what keeps a file from running code: no name is looked up.
STAND_IN_PACKAGES = ("pytorch_lightning", "lightning", "lightning_fabric", "lightning_utilities", "omegaconf", "ldm")
STAND_IN_MODULES = (
    "numpy",
    "numpy.core.multiarray",
    "numpy._core.multiarray",
    "torch.optim",
    "torch.optim.lr_scheduler",
)
STAND_INS = {
    *(str(dtype) for dtype in STORAGES.values()),
    *("torch.Size", "torch.device"),
    *(f"builtins.{name}" for name in ("set", "frozenset", "list", "dict", "tuple", "slice", "bytearray")),
    *(f"builtins.{name}" for name in ("int", "float", "complex", "bool", "str")),
    *(f"pathlib.{flavour}{system}Path" for flavour in ("", "Pure") for system in ("", "Posix", "Windows")),
    *("collections.defaultdict", "collections.Counter", "argparse.Namespace", "typing.Any", "_codecs.encode"),
}  # fmt: skip


def read_state_dict(path: Path) -> dict[str, StoredTensor]:
    """The tensors of a checkpoint's `state_dict`, or of a file that is nothing but one, by name.

    Raises `UserError` for a file that is missing, not of `torch.save`, damaged, or that would run code when unpickled.
    """
    contents = _Archive(path).contents()
    if isinstance(contents, Mapping) and isinstance(contents.get("state_dict"), Mapping):
        contents = contents["state_dict"]
    if not isinstance(contents, Mapping):
        raise UserError(f"{path}: holds no 'state_dict'; a checkpoint with named tensors is wanted")
    tensors = {str(name): value for name, value in contents.items() if isinstance(value, StoredTensor)}
    if not tensors:
        raise UserError(f"{path}: holds no named tensors; a checkpoint with a 'state_dict' is wanted")
    return tensors


class _Archive:
    """The zip archive that `torch.save` writes: `NAME/data.pkl`, and a record `NAME/data/KEY` for each storage."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.size = path.stat().st_size
            with path.open("rb") as file:
                start = file.read(4)
            archive = zipfile.ZipFile(path)
        except FileNotFoundError:
            raise UserError(f"{path}: there is no such file") from None
        except zipfile.BadZipFile as error:
            if start == b"PK\x03\x04":
                raise UserError(f"{path}: is cut short or damaged, its end is missing; download it again") from error
            raise UserError(f"{path}: is no PyTorch checkpoint (a zip archive that torch.save wrote)") from error
        except OSError as error:
            raise UserError(f"{path}: cannot be read: {error.strerror}") from error
        with archive:
            self.records = {info.filename: info for info in archive.infolist()}
            pickles = [name for name in self.records if name.endswith("/data.pkl")]
            if len(pickles) != 1:
                raise UserError(f"{path}: is a zip archive, but not one that torch.save wrote")
            self.root = pickles[0].removesuffix("/data.pkl")
            try:
                self.pickle = archive.read(pickles[0])
                order = (
                    archive.read(f"{self.root}/byteorder") if f"{self.root}/byteorder" in self.records else b"little"
                )
            except (zipfile.BadZipFile, EOFError, OSError) as error:
                raise UserError(f"{path}: is cut short or damaged; download it again") from error
        if order != b"little":
            raise UserError(f"{path}: was written on a big-endian machine; save it again on another")

    def contents(self) -> Any:
        """What was saved, with a `StoredTensor` for each tensor."""
        try:
            return _Unpickler(self).load()
        except UserError:
            raise
        except Exception as error:  # a damaged pickle fails in any way
            raise UserError(f"{self.path}: its description of the tensors is damaged; download it again") from error

    def storage(self, key: str) -> tuple[int, int]:
        """First byte and length of a storage's record."""
        info = self.records[f"{self.root}/data/{key}"]
        with self.path.open("rb") as file:
            file.seek(info.header_offset)
            header = file.read(30)
        name, extra = struct.unpack("<HH", header[26:30])
        start = info.header_offset + 30 + name + extra
        if info.compress_type != zipfile.ZIP_STORED or start + info.file_size > self.size:
            raise UserError(f"{self.path}: is cut short or damaged; download it again")
        return start, info.file_size


@dataclass(frozen=True)
class _Storage:
    """A storage: the file, its first byte, its length in bytes, the type of its elements."""

    path: Path
    start: int
    length: int
    dtype: torch.dtype


class _StandIn:
    """What objects of unknown classes become: takes everything, keeps nothing, does nothing."""

    def __new__(cls, *arguments: Any, **named: Any) -> _StandIn:
        return super().__new__(cls)

    def __init__(self, *arguments: Any, **named: Any) -> None: ...

    def __setstate__(self, state: Any) -> None: ...

    def __setitem__(self, key: Any, value: Any) -> None: ...

    def append(self, value: Any) -> None: ...

    def extend(self, values: Any) -> None: ...

    def add(self, value: Any) -> None: ...


class _Unpickler(pickle.Unpickler):
    """Knows tensors and dicts; `find_class`, by which alone a pickle reaches code, looks nothing up."""

    def __init__(self, archive: _Archive) -> None:
        super().__init__(io.BytesIO(archive.pickle), encoding="utf-8")
        self.archive = archive
        self.storages: dict[str, _Storage] = {}

    def find_class(self, module: str, name: str) -> Any:
        module = "builtins" if module == "__builtin__" else module  # as Python 2 and pickle protocol 2 call it
        full = f"{module}.{name}"
        if full == "collections.OrderedDict":
            return OrderedDict
        if full == "torch._utils._rebuild_tensor_v2":
            return _stored_tensor
        if full == "torch._utils._rebuild_parameter":
            return _stored_parameter
        if module in ("torch", "torch.storage") and name in STORAGES:
            return STORAGES[name]
        known = module.partition(".")[0] in STAND_IN_PACKAGES or module in STAND_IN_MODULES or full in STAND_INS
        if known:
            return type(name, (_StandIn,), {})
        raise UserError(
            f"{self.archive.path}: is refused, unpickling it would run '{full}'; a checkpoint of tensors is wanted"
        )

    def persistent_load(self, pid: Any) -> _Storage:
        _, dtype, key, _, _ = pid  # "storage", type, key, device, number of elements
        if key not in self.storages:
            self.storages[key] = _Storage(self.archive.path, *self.archive.storage(key), dtype)
        return self.storages[key]


def _stored_tensor(
    storage: _Storage, offset: int, shape: tuple[int, ...], stride: tuple[int, ...], *rest: Any
) -> StoredTensor:
    """Stands for `torch._utils._rebuild_tensor_v2`; `rest` is requires_grad, hooks and metadata."""
    start = storage.start + offset * storage.dtype.itemsize
    tensor = StoredTensor(storage.path, start, storage.dtype, tuple(shape), tuple(stride))
    if min((offset, *shape, *stride)) < 0 or (offset + tensor.extent()) * storage.dtype.itemsize > storage.length:
        raise UserError(f"{storage.path}: holds a tensor that is larger than its record; download it again")
    return tensor


def _stored_parameter(tensor: StoredTensor, *rest: Any) -> StoredTensor:
    """Stands for `torch._utils._rebuild_parameter`; `rest` is requires_grad and hooks."""
    return tensor
