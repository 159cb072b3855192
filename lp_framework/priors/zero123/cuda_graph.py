"""A function's work on a GPU, recorded once and replayed: one launch from the host in place of a thousand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

Function = Callable[..., tuple[Tensor, ...]]
WARM_UP = 2  # calls before a recording, in which libraries choose kernels and take their workspaces


class Replayed:
    """A function of tensors alone, run by CUDA graphs: one for each combination of shapes and dtypes it is called with.

    A recording keeps the addresses of all that the function reads, its networks' weights too: `forget` the recordings
    when those move. The function must not look at values: what it computes from them on the host would stay as it was.
    On a CPU it is called as it is.
    """

    def __init__(self, function: Function) -> None:
        self.function = function
        self.recordings: dict[Any, Recording] = {}

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        if not can_record(inputs[0].device):
            return self.function(*inputs)
        key = tuple((each.shape, each.dtype, each.device) for each in inputs)
        if key not in self.recordings:
            self.recordings[key] = Recording(self.function, inputs, self._pool())
        return self.recordings[key](*inputs)

    def forget(self) -> None:
        """Record anew at the next call."""
        self.recordings.clear()

    def _pool(self) -> Any:
        """The memory of the recordings. All share it: nothing of a replay is needed once its results are out."""
        return next((each.graph.pool() for each in self.recordings.values()), None)


def can_record(device: torch.device) -> bool:
    """Whether there are CUDA graphs on a device."""
    return device.type == "cuda"


class Recording:
    """What a function does with inputs of some shapes."""

    def __init__(self, function: Function, inputs: tuple[Tensor, ...], pool: Any) -> None:
        self.inputs = tuple(each.clone() for each in inputs)
        beside = torch.cuda.Stream()  # what is recorded may not have begun on the usual stream
        beside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(beside):
            for _ in range(WARM_UP):
                function(*self.inputs)
        torch.cuda.current_stream().wait_stream(beside)
        self.graph = torch.cuda.CUDAGraph()
        # By threads: a loader's may pin memory meanwhile.
        with torch.cuda.graph(self.graph, pool=pool, capture_error_mode="thread_local"):
            self.outputs = function(*self.inputs)

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        for kept, given in zip(self.inputs, inputs, strict=True):
            kept.copy_(given)
        self.graph.replay()
        return tuple(each.clone() for each in self.outputs)  # the next replay writes over them
