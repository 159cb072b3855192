"""The prior's energy around objects, trajectories over it, and its failures; fields and densities side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.analysis import fields
from lp_framework.analysis.landscapes import Arrows, Landscape, cell_grid, landscape_grid
from lp_framework.analysis.pairs import (
    PoseMap,
    ShownPair,
    named_pairs,
    object_index,
    solved_pairs,
    truths,
    with_prior_energy,
)
from lp_framework.data.sets.rendered import RenderedData
from lp_framework.errors import UserError
from lp_framework.figures.base import EnergyFigure, PairsFigure, figure_model
from lp_framework.geometry import apply_relative_pose, camera_to_world
from lp_framework.models.pose_model import PoseModel
from lp_framework.registry import register
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.twist import IFusion
from lp_framework.viz import maps

RESOLUTION = 256  # pixels per side of the views from a mesh


@register("figure", "landscapes")
@dataclass
class LandscapesFigure(EnergyFigure):
    """Reference, query and the surface of the prior's energy for objects with one minimum, a plateau and two minima."""

    objects: Sequence[str] = ("robot", "celadon_bottle", "tram")
    latitude_step_degrees: float = 8.0
    longitude_step_degrees: float = 12.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.grid = landscape_grid(60.0, self.latitude_step_degrees, self.longitude_step_degrees)

    def analyse(self, seed: int, device: torch.device) -> list[ShownPair]:
        """Compute the landscapes of all pairs at once."""
        pairs, shown = self.pairs(self.objects, device)
        return with_prior_energy(pairs, shown, self.prior, self.draws._replace(seed=seed), self.grid)

    def draw(self, contents: list[ShownPair]) -> tuple[Figure, str]:
        return maps.surfaces_figure(contents), (
            "Denoising error of the prior over relative longitude and latitude, at the true relative radius, for a "
            f"reference (left) and a query (right) of {', '.join(pair.title for pair in contents)}. The line and star "
            f"mark the true relative pose. On a plateau, the energy hardly depends on the longitude. "
            f"{self.draws.in_words()}"
        )


@register("figure", "trajectories")
@dataclass
class TrajectoriesFigure(EnergyFigure):
    """iFusion's trajectories from longitudes 0, 90, 180 and 270 over the prior's landscape, with generated views.

    Each trajectory has `views` generated views, from its start to its end, by `sampling_steps` of DDIM with `guidance`.
    iFusion takes `steps` steps.
    """

    object: str = "tram"
    steps: int = 100
    views: int = 4
    sampling_steps: int = 50
    guidance: float = 3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 2 <= self.views <= 5:
            raise UserError(f"figure.views must be 2 to 5 generated views per trajectory, got {self.views}")
        self.solver = IFusion(self.prior, steps=self.steps)
        shares = [place / (self.views - 1) for place in range(self.views)]
        self.shown_steps = [round(self.steps * share**2) for share in shares]  # most happens early on

    def analyse(self, seed: int, device: torch.device) -> tuple[ShownPair, NDArray]:
        """Solve the pair from all starts, and generate views `[N, K, H, W, 3]` at `shown_steps` of each trajectory."""
        pairs, shown = self.pairs([self.object], device)
        shown = solved_pairs(pairs, shown, self.solver, Ring().make(pairs, seed), seed)
        (pair,) = with_prior_energy(pairs, shown, self.prior, self.draws._replace(seed=seed))
        assert pair.trajectories is not None
        poses = torch.from_numpy(pair.trajectories[:, self.shown_steps])  # [N, K, 3]
        with torch.no_grad():
            source = self.prior.encode(pairs.images[pairs.reference])
        sampling = (self.sampling_steps, self.guidance, seed)
        views = fields.generated_views(self.prior, source, poses.flatten(0, 1), *sampling)
        return pair, views.reshape(*poses.shape[:2], *views.shape[1:])

    def draw(self, contents: tuple[ShownPair, NDArray]) -> tuple[Figure, str]:
        return maps.trajectories_figure(*contents, self.shown_steps), (
            f"(a) Reference and (b) query, {contents[0].title}. (c) Views that the prior generates from the reference "
            "along each iFusion trajectory, labelled by start longitude and final rotation error. (d) Trajectories on "
            "the prior's denoising error, as a map and as a surface. Hollow circles: starts; filled circles: final "
            "poses; coloured: the answer (lowest energy); +: local minima; star: true relative pose. "
            f"{self.draws.in_words()}"
        )


