"""Score fields and densities of pairs: of the prior, of a score and of an energy model, and exact ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import torch
from matplotlib.figure import Figure

from lp_framework.analysis.fields import (
    ExactModel,
    arrows,
    field_error,
    grid_poses,
    model_arrows,
    model_landscapes,
    prior_field,
    prior_landscapes,
)
from lp_framework.analysis.landscapes import Arrows, Landscape, cell_grid, landscape_grid
from lp_framework.analysis.pairs import named_pairs, object_index, truths
from lp_framework.analysis.shown import PoseMap, ShownPair
from lp_framework.figures.base import EnergyFigure, PairsFigure, figure_model
from lp_framework.models.pose_model import PoseModel
from lp_framework.registry import register
from lp_framework.solvers.base import Pairs
from lp_framework.viz.panels import comparison_figure, toy_figure

SPACING = 20.0  # degrees, of arrows


def fields(score: PoseModel, energy: PoseModel, pairs: Pairs, shown: Sequence[ShownPair]) -> list[tuple[Arrows, ...]]:
    """A pair's exact field, and those of a score and an energy model in its scale, for each of the pairs."""
    truth = truths(shown)
    models = (ExactModel(score.kernel, truth), score, energy)
    found = zip(*(model_arrows(model, pairs, truth[:, 2], SPACING) for model in models), strict=True)
    return [tuple(each._replace(scale=exact.longest()) for each in (exact, *learned)) for exact, *learned in found]


@register("figure", "toy")
@dataclass
class ToyFigure(EnergyFigure):
    """The seven panels of the Toy Example: score fields and densities of one pair, exact, learned and of the prior.

    `score` and `energy` are training runs or checkpoints; None for the score model that ships.
    """

    object: str = "tram"
    score: str | None = None
    energy: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.energy_model, self.score_model = figure_model("energy", self.energy), figure_model("score", self.score)

    def analyse(self, seed: int, device: torch.device) -> tuple[ShownPair, dict[str, Landscape]]:
        """A pair with four maps of score fields, and exp(-E) of both energies by title, at the true relative radius."""
        pairs, (pair,) = self.pairs([self.object], device)
        radius, grid, cells = truths([pair])[:, 2], landscape_grid(), cell_grid(SPACING)
        ((exact, score, energy),) = fields(self.score_model, self.energy_model, pairs, [pair])
        poses, draws = grid_poses(radius.to(device), *cells), self.draws._replace(seed=seed)
        (landscape,) = prior_landscapes(self.prior, pairs, radius, grid, draws)
        (prior,) = arrows(cells, prior_field(self.prior, pairs, poses.flatten(1, 2), draws).score.view_as(poses))
        (learned,) = model_landscapes(self.energy_model, pairs, radius, grid)
        maps = [
            PoseMap("exact score", arrows=exact),
            PoseMap("score model", arrows=score),
            PoseMap("prior, \u2212\u2207E", arrows=prior),
            PoseMap("energy model, \u2212\u2207E", arrows=energy),
        ]
        densities = {"prior, exp(\u2212E)": landscape.density(), "energy model, exp(\u2212E)": learned.density()}
        return replace(pair, maps=maps), densities

    def draw(self, contents: tuple[ShownPair, dict[str, Landscape]]) -> tuple[Figure, str]:
        """See `PaperFigure`."""
        return toy_figure(*contents), (
            f"(a) Reference and query, {contents[0].title}; (b) exact score field; (c) of the score model; (d) of the "
            "prior's energy, in a scale of its own; (e) of the energy model; (f) exp(-E) of the prior's energy and (g) "
            "of the energy model, both over their greatest. The star is the true relative pose; all at its radius. "
            f"Of the prior: {self.draws.in_words()}"
        )


@register("figure", "score_vs_energy")
@dataclass
class ScoreVsEnergyFigure(PairsFigure):
    """Density and score field of an energy model beside the field of a score model, for a pair of each object.

    `score` and `energy` are training runs or checkpoints; None for the score model that ships.
    """

    objects: Sequence[str] = ("tram", "duck", "watering_can")
    score: str | None = None
    energy: str | None = None

    def __post_init__(self) -> None:
        self.energy_model, self.score_model = figure_model("energy", self.energy), figure_model("score", self.score)

    def analyse(self, seed: int, device: torch.device) -> list[ShownPair]:
        """Three maps a pair, at its true relative radius; nothing is drawn at random."""
        pairs, shown = self.pairs(self.objects, device)
        energies = model_landscapes(self.energy_model, pairs, truths(shown)[:, 2], landscape_grid())
        learned = fields(self.score_model, self.energy_model, pairs, shown)
        found = []
        for pair, landscape, (_, score, energy) in zip(shown, energies, learned, strict=True):
            off = [self._error(model, pair.object, device) for model in (self.energy_model, self.score_model)]
            maps = [
                PoseMap(f"error {error:.1%}", arrows=each) for error, each in zip(off, (energy, score), strict=True)
            ]
            found.append(replace(pair, maps=[PoseMap(density=landscape.density()), *maps]))
        return found

    def _error(self, model: PoseModel, name: str, device: torch.device) -> float:
        """A model's error over all ordered pairs of an object's test views."""
        count = len(self.data.table("test").objects[object_index(self.data, name)])
        places = list(permutations(range(count), 2))
        pairs, shown = named_pairs(self.data, [name] * len(places), places, device)
        return field_error(model, pairs, truths(shown), SPACING)

    def draw(self, contents: list[ShownPair]) -> tuple[Figure, str]:
        """See `PaperFigure`."""
        titles = ("energy model, exp(\u2212E)", "energy model, \u2212\u2207E", "score model")
        return comparison_figure(contents, titles), (
            "(a) Reference above query; (b) exp(-E) of the energy model over its greatest; (c) minus the gradient of "
            "its energy; (d) score of the score model, both in the scale of the exact field. The star is the true "
            "relative pose; all at its radius. Error: root mean square distance from the exact score over that of the "
            "score itself, at the arrows of all ordered pairs of the object's test views."
        )
