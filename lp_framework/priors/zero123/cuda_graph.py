"""A function's work on a GPU, recorded once and replayed: one launch from the host in place of a thousand."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

Function = Callable[..., tuple[Tensor, ...]]
WARM_UP = 2  # calls before a recording, in which libraries choose kernels


class Replayed:
    """Runs a function of tensors by CUDA graphs: one for each combination of shapes and dtypes it is called with.

    It is always the same function, handed over at each call lest its networks live as long as this does. A recording
    keeps the addresses of all that the function reads, its networks' weights too: `forget` the recordings when those
    move. The function must not look at values: what it computes from them on the host would stay as it was. On a CPU
    it is called as it is.
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
        return Replayed, ()  # a copy has addresses of its own

    def forget(self) -> bool:
        """Give the recordings' memory back, and record anew at the next call; whether there were any."""
        any_there = bool(self.recordings)
        self.recordings.clear()
        return any_there

    def _pool(self) -> Any:
        """The memory of the recordings. All share it: nothing of a replay is needed once its results are out."""
        return next((each.graph.pool() for each in self.recordings.values()), None)


def can_record(device: torch.device) -> bool:
    """Whether there are CUDA graphs on a device."""
    return device.type == "cuda"


class Recording:
    """What a function does with inputs of some shapes."""

    def __init__(self, function: Function, inputs: tuple[Tensor, ...], pool: Any) -> None:
        with torch.cuda.device(inputs[0].device):
            self.inputs = tuple(each.clone() for each in inputs)
            self.graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(WARM_UP):
                    function(*self.inputs)
            torch.cuda.current_stream().wait_stream(stream)
            # Errors by threads: a loader's may pin memory meanwhile.
            with (
                _workspaces_of_its_own(),
                torch.cuda.graph(self.graph, pool=pool, stream=stream, capture_error_mode="thread_local"),
            ):
                self.outputs = function(*self.inputs)

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        for kept, given in zip(self.inputs, inputs, strict=True):
            kept.copy_(given)
        self.graph.replay()
        return tuple(each.clone() for each in self.outputs)  # the next replay writes over them


@contextmanager
def _workspaces_of_its_own() -> Iterator[None]:
    """Workspaces of cuBLAS come from the recording's memory, and nobody else finds them there.

    Otherwise PyTorch hands them on to the next recording on the stream, and frees them with the first one. As in
    PyTorch's own `torch._inductor.cudagraph_trees`, there is no public way.
    """
    torch._C._cuda_clearCublasWorkspaces()
    try:
        yield
    finally:
        torch._C._cuda_clearCublasWorkspaces()