@register("figure", "failures")
@dataclass
class FailuresFigure(EnergyFigure):
    """Views around ambiguous objects, from the mesh (if the data have one) and by the prior, beside the landscape.

    Shows `views` evenly spaced longitudes, starting with the reference's, by `sampling_steps` of DDIM with `guidance`.
    """

    objects: Sequence[str] = ("lotus_vase", "soup_can")
    views: int = 6
    sampling_steps: int = 50
    guidance: float = 3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 2 <= self.views <= 12:
            raise UserError(f"figure.views must be 2 to 12 around the object, got {self.views}")

    def analyse(self, seed: int, device: torch.device) -> list[maps.FailureRow]:
        """Compute the landscapes of all pairs at once, the views one object at a time."""
        pairs, shown = self.pairs(self.objects, device)
        around = torch.zeros(self.views, 3)
        around[:, 1] = torch.arange(self.views) * (2 * math.pi / self.views)
        shown = with_prior_energy(pairs, shown, self.prior, self.draws._replace(seed=seed))
        with torch.no_grad():
            codes = self.prior.encode(pairs.images)[pairs.reference]
        rows = []
        for number, pair in enumerate(shown):
            poses = apply_relative_pose(torch.from_numpy(pair.reference.pose), around.double())
            code, sampling = codes[number : number + 1], (self.sampling_steps, self.guidance, seed)
            generated = fields.generated_views(self.prior, code, around, *sampling)
            rows.append(maps.FailureRow(pair, self.rendered(pair, poses), generated))
        return rows

    def rendered(self, pair: ShownPair, poses: Tensor) -> NDArray | None:
        """Render views `[K, H, W, 3]` in [0, 1] of a pair's object at view poses `[K, 3]`, with the reference's field
        of view; None if there is no mesh."""
        source = self.data.source
        if not isinstance(source, RenderedData):
            return None
        scene = next(each for each in source.objects() if each.name == pair.object).load()
        degrees = math.degrees(pair.reference.field_of_view)
        views = source.renderer.render(scene, camera_to_world(poses), RESOLUTION, degrees) / 255
        alpha = views[..., 3:]
        return np.asarray(views[..., :3] * alpha + 1 - alpha)

    def draw(self, contents: list[maps.FailureRow]) -> tuple[Figure, str]:
        mesh = "rendered from the mesh (top) and " if contents[0].rendered is not None else ""
        return maps.failures_figure(contents), (
            "(a) Reference above query. (b) Views around the object at the given longitudes relative to the reference, "
            f"{mesh}generated by the prior from the reference. (c) Denoising error of the prior over relative "
            "longitude and latitude (dark: low). +: local minima; star: true relative pose. "
            f"{self.draws.in_words()}"
        )


SPACING = 20.0  # degrees, of arrows


def three_fields(
    score: PoseModel, energy: PoseModel, pairs: Pairs, shown: Sequence[ShownPair]
) -> list[tuple[Arrows, ...]]:
    """For each pair, the exact field and those of a score and an energy model, scaled to the exact one."""
    truth = truths(shown)
    models = (fields.ExactModel(score.kernel, truth), score, energy)
    found = zip(*(fields.model_arrows(model, pairs, truth[:, 2], SPACING) for model in models), strict=True)
    return [tuple(each._replace(scale=exact.longest()) for each in (exact, *learned)) for exact, *learned in found]


