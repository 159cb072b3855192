"""Metrics on the CPU, and a mean over pairs that counts each pair once for any number of processes."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, distributed
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat


def first_of_each(pairs: Tensor) -> Tensor:
    """Positions `[U]` of the first occurrence of each pair in `[P]` (numbers) or `[P, 2]` (rows), in ascending order.

    >>> first_of_each(torch.tensor([7, 3, 7]))
    tensor([1, 0])
    """
    unique, place = torch.unique(pairs, dim=0, return_inverse=True)
    first = torch.full((len(unique),), len(pairs), device=pairs.device)
    return first.scatter_reduce(0, place, torch.arange(len(pairs), device=pairs.device), "amin")


class HostMetric(Metric):
    """A metric whose states stay on the CPU when its module is moved: not every device supports their float64."""

    full_state_update = False

    def __init__(self) -> None:
        super().__init__(dist_sync_fn=gathered)

    def _apply(self, *_: Any, **__: Any) -> HostMetric:
        """Ignore moves by `torch.nn.Module`."""
        return self


def gathered(value: Tensor, group: Any = None) -> list[Tensor]:
    """Gather `value` from all processes, as an object because GPU backends cannot exchange CPU tensors."""
    values = [value] * distributed.get_world_size(group)
    distributed.all_gather_object(values, value, group=group)
    return values


class PairMean(HostMetric):
    """Mean over pairs; pairs repeated to pad the shares of several processes count once."""

    pair: list[Tensor]
    value: list[Tensor]

    def __init__(self) -> None:
        super().__init__()
        self.add_state("pair", [], dist_reduce_fx="cat")
        self.add_state("value", [], dist_reduce_fx="cat")

    def update(self, pair: Tensor, value: Tensor) -> None:
        """Add values `[P]` (float64 inside) of pairs with these ids `[P]`."""
        self.pair.append(pair.cpu())
        self.value.append(value.detach().cpu().double())

    def compute(self) -> Tensor:
        """The mean, float32 scalar."""
        pair, value = dim_zero_cat(self.pair), dim_zero_cat(self.value)
        return value[first_of_each(pair)].mean().float()
