"""Two solvers in a row: the second goes on where the first ended."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from lp_framework.solvers.base import Cost, Solution, choose


def in_a_row(first: Solution, second: Callable[[Tensor], Solution]) -> Solution:
    """The solution of `second`, which is given the ends of `first` `[B, N, 3]`, with the path and the cost of both.

    Energies and choice are the second's. A start is invalid where either failed; where the first did, it stays there.
    """
    # A start that failed goes along at the origin, so that the others stay in their places.
    after = second(first.poses.masked_fill(~first.valid[..., None], 0.0))
    energies = after.energies.masked_fill(~first.valid, torch.nan)
    return Solution(
        poses=torch.where(first.valid[..., None], after.poses, first.poses),
        energies=energies,
        valid=first.valid & after.valid,
        chosen=choose(energies),
        cost=Cost(first.cost.network_passes + after.cost.network_passes, first.cost.seconds + after.cost.seconds),
        trajectory=_joined(first.trajectory, after.trajectory),
    )


def _joined(first: Tensor | None, second: Tensor | None) -> Tensor | None:
    """Both paths, the second's longitudes in the turn where the first ended; the hand-over counts once."""
    if first is None or second is None:
        return None
    after = second[:, :, 1:]
    turns = ((first[:, :, -1:, 1] - second[:, :, :1, 1]) / (2 * math.pi)).round()
    after = torch.stack([after[..., 0], after[..., 1] + 2 * math.pi * turns, after[..., 2]], dim=-1)
    return torch.cat([first, after], dim=2)  # where the first stage failed the turns are NaN
