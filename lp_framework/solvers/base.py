"""The solver interface: pairs of images and starting poses in, a `Solution` out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lp_framework.errors import UserError


@dataclass(frozen=True)
class Pairs:
    """B problems among I images: `images` `[I, 3, H, W]` in [-1, 1] on white, each once; `reference`, `query` `[B]`
    point to them; `ids` `[B]` are integers that name the pairs for good, to which random draws are keyed.
    """

    images: Tensor
    reference: Tensor
    query: Tensor
    ids: Tensor

    def __post_init__(self) -> None:
        if self.images.ndim != 4 or self.images.shape[1] != 3:
            raise UserError(f"images must be [I, 3, H, W], got {list(self.images.shape)}")
        if not (self.reference.shape == self.query.shape == self.ids.shape and self.reference.ndim == 1):
            shapes = [list(each.shape) for each in (self.reference, self.query, self.ids)]
            raise UserError(f"reference, query and ids must be [B] each, got {shapes}")

    def __len__(self) -> int:
        return len(self.reference)


@dataclass(frozen=True)
class Cost:
    """What a solution took: passes of samples through the network, and seconds (of the whole batch)."""

    network_passes: int
    seconds: float


@dataclass(frozen=True)
class Solution:
    """`poses` `[B, N, 3]` final relative poses, `energies` `[B, N]` (lower is better, comparable along N), `valid`
    `[B, N]`, `chosen` `[B]` index of the start that is the answer; `cameras` `[B, N, 4, 4]` of solvers that predict
    full ones (camera to world, in the reference's object frame); `trajectory` `[B, N, steps + 1, 3]` on request,
    longitudes unreduced.
    """

    poses: Tensor
    energies: Tensor
    valid: Tensor
    chosen: Tensor
    cost: Cost
    cameras: Tensor | None = None
    trajectory: Tensor | None = None

    def answer(self) -> Tensor:
        """The chosen poses `[B, 3]`."""
        return self.poses[torch.arange(len(self.poses), device=self.poses.device), self.chosen]


def choose(energies: Tensor) -> Tensor:
    """Index `[B]` of the least energy among `[B, N]`; what is not finite is passed over."""
    return energies.nan_to_num(nan=torch.inf, posinf=torch.inf, neginf=torch.inf).argmin(dim=1)


def check_starts(pairs: Pairs, starts: Tensor) -> None:
    """`UserError` unless `starts` is `[B, N, 3]`, finite, with N >= 1."""
    if starts.ndim != 3 or starts.shape[0] != len(pairs) or starts.shape[1] < 1 or starts.shape[2] != 3:
        raise UserError(
            f"starts must be [B, N, 3] with B = {len(pairs)}, got {list(starts.shape)}; for one start pass [:, None]"
        )
    if not starts.isfinite().all():
        raise UserError("starts must be finite numbers")


def as_triple(name: str, value: float | Sequence[float]) -> list[float]:
    """Three numbers (latitude, longitude, radius) from three, or from one that is the longitude's."""
    triple = [0.0, float(value), 0.0] if isinstance(value, int | float) else [float(each) for each in value]
    if len(triple) != 3 or not all(0 <= each < float("inf") for each in triple):
        raise UserError(
            f"{name} must be one number (longitude) or three (latitude, longitude, radius), none negative; got {value}"
        )
    return triple


class Solver(ABC):
    """Estimates relative poses. A subclass's constructor declares what it needs by name: `model`, `prior`."""

    @abstractmethod
    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        """Solve all pairs from starts `[B, N, 3]` (relative poses), all together.

        The result for a pair and start depends on them, on the pair's id and on `seed` alone.
        """
