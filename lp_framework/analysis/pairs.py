"""Pairs for display, as plain arrays: their views, and everything that explains what a solver does with them.

The functions take pairs both as tensors on a device (`Pairs`) and as arrays (one `ShownPair` per pair), and return
the arrays with more fields filled in.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.analysis import fields
from lp_framework.analysis.landscapes import Arrows, Grid, Landscape, landscape_grid
from lp_framework.data.module import PairDataModule
from lp_framework.data.pairs import PairData
from lp_framework.data.views import FIELD_OF_VIEW_DEGREES
from lp_framework.errors import UserError, nearest
from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS
from lp_framework.geometry import apply_relative_pose, camera_to_world, rotation_error
from lp_framework.models.pose_model import FieldValue, PoseModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs, Solution, Solver, pairs_of
from lp_framework.solvers.langevin import Langevin

PRIOR_ENERGY = "energy of the prior"


@dataclass(frozen=True)
class View:
    """One image of a pair: its file, its pixels `[H, W, 3]` (uint8), its true view pose `[3]` and its field of view
    (radians; defaults to that of the priors, as for crops to the object)."""

    file: Path
    image: NDArray
    pose: NDArray
    field_of_view: float = math.radians(FIELD_OF_VIEW_DEGREES)


@dataclass(frozen=True)
class ShownPair:
    """A pair and what a solver did with it, for N starts, in radians and object sizes; NaN if unknown.

    `truth` `[3]`, `starts` and `ends` `[N, 3]` are relative poses; `trajectories` `[N, S + 1, 3]` have unwrapped
    longitudes. `trajectories` is None if the solver keeps none, `starts` if it makes its own candidates, and `truth`
    for photographs. `energies` `[N]` are the solver's; `chosen` indexes its answer, None if that is not a pose.
    `rotation_errors` (degrees) and `translation_errors` are `[N]`. A pair that was not solved has no ends.
    `landscapes` are by name, at the true relative radius; `maps` are drawn beside the images.
    """

    object: str
    ambiguity: str
    reason: str
    reference: View
    query: View
    truth: NDArray | None = None
    starts: NDArray | None = None
    trajectories: NDArray | None = None
    ends: NDArray = field(default_factory=lambda: np.empty((0, 3)))
    energies: NDArray = field(default_factory=lambda: np.empty(0))
    chosen: int | None = None
    rotation_errors: NDArray = field(default_factory=lambda: np.empty(0))
    translation_errors: NDArray = field(default_factory=lambda: np.empty(0))
    landscapes: Mapping[str, Landscape] = field(default_factory=dict)
    maps: Sequence[PoseMap] = ()

    @property
    def title(self) -> str:
        """The object's name for display."""
        return words(self.object)

    @property
    def failed(self) -> bool:
        """Whether the answer's error exceeds the widest threshold; False without a truth, True without an answer."""
        if self.truth is None:
            return False
        return self.chosen is None or not self.rotation_errors[self.chosen] <= ROTATION_THRESHOLDS[-1]

    @property
    def prior_energy(self) -> Landscape:
        """The landscape of the prior."""
        return self.landscapes[PRIOR_ENERGY]

    def start_longitudes(self) -> list[float] | list[None]:
        """Longitude of each end's start, degrees in [0, 360); None if the solver made its own starts."""
        if self.starts is None:
            return [None] * len(self.ends)
        return (np.rad2deg(self.starts[:, 1]) % 360).tolist()

    def finite(self) -> ShownPair:
        """The pair with only the starts that reached a finite pose."""
        sound = np.isfinite(self.ends).all(axis=-1)
        lost = self.chosen is None or not sound[self.chosen]
        names = ("starts", "trajectories", "ends", "energies", "rotation_errors", "translation_errors")
        kept: dict[str, Any] = {name: each[sound] for name in names if (each := getattr(self, name)) is not None}
        return replace(self, chosen=None if lost else int(sound[: self.chosen].sum()), **kept)


class PoseMap(NamedTuple):
    """A map of relative latitude and longitude: its title and its layers, from bottom to top.

    An energy as `relief`, or exp(-E) as `density`; a score as `arrows`; a solver's trajectories in `solved`.
    """

    title: str = ""
    relief: Landscape | None = None
    density: Landscape | None = None
    arrows: Arrows | None = None
    solved: ShownPair | None = None


def words(name: str) -> str:
    """Format the name of an object or solver for display.

    >>> words("two_stage")
    'two stage'
    """
    return name.replace("_", " ")


ARROW_SPACING = 12.0  # degrees
SAMPLING = (50, 3.0)  # DDIM steps and guidance for the views generated at the ends
DENSITY_GRID = landscape_grid(60.0, 4.0, 6.0)