@register("figure", "toy")
@dataclass
class ToyFigure(EnergyFigure):
    """The seven panels of the Toy Example: exact, learned and prior score fields and densities of one pair.

    `score` and `energy` are training runs or checkpoints; None for the bundled score model.
    """

    object: str = "tram"
    score: str | None = None
    energy: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.energy_model, self.score_model = figure_model("energy", self.energy), figure_model("score", self.score)

    def analyse(self, seed: int, device: torch.device) -> tuple[ShownPair, dict[str, Landscape]]:
        """The pair with four maps of score fields, and exp(-E) of both energies by title, at the true radius."""
        pairs, (pair,) = self.pairs([self.object], device)
        radius, grid, cells = truths([pair])[:, 2], landscape_grid(), cell_grid(SPACING)
        ((exact, score, energy),) = three_fields(self.score_model, self.energy_model, pairs, [pair])
        poses, draws = fields.grid_poses(radius.to(device), *cells), self.draws._replace(seed=seed)
        (landscape,) = fields.prior_landscapes(self.prior, pairs, radius, grid, draws)
        (prior,) = fields.arrows(
            cells, fields.prior_field(self.prior, pairs, poses.flatten(1, 2), draws).score.view_as(poses)
        )
        (learned,) = fields.model_landscapes(self.energy_model, pairs, radius, grid)
        drawn = [
            PoseMap("exact score", arrows=exact),
            PoseMap("score model", arrows=score),
            PoseMap("prior, \u2212\u2207E", arrows=prior),
            PoseMap("energy model, \u2212\u2207E", arrows=energy),
        ]
        densities = {"prior, exp(\u2212E)": landscape.density(), "energy model, exp(\u2212E)": learned.density()}
        return replace(pair, maps=drawn), densities

    def draw(self, contents: tuple[ShownPair, dict[str, Landscape]]) -> tuple[Figure, str]:
        return maps.toy_figure(*contents), (
            f"(a) Reference and query, {contents[0].title}. Score fields: (b) exact, (c) score model, (d) prior (own "
            "scale), (e) energy model. Densities exp(-E), normalised to a maximum of 1: (f) prior, (g) energy model. "
            "All are at the true relative radius; the star marks the true relative pose. "
            f"Prior: {self.draws.in_words()}"
        )


@register("figure", "score_vs_energy")
@dataclass
class ScoreVsEnergyFigure(PairsFigure):
    """Density and score field of an energy model beside the field of a score model, for one pair per object.

    `score` and `energy` are training runs or checkpoints; None for the bundled score model.
    """

    objects: Sequence[str] = ("tram", "duck", "watering_can")
    score: str | None = None
    energy: str | None = None

    def __post_init__(self) -> None:
        self.energy_model, self.score_model = figure_model("energy", self.energy), figure_model("score", self.score)

    def analyse(self, seed: int, device: torch.device) -> list[ShownPair]:
        """Compute three maps per pair, at its true relative radius; deterministic."""
        pairs, shown = self.pairs(self.objects, device)
        energies = fields.model_landscapes(self.energy_model, pairs, truths(shown)[:, 2], landscape_grid())
        learned = three_fields(self.score_model, self.energy_model, pairs, shown)
        found = []
        for pair, landscape, (_, score, energy) in zip(shown, energies, learned, strict=True):
            off = [self._error(model, pair.object, device) for model in (self.energy_model, self.score_model)]
            drawn = [
                PoseMap(f"error {error:.1%}", arrows=each) for error, each in zip(off, (energy, score), strict=True)
            ]
            found.append(replace(pair, maps=[PoseMap(density=landscape.density()), *drawn]))
        return found

    def _error(self, model: PoseModel, name: str, device: torch.device) -> float:
        """A model's error over all ordered pairs of an object's test views."""
        count = len(self.data.table("test").objects[object_index(self.data, name)])
        places = list(permutations(range(count), 2))
        pairs, shown = named_pairs(self.data, [name] * len(places), places, device)
        return fields.field_error(model, pairs, truths(shown), SPACING)

    def draw(self, contents: list[ShownPair]) -> tuple[Figure, str]:
        titles = ("energy model, exp(\u2212E)", "energy model, \u2212\u2207E", "score model")
        return maps.comparison_figure(contents, titles), (
            "(a) Reference above query. (b) Density exp(-E) of the energy model, normalised to a maximum of 1. (c) "
            "Negative energy gradient and (d) score of the score model, both on the scale of the exact field. All are "
            "at the true relative radius; the star marks the true relative pose. Error: RMS distance to the exact "
            "score relative to the RMS exact score, over all ordered pairs of the object's test views."
        )
