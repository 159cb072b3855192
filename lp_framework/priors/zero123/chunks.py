"""A batch through the U-Net in pieces that fit into memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor

_Result = TypeVar("_Result")


class Chunks:
    """Runs a function on slices of a batch, at most `size` long (None: all of it).

    When a GPU runs out of memory, `release` gives back what it can and says whether that was anything; else the size is
    halved for good. Then the rest of the batch is tried again.
    """

    def __init__(self, size: int | None, release: Callable[[], bool] | None = None) -> None:
        self.size, self.release = size, release

    def run(self, function: Callable[[slice], _Result], batch: int) -> list[_Result]:
        """The results for `slice(0, size)`, `slice(size, 2 * size)`, ... of a batch."""
        results: list[_Result] = []
        start = 0
        while start < batch:
            stop = min(start + (self.size or batch), batch)
            try:
                results.append(function(slice(start, stop)))
            except torch.cuda.OutOfMemoryError:
                if self.release is None or not self.release():
                    if stop - start == 1:
                        raise
                    self.size = (stop - start) // 2
            else:
                start = stop
                continue
            torch.cuda.empty_cache()  # here the exception, and with it the tensors of the failed attempt, are gone
        return results


class EnergyAndSlope(torch.autograd.Function):
    """Energies `[B]` of poses `[B, 3]` whose gradient is computed at once, chunk by chunk.

    Each energy depends on its own pose alone, so its gradient is a row `[3]`, kept in the place of the network's
    activations; `both` computes the two of a chunk. Differentiable once; for more use the residual.
    """

    @staticmethod
    def forward(pose: Tensor, both: Callable[[slice], tuple[Tensor, Tensor]], chunks: Chunks) -> tuple[Tensor, Tensor]:
        energies, slopes = zip(*chunks.run(both, len(pose)), strict=True)
        return torch.cat(energies), torch.cat(slopes)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(output[1])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor, _: Tensor) -> tuple[Tensor, None, None]:
        (slopes,) = ctx.saved_tensors
        return grad[:, None] * slopes, None, None
