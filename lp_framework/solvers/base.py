"""The solver interface: pairs of images and starting poses in, a `Solution` out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any, TypeVar, cast

import torch
from lightning.fabric.utilities import move_data_to_device
from torch import Tensor, nn

from lp_framework.clock import now
from lp_framework.data.pairs import PairBatch
from lp_framework.errors import UserError
from lp_framework.keyed_random import keyed_bits

_Solve = TypeVar("_Solve", bound=Callable[..., Any])


@dataclass(frozen=True)
class Pairs:
    """B pairs among I images.

    `images` `[I, 3, H, W]` in [-1, 1] on white contains each image once; `reference` and `query` `[B]` are indices into
    it. `ids` `[B]` are integers that identify the pairs and key the random draws. `field_of_view` `[I]` is in radians,
    on the CPU; None means the priors' own.
    """

    images: Tensor
    reference: Tensor
    query: Tensor
    ids: Tensor
    field_of_view: Tensor | None = None

    def __post_init__(self) -> None:
        _check_images(self.images)
        if not (self.reference.shape == self.query.shape == self.ids.shape and self.reference.ndim == 1):
            shapes = [list(each.shape) for each in (self.reference, self.query, self.ids)]
            raise UserError(f"reference, query and ids must be [B] each, got {shapes}")

    def __len__(self) -> int:
        return len(self.reference)


def pairs_of(batch: PairBatch, device: torch.device) -> Pairs:
    """Move the pairs of a batch to a device. The batch must contain images, not cached features."""
    batch = move_data_to_device(batch, device)
    return Pairs(batch.images, batch.reference, batch.query, batch.ids, batch.field_of_view)


@dataclass(frozen=True)
class ViewSets:
    """S sets of V >= 2 images each, solved jointly.

    `views` `[S, V]` are indices into `images`. `images`, `ids` `[S]` and `field_of_view` are as in `Pairs`.
    """

    images: Tensor
    views: Tensor
    ids: Tensor
    field_of_view: Tensor | None = None

    def __post_init__(self) -> None:
        _check_images(self.images)
        if self.views.ndim != 2 or self.views.shape[1] < 2 or self.ids.shape != self.views.shape[:1]:
            shapes = [list(each.shape) for each in (self.views, self.ids)]
            raise UserError(f"views must be [S, V] with V >= 2 and ids [S], got {shapes}")

    def __len__(self) -> int:
        return len(self.views)

    def with_first(self) -> Pairs:
        """The S x (V - 1) pairs of each set's first image (the reference) with its other images, ordered by set."""
        views = self.views.shape[1]
        return self.pairs([0] * (views - 1), range(1, views))

    def pairs(self, reference: Sequence[int], query: Sequence[int]) -> Pairs:
        """The S x P pairs of images at positions `reference[P]` and `query[P]` in each set, ordered by set."""
        places = torch.tensor([list(reference), list(query)])
        ids = keyed_bits(self.ids[:, None], *places, count=1).to(self.ids.device)
        chosen = self.views[:, places.to(self.views.device)]  # [S, 2, P]
        ends = chosen[:, 0].flatten(), chosen[:, 1].flatten()
        return Pairs(self.images, *ends, ids.flatten(), self.field_of_view)


def _check_images(images: Tensor) -> None:
    if images.ndim != 4 or images.shape[1] != 3:
        raise UserError(f"images must be [I, 3, H, W], got {list(images.shape)}")


@dataclass(frozen=True)
class Cost:
    """The cost of a batch: number of samples passed through a network, and wall-clock seconds."""

    network_passes: int
    seconds: float = 0.0


@dataclass(frozen=True)
class Solution:
    """The result of solving B pairs from N starts each.

    - `poses` `[B, N, 3]`: final relative poses.
    - `energies` `[B, N]`: lower is better; comparable along N.
    - `valid` `[B, N]`: whether the start succeeded.
    - `chosen` `[B]`: index of the start that is the answer.
    - `cameras` `[B, N, 4, 4]`: query cameras in the reference's frame, with translation up to scale (see
      `geometry.two_view`); only from solvers that predict full cameras.
    - `trajectory` `[B, N, steps + 1, 3]`: if requested; longitudes are not reduced to [0, 2 pi).
    - `probability` `[B, N]`: that the true rotation is within 30 degrees of the pose's; only with a density model.
    """

    poses: Tensor
    energies: Tensor
    valid: Tensor
    chosen: Tensor
    cost: Cost
    cameras: Tensor | None = None
    trajectory: Tensor | None = None
    probability: Tensor | None = None

    def answer(self) -> Tensor:
        """The chosen poses `[B, 3]`."""
        return self.poses[torch.arange(len(self.poses), device=self.poses.device), self.chosen]


