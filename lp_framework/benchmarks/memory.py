"""The largest memory that tensors take at once."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


def peak_bytes(work: Callable[[], object], device: torch.device) -> int:
    """Bytes that the tensors made by some work take at most at once, beyond those that were there before.

    On a GPU PyTorch's allocator counts; on a CPU, where nobody does, every operation's results are followed until they
    are gone (which takes time: do not clock it). What a kernel needs for itself is in the first alone.
    """
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        work()
        torch.cuda.synchronize(device)
        return torch.cuda.max_memory_allocated(device) - before
    with _Followed() as followed:
        work()
    return followed.peak


class _Followed(TorchDispatchMode):
    """Counts the bytes of storages that operations make, from their making to their end."""

    def __init__(self) -> None:
        super().__init__()
        self.now, self.peak, self.alive = 0, 0, dict[int, int]()

    def __torch_dispatch__(
        self, function: Any, types: Sequence[type], args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        arguments = {tensor.untyped_storage()._cdata for tensor in tree_leaves((args, kwargs)) if _is_tensor(tensor)}
        result = function(*args, **(kwargs or {}))
        for tensor in tree_leaves(result):
            if not _is_tensor(tensor):
                continue
            storage = tensor.untyped_storage()
            key = storage._cdata
            if key not in self.alive and key not in arguments:  # else a view, or changed in place
                self.alive[key] = storage.nbytes()
                self.now += storage.nbytes()
                weakref.finalize(storage, self._end, key)
        self.peak = max(self.peak, self.now)
        return result

    def _end(self, key: int) -> None:
        self.now -= self.alive.pop(key)


def _is_tensor(value: object) -> bool:
    return isinstance(value, Tensor)
