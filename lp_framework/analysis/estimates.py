"""Estimate the cameras of photographs of one object, and record how they were found and how reliable they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from lp_framework.analysis.confidence import Answer, answers, answers_by_prior
from lp_framework.analysis.pairs import ShownPair, photographed_pairs, recording, with_solution
from lp_framework.api import move, view_set
from lp_framework.data.photographs import Photograph, Prepared, on_white
from lp_framework.data.views import FIELD_OF_VIEW_DEGREES
from lp_framework.geometry import apply_relative_pose
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Cost, Pairs, Solver
from lp_framework.solvers.starts import Starts


@dataclass(frozen=True)
class Estimate:
    """The cameras of I photographs: `absolute` view poses and poses `relative` to the first, `[I, 3]` each
    (radians and object sizes, float64, on the CPU; NaN if none was found), at `field_of_view_degrees`.

    `energies` `[I, I]` are the solver's, of the ordered pairs; `valid` is whether all poses are valid. `answers` rate
    the pose of each photograph but the first; empty if unknown. `radius_lost`: the crop to the object loses the
    distance, and nothing estimates it. `shown` are the `pairs` of the first photograph with each other one.
    """

    photographs: Sequence[Photograph]
    prepared: Sequence[Prepared]
    absolute: Tensor
    relative: Tensor
    field_of_view_degrees: float
    energies: Tensor
    valid: bool
    cost: Cost
    answers: Sequence[Answer]
    radius_lost: bool
    pairs: Pairs
    shown: Sequence[ShownPair]

    @property
    def files(self) -> list[Path]:
        """The files of the photographs."""
        return [Path(each.name) for each in self.photographs]


def estimate(
    photographs: Sequence[Photograph], crop: bool, solver: Solver, starts: Starts, prior: Prior | None,
    first: Tensor, device: torch.device, seed: int,
) -> Estimate:  # fmt: skip
    """Estimate the cameras of two or more photographs. The first photograph has the view pose `first` `[3]`.

    If no model gives probabilities, the solver's `prior` measures how unfamiliar the object is.
    """
    prepared = [each.prepared(crop) for each in photographs]
    images = [each.image for each in prepared]
    move(solver, device)
    move(starts, device)
    view_sets = view_set(images, device)
    pairs = view_sets.with_first()
    initial = starts.make(pairs, seed)
    solution = recording(solver).solve_views(view_sets, initial[None], seed)
    relative = torch.cat([torch.zeros(1, 3, dtype=torch.float64), solution.poses[0].detach().cpu().double()])
    found = answers(solution.pairs)
    radius_lost = crop and bool(found)
    if not found and prior is not None:
        found = answers_by_prior(prior, pairs, solution.poses[0])
    if radius_lost:
        relative[:, 2] = 0.0
    absolute = apply_relative_pose(first, relative)
    degrees = solver.field_of_view_degrees or FIELD_OF_VIEW_DEGREES
    energies, valid = solution.energies[0].detach().cpu().double(), bool(solution.valid[0])
    files = [Path(each.name) for each in photographs]
    shown = photographed_pairs(files, [on_white(image) for image in images], absolute.numpy())
    if solution.pairs is not None:
        shown = [with_solution(pair, solution.pairs, initial, place) for place, pair in enumerate(shown)]
    return Estimate(
        photographs, prepared, absolute, relative, degrees, energies, valid, solution.cost, found, radius_lost, pairs,
        shown,
    )  # fmt: skip
