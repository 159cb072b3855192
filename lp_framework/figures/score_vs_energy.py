"""The fields of an energy and a score model beside each other (Comparison Between Score and Energy)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

import torch
from matplotlib.figure import Figure

from lp_framework.analysis.fields import ExactModel, field_error, model_arrows, model_landscapes
from lp_framework.analysis.landscapes import PoseMap, landscape_grid
from lp_framework.analysis.pairs import named_pairs, object_index, truths
from lp_framework.analysis.shown import ShownPair
from lp_framework.data.module import PairDataModule
from lp_framework.figures.base import PaperFigure, checked_objects, energy_model, score_model
from lp_framework.models.pose_model import PoseModel
from lp_framework.registry import register
from lp_framework.viz.panels import comparison_figure

SPACING = 20.0  # degrees, of arrows


@register("figure", "score_vs_energy")
class ScoreVsEnergyFigure(PaperFigure[list[ShownPair]]):
    """Density and score field of an energy model beside the field of a score model, for a pair of each object.

    The pairs are two test views, by number. `score` and `energy` are training runs or checkpoints; None for the score
    model that ships.
    """

    def __init__(
        self,
        data: PairDataModule,
        objects: Sequence[str] = ("tram", "duck", "watering_can"),
        reference: int = 0,
        query: int = 1,
        score: str | None = None,
        energy: str | None = None,
    ) -> None:
        self.data, self.objects, self.places = data, checked_objects(objects), [(reference, query)] * len(objects)
        self.energy, self.score = energy_model(energy), score_model(score)

    def analyse(self, seed: int, device: torch.device) -> list[ShownPair]:
        """Three maps a pair, at its true relative radius; nothing is drawn at random."""
        pairs, shown = named_pairs(self.data, self.objects, self.places, device)
        truth = truths(shown)
        radius = truth[:, 2]
        densities = [each.density() for each in model_landscapes(self.energy, pairs, radius, landscape_grid())]
        exact, *learned = (
            model_arrows(model, pairs, radius, SPACING)
            for model in (ExactModel(self.score.kernel, truth), self.energy, self.score)
        )
        found = []
        for number, pair in enumerate(shown):
            maps = [PoseMap(density=densities[number])]
            for model, arrows in zip((self.energy, self.score), learned, strict=True):
                own = arrows[number]._replace(scale=exact[number].longest())
                maps.append(PoseMap(f"error {self._error(model, pair.object, device):.1%}", arrows=own))
            found.append(replace(pair, maps=maps))
        return found

    def _error(self, model: PoseModel, name: str, device: torch.device) -> float:
        """A model's error over all ordered pairs of an object's test views."""
        count = len(self.data.table("test").objects[object_index(self.data, name)])
        places = list(permutations(range(count), 2))
        pairs, shown = named_pairs(self.data, [name] * len(places), places, device)
        return field_error(model, pairs, truths(shown), SPACING)

    def draw(self, contents: list[ShownPair]) -> Figure:
        """See `viz.panels`."""
        titles = ("energy model, exp(\u2212E)", "energy model, \u2212\u2207E", "score model")
        return comparison_figure(contents, titles)

    def caption(self, contents: list[ShownPair]) -> str:
        """See `PaperFigure`."""
        return (
            "(a) Reference above query; (b) exp(-E) of the energy model over its greatest; (c) minus the gradient of "
            "its energy; (d) score of the score model, both in the scale of the exact field. The star is the true "
            "relative pose; all at its radius. Error: root mean square distance from the exact score over that of the "
            "score itself, at the arrows of all ordered pairs of the object's test views."
        )
