"""The fields of an energy and a score model beside each other (Comparison Between Score and Energy)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import torch
from matplotlib.figure import Figure

from lp_framework.data.module import PairDataModule
from lp_framework.errors import UserError
from lp_framework.evaluation.landscape import landscape_grid, model_landscape
from lp_framework.figures.base import PaperFigure
from lp_framework.figures.model_fields import density, field_error, model_grid
from lp_framework.figures.models import energy_model, score_model
from lp_framework.figures.shown_pairs import ShownPairs, object_index, shown_pairs, words
from lp_framework.registry import register
from lp_framework.viz.fields import longest
from lp_framework.viz.pictures import ExactModel
from lp_framework.viz.score_panels import ComparisonRow, FieldPanel, comparison_figure


@register("figure", "score_vs_energy")
class ScoreVsEnergyFigure(PaperFigure[list[ComparisonRow]]):
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
        if not objects:
            raise UserError("figure.objects needs the name of an object")
        self.data, self.objects, self.places = data, list(objects), (reference, query)
        self.energy, self.score = energy_model(energy), score_model(score)

    def gather(self, seed: int, device: torch.device) -> list[ComparisonRow]:
        """All at the pairs' true relative radii; nothing is drawn at random."""
        shown = shown_pairs(self.data, self.objects, [self.places] * len(self.objects), device)
        latitude, longitude = landscape_grid()
        energies = model_landscape(self.energy, shown.pairs, shown.truth[:, 2], latitude, longitude).energy
        assert energies is not None
        rows = []
        for number, name in enumerate(self.objects):
            truth = shown.truth[number]
            exact = model_grid(ExactModel(self.score.kernel, truth), shown.pairs, truth)
            all_pairs = self._all_pairs(name, device)
            panels = [
                FieldPanel(
                    f"error {field_error(model, all_pairs.pairs, all_pairs.truth):.1%}",
                    model_grid(model, shown.pairs, truth, number),
                    longest(exact),
                )
                for model in (self.energy, self.score)
            ]
            reference, query = shown.images[number]
            rows.append(
                ComparisonRow(
                    words(name), reference, query, truth.numpy(),
                    density(energies[number], latitude, longitude, truth), *panels,
                )
            )  # fmt: skip
        return rows

    def _all_pairs(self, name: str, device: torch.device) -> ShownPairs:
        """All ordered pairs of an object's test views."""
        places = list(permutations(range(len(self.data.table("test").views_of(object_index(self.data, name)))), 2))
        return shown_pairs(self.data, [name] * len(places), places, device)

    def draw(self, contents: list[ComparisonRow]) -> Figure:
        """See `viz.score_panels`."""
        return comparison_figure(contents)

    def caption(self, contents: list[ComparisonRow]) -> str:
        """See `PaperFigure`."""
        return (
            "(a) Reference above query; (b) exp(-E) of the energy model over its greatest; (c) minus the gradient of "
            "its energy; (d) score of the score model, both in the scale of the exact field. The star is the true "
            "relative pose; all at its radius. Error: root mean square distance from the exact score over that of the "
            "score itself, at the arrows of all ordered pairs of the object's test views."
        )
