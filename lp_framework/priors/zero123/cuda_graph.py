"""CUDA graphs: record a function's GPU work once and replay it with one launch instead of a thousand."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

Function = Callable[..., tuple[Tensor, ...]]
WARM_UP = 2  # calls before recording, in which libraries choose kernels


class Replayed:
    """Runs a function of tensors with CUDA graphs, one for each combination of input shapes and dtypes.

    The function must always be the same one; it is passed per call to avoid keeping its networks alive. A recording
    stores the addresses of everything that the function reads, including network weights: call `forget` when they
    move. The function must not read tensor values on the host, because results computed from them would be frozen in
    the recording. On a CPU the function is called directly.
    """

    def __init__(self) -> None:
        self.recordings: dict[Any, Recording] = {}

    def __call__(self, function: Function, *inputs: Tensor) -> tuple[Tensor, ...]:
        device = inputs[0].device
        if not can_record(device):
            return function(*inputs)
        key = tuple((each.shape, each.dtype, each.device) for each in inputs)
        if key not in self.recordings:
            self.recordings[key] = Recording(function, inputs, self._pool())
        return self.recordings[key](*inputs)

    def __reduce__(self) -> tuple[type[Replayed], tuple[()]]:
        return Replayed, ()  # a copy has its own addresses

    def forget(self) -> bool:
        """Free the recordings and record again at the next call; returns whether there were any."""
        had_any = bool(self.recordings)
        self.recordings.clear()
        return had_any

    def _pool(self) -> Any:
        """The memory pool shared by all recordings; after a replay, nothing but its copied results is needed."""
        return next((each.graph.pool() for each in self.recordings.values()), None)


def can_record(device: torch.device) -> bool:
    """Whether a device supports CUDA graphs."""
    return device.type == "cuda"


class Recording:
    """The CUDA graph of a function for fixed input shapes."""

    def __init__(self, function: Function, inputs: tuple[Tensor, ...], pool: Any) -> None:
        with torch.cuda.device(inputs[0].device):
            self.inputs = tuple(each.clone() for each in inputs)
            self.graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(WARM_UP):
                    function(*self.inputs)
            torch.cuda.current_stream().wait_stream(stream)
            # Thread-local errors, because a data loader's thread may pin memory during capture.
            with (
                _own_workspaces(),
                torch.cuda.graph(self.graph, pool=pool, stream=stream, capture_error_mode="thread_local"),
            ):
                self.outputs = function(*self.inputs)

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        for kept, given in zip(self.inputs, inputs, strict=True):
            kept.copy_(given)
        self.graph.replay()
        return tuple(each.clone() for each in self.outputs)  # the next replay overwrites them


@contextmanager
def _own_workspaces() -> Iterator[None]:
    """Allocate cuBLAS workspaces from the recording's memory and share them with no other recording.

    Otherwise PyTorch reuses them for the next recording on the stream and frees them with the first one. There is no
    public API for this; PyTorch's own `torch._inductor.cudagraph_trees` does the same.
    """
    torch._C._cuda_clearCublasWorkspaces()
    try:
        yield
    finally:
        torch._C._cuda_clearCublasWorkspaces()