@dataclass(frozen=True)
class ViewSolution:
    """The result of solving S sets of V views.

    - `poses` `[S, V - 1, 3]`: poses of the other views relative to the first.
    - `energies` `[S, V, V]`: of the ordered pairs (row: reference, column: query); NaN where not computed.
    - `valid` `[S]`: whether all poses of the set are valid.
    - `pairs`: solution of the S x (V - 1) pairs with the first view, if they were solved independently.
    """

    poses: Tensor
    energies: Tensor
    valid: Tensor
    cost: Cost
    pairs: Solution | None = None


def choose(energies: Tensor) -> Tensor:
    """Index `[B]` of the lowest energy of `[B, N]`; non-finite values are ignored."""
    return energies.nan_to_num(nan=torch.inf, posinf=torch.inf, neginf=torch.inf).argmin(dim=1)


def check_starts(problems: Pairs | ViewSets, starts: Tensor) -> None:
    """`UserError` unless `starts` is `[B, N, 3]` for pairs or `[S, V - 1, N, 3]` for sets, finite, with N >= 1."""
    if isinstance(problems, Pairs):
        batch, wanted = [len(problems)], f"[B, N, 3] with B = {len(problems)}"
    else:
        batch = [len(problems), problems.views.shape[1] - 1]
        wanted = f"[S, V - 1, N, 3] with S = {batch[0]} and V - 1 = {batch[1]}"
    if list(starts.shape[:-2]) != batch or starts.shape[-2] < 1 or starts.shape[-1] != 3:
        raise UserError(f"starts must be {wanted}, got {list(starts.shape)}; for one start each pass N = 1")
    if not starts.isfinite().all():
        raise UserError("starts must be finite numbers")


def timed(solve: _Solve) -> _Solve:
    """Decorator for `solve` and `solve_views`: checks the starts, disables gradients, records the seconds."""

    @wraps(solve)
    @torch.no_grad()
    def wrapper(self: Solver, problems: Pairs | ViewSets, starts: Tensor, seed: int) -> Any:
        check_starts(problems, starts)
        start = now(starts.device)
        solution = solve(self, problems, starts, seed)
        return replace(solution, cost=replace(solution.cost, seconds=now(starts.device) - start))

    return cast(_Solve, wrapper)


class NetworkUser:
    """Base class of objects that hold networks (models, priors) as attributes."""

    def networks(self) -> list[nn.Module]:
        """The networks, to be moved to a device."""
        return [part for part in vars(self).values() if isinstance(part, nn.Module)]


class Solver(NetworkUser, ABC):
    """Estimates relative poses. A subclass's constructor declares what it needs by name: `model`, `prior`."""

    one_answer = False  # it ignores starts and gives one answer per pair, so there is no success rate over starts
    field_of_view_degrees: float | None = None  # of all images, if set

    def samples_per_pair(self, starts: int) -> int:
        """Number of samples per pair passed through the prior at once: both directions of each start."""
        return 2 * starts

    @abstractmethod
    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        """Solve all pairs from starts `[B, N, 3]`, in one batch.

        The result of a start depends only on its pair, the start and `seed`, not on the rest of the batch.
        """

    def solve_views(self, view_sets: ViewSets, starts: Tensor, seed: int) -> ViewSolution:
        """Solve sets of V images from starts `[S, V - 1, N, 3]`: N for each other view, relative to the first.

        By default each pair with the first view is solved independently; solvers that use all views override this.
        """
        check_starts(view_sets, starts)
        return of_first_views(view_sets, self.solve(view_sets.with_first(), starts.flatten(0, 1), seed))


def of_first_views(view_sets: ViewSets, solution: Solution) -> ViewSolution:
    """Turn the solution of all pairs with the first view into the solution of the sets."""
    sets, views = view_sets.views.shape
    chosen = solution.chosen[:, None]
    energies = solution.energies.new_full((sets, views, views), torch.nan)
    energies[:, 0, 1:] = solution.energies.gather(1, chosen).view(sets, views - 1)
    valid = solution.valid.gather(1, chosen).view(sets, views - 1).all(dim=1)
    return ViewSolution(solution.answer().view(sets, views - 1, 3), energies, valid, solution.cost, solution)