def shown_pairs(data: PairData, views: NDArray[np.int64], device: torch.device) -> tuple[Pairs, list[ShownPair]]:
    """P pairs of views (reference, query) by their indices `[P, 2]` in the data's table, on a device and as arrays."""
    table, batch, images = data.table, data[views], data.images
    assert images is not None  # displayed data never cache features
    shown = []
    for pair, truth in zip(views, batch.relative_poses().numpy(), strict=True):
        index = int(table.object_of_view[pair[0]])
        reference, query = (
            View(table.files[view], np.asarray(images[view]), table.poses[view].numpy(),
                 View.field_of_view if data.crop else table.field_of_view[view].item())
            for view in pair
        )  # fmt: skip
        shown.append(ShownPair(table.names[index], table.ambiguities[index], "", reference, query, truth))
    return pairs_of(batch, device), shown


def photographed_pairs(files: Sequence[Path], images: Sequence[NDArray], poses: NDArray) -> list[ShownPair]:
    """The pairs of the first of I photographs with each other one, from prepared images `[H, W, 3]` (uint8) and view
    poses `[I, 3]`, in the order of the files."""
    first, *others = (View(*each) for each in zip(files, images, poses, strict=True))
    return [ShownPair(f"{first.file.name} and {other.file.name}", "unlabelled", "", first, other) for other in others]


def named_pairs(
    data: PairDataModule, objects: Sequence[str], places: Sequence[tuple[int, int]], device: torch.device
) -> tuple[Pairs, list[ShownPair]]:
    """Pairs of test views (reference, query), numbered from 0 within their object; `UserError` if unknown."""
    table = data.table("test")
    chosen = []
    for name, pair in zip(objects, places, strict=True):
        views = table.views_of(object_index(data, name))
        for place, what in zip(pair, ("reference", "query"), strict=True):
            if not 0 <= place < len(views):
                raise UserError(f"object '{name}' has test views 0 to {len(views) - 1}; there is no {what} {place}")
        if pair[0] == pair[1]:
            raise UserError(f"reference and query must be two different views, got {pair[0]} for both")
        chosen.append([views[place] for place in pair])
    return shown_pairs(data.data("test"), np.array(chosen), device)


def object_index(data: PairDataModule, name: str) -> int:
    """The index of an object in the table of test views; `UserError` if the name is unknown."""
    names = data.table("test").names
    if name not in names:
        raise UserError(f"the data set has no object '{name}'{nearest(name, names)} (known: {', '.join(names)})")
    return names.index(name)


def truths(shown: Sequence[ShownPair]) -> Tensor:
    """The true relative poses `[P, 3]`, float32."""
    return torch.from_numpy(np.stack([pair.truth for pair in shown if pair.truth is not None])).float()


def solved_pairs(
    pairs: Pairs, shown: Sequence[ShownPair], solver: Solver, starts: Tensor, seed: int
) -> list[ShownPair]:
    """Solve all pairs at once from starts `[P, N, 3]`, and return them with the solutions and trajectories."""
    solution = recording(solver).solve(pairs, starts, seed)
    return [with_solution(pair, solution, starts, place) for place, pair in enumerate(shown)]


def with_solution(pair: ShownPair, solution: Solution, starts: Tensor, place: int) -> ShownPair:
    """The pair with the solution at index `place`; it gets no starts if the solver made its own candidates."""
    ends = _array(solution.poses[place])
    errors = np.full(len(ends), np.nan)
    if pair.truth is not None:
        reference = torch.from_numpy(pair.reference.pose)
        cameras = [
            camera_to_world(apply_relative_pose(reference, torch.from_numpy(pose).double()))
            for pose in (ends, pair.truth)
        ]
        errors = rotation_error(*cameras).numpy()
    return replace(
        pair,
        starts=_array(starts[place]) if solution.poses.shape == starts.shape else None,
        trajectories=None if solution.trajectory is None else _array(solution.trajectory[place]),
        ends=ends,
        energies=_array(solution.energies[place]),
        chosen=int(solution.chosen[place]),
        rotation_errors=errors,
        translation_errors=np.full(len(ends), np.nan),
    )


def recording(solver: Solver) -> Solver:
    """A copy of the solver and its nested solvers that keeps trajectories if there is a setting for it."""
    solver = copy.copy(solver)
    for name, part in vars(solver).items():
        if isinstance(part, Solver):
            vars(solver)[name] = recording(part)
    if isinstance(getattr(solver, "trajectory", None), bool):
        vars(solver)["trajectory"] = True
    return solver


def with_prior_energy(
    pairs: Pairs, shown: Sequence[ShownPair], prior: Prior, draws: fields.Draws, grid: Grid | None = None
) -> list[ShownPair]:
    """Add the prior's landscape, on the paper's grid by default, at the true relative radii (0 if unknown)."""
    found = fields.prior_landscapes(prior, pairs, _radii(shown), grid or landscape_grid(), draws)
    return _with_landscapes(shown, PRIOR_ENERGY, found)


