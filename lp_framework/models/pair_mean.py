"""The mean of a value a pair has, counted once a pair whatever the number of processes."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat


def first_of_each(pairs: Tensor) -> Tensor:
    """Positions `[U]` of the first occurrence of each number in `pairs` `[P]`, by ascending number.

    >>> first_of_each(torch.tensor([7, 3, 7]))
    tensor([1, 0])
    """
    order = torch.argsort(pairs, stable=True)
    ranked = pairs[order]
    new = torch.ones_like(ranked, dtype=torch.bool)
    new[1:] = ranked[1:] != ranked[:-1]
    return order[new]


class PairMean(Metric):
    """Mean over pairs; several processes pad their share with repeated pairs, which count once."""

    full_state_update = False
    pair: list[Tensor]
    value: list[Tensor]

    def __init__(self, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.add_state("pair", [], dist_reduce_fx="cat")
        self.add_state("value", [], dist_reduce_fx="cat")

    def update(self, pair: Tensor, value: Tensor) -> None:
        """Add values `[P]` (float64 inside) of the pairs numbered `[P]`."""
        self.pair.append(pair)
        self.value.append(value.double())

    def compute(self) -> Tensor:
        """The mean, float32 scalar."""
        pair, value = dim_zero_cat(self.pair), dim_zero_cat(self.value)
        return value[first_of_each(pair)].mean().float()