def with_model_landscape(
    pairs: Pairs, shown: Sequence[ShownPair], model: PoseModel, sigma: float | None = None
) -> list[ShownPair]:
    """Add `model_landscapes` at the true relative radii (0 if unknown)."""
    name = "energy of the model" if model.has_energy else "length of the model's score"
    found = fields.model_landscapes(model, pairs, _radii(shown), landscape_grid(), sigma)
    return _with_landscapes(shown, name, found)


def _radii(shown: Sequence[ShownPair]) -> Tensor:
    return torch.tensor([0.0 if pair.truth is None else float(pair.truth[2]) for pair in shown])


def _with_landscapes(shown: Sequence[ShownPair], name: str, found: Sequence[Landscape]) -> list[ShownPair]:
    return [replace(pair, landscapes={**pair.landscapes, name: each}) for pair, each in zip(shown, found, strict=True)]


def with_fields(
    pairs: Pairs, shown: Sequence[ShownPair], model: PoseModel, solved: Sequence[ShownPair],
    first_stage: Langevin | None, starts: Tensor, seed: int,
) -> list[ShownPair]:  # fmt: skip
    """Add two maps to each pair, in one scale: the model's field, and the exact field, the target of training.

    The first shows the trajectories of the `solved` pairs. The second shows those of `first_stage`, if given, with the
    exact field in place of the model's.
    """
    exact = fields.ExactModel(model.kernel, truths(shown), model.has_energy)
    ideal: Sequence[ShownPair | None] = [None] * len(shown)
    if first_stage is not None:
        guided = copy.copy(first_stage)
        guided.model = exact  # type: ignore[assignment]  # has every part of a PoseModel that this solver uses
        guided.sigmas = None  # the exact field is defined at the model's sigma
        ideal = solved_pairs(pairs, shown, guided, starts, seed)
    name, radius = "exp(-E) and score" if model.has_energy else "score", truths(shown)[:, 2]
    maps = []
    for each, title, results in ((model, f"Learned {name}", solved), (exact, f"Exact {name} (oracle)", ideal)):
        densities: Sequence[Landscape | None] = [None] * len(shown)
        if each.has_energy:
            densities = [
                landscape.density() for landscape in fields.model_landscapes(each, pairs, radius, DENSITY_GRID)
            ]
        arrows = fields.model_arrows(each, pairs, radius, ARROW_SPACING)
        parts = zip(densities, arrows, results, strict=True)
        maps.append([PoseMap(f"{title}, at the true relative radius", None, *part) for part in parts])
    return [replace(pair, maps=in_one_scale(own)) for pair, *own in zip(shown, *maps, strict=True)]


def in_one_scale(maps: Sequence[PoseMap]) -> list[PoseMap]:
    """The maps, with all arrows scaled to the longest one."""
    scale = max(each.arrows.longest() for each in maps if each.arrows is not None)
    return [each._replace(arrows=each.arrows and each.arrows._replace(scale=scale)) for each in maps]


def explained_pair(
    pairs: Pairs, pair: ShownPair, solver: Solver, prior: Prior, model: PoseModel | None,
    starts: Tensor, draws: fields.Draws, grid: Grid,
) -> tuple[ShownPair, list[NDArray], FieldValue | None]:  # fmt: skip
    """Solve one pair. Returns it with only the starts that reached a finite pose; the prior's views at the ends,
    `[N, H, W, 3]`; and the model's field on the landscape's grid, if there is a model.

    The maps show the first stage without noise. Photographs have none, since their truth is unknown.
    """
    seed, field, views = draws.seed, None, []
    (pair,) = solved_pairs(pairs, with_prior_energy(pairs, [pair], prior, draws, grid), solver, starts, seed)
    pair = pair.finite()
    if pair.trajectories is not None:  # the same poses, with unwrapped longitudes
        pair = replace(pair, ends=pair.trajectories[:, -1])
    if len(pair.ends):
        source = prior.encode(pairs.images[pairs.reference])
        views = list(fields.generated_views(prior, source, torch.from_numpy(pair.ends), *SAMPLING, seed))
    if model is not None and pair.truth is not None:
        field = fields.model_field(model, pairs, truths([pair])[:, 2], grid)
        first_stage = Langevin(model, gamma=0.0)
        solved = solved_pairs(pairs, [pair], first_stage, starts, seed)
        (pair,) = with_fields(pairs, [pair], model, solved, first_stage, starts, seed)
    return pair, views, field


def _array(values: Tensor) -> NDArray:
    return values.detach().cpu().numpy()
