"""The paper's Toy Example: what a prior, a score model and an energy model make of one pair of views."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.data.module import PairDataModule
from lp_framework.evaluation.landscape import Landscape, landscape_grid, model_landscape, prior_landscapes
from lp_framework.figures.base import PaperFigure
from lp_framework.figures.model_fields import SPACING, density, model_grid
from lp_framework.figures.models import energy_model, score_model
from lp_framework.figures.prior_field import prior_field
from lp_framework.figures.settings import check_noises, noises_in_words
from lp_framework.figures.shown_pairs import shown_pairs, words
from lp_framework.models.pose_model import FieldValue
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.progress import shown_progress
from lp_framework.viz.fields import Grid, field_on_grid, longest
from lp_framework.viz.pictures import ExactModel
from lp_framework.viz.score_panels import DensityPanel, FieldPanel, toy_figure


class ToyContents(NamedTuple):
    """A pair: its images `[H, W, 3]`, the true relative pose `[3]`, fields by name, and exp(-E) of both energies."""

    reference: NDArray
    query: NDArray
    truth: NDArray
    exact: Grid
    score: Grid
    prior: Grid
    energy: Grid
    prior_density: Landscape
    energy_density: Landscape


@register("figure", "toy")
class ToyFigure(PaperFigure[ToyContents]):
    """The seven panels of the Toy Example: score fields and densities of one pair, exact, learned and of the prior.

    The pair are two test views of `object`, by number. `score` and `energy` are training runs or checkpoints; None
    for the score model that ships. The prior's energy is the mean over `timesteps`, `noises` each.
    """

    def __init__(
        self,
        data: PairDataModule,
        prior: Prior,
        object: str = "tram",
        reference: int = 0,
        query: int = 1,
        timesteps: Sequence[int] = (100, 300, 500, 700, 900),
        noises: int = 1,
        score: str | None = None,
        energy: str | None = None,
    ) -> None:
        check_noises(prior, timesteps, noises)
        self.data, self.prior = data, prior
        self.object, self.places = object, (reference, query)
        self.timesteps, self.noises = list(timesteps), noises
        self.energy, self.score = energy_model(energy), score_model(score)

    def gather(self, seed: int, device: torch.device) -> ToyContents:
        """Fields on a grid of arrows, densities on the paper's grid; all at the true relative radius."""
        shown = shown_pairs(self.data, [self.object], [self.places], device)
        truth = shown.truth[0]
        latitude, longitude = landscape_grid()
        draws = (self.timesteps, self.noises, seed)

        def of_prior(poses: Tensor) -> FieldValue:
            field = prior_field(self.prior, shown.pairs, poses.to(device).flatten(0, 1)[None], *draws)
            return FieldValue(field.score.view(poses.shape), None)

        exact = ExactModel(self.score.kernel, truth)
        with shown_progress():
            prior = prior_landscapes(self.prior, shown.pairs, shown.truth[:, 2], latitude, longitude, *draws)[0]
            learned = model_landscape(self.energy, shown.pairs, shown.truth[:, 2], latitude, longitude).energy
            assert learned is not None
            return ToyContents(
                shown.images[0, 0],
                shown.images[0, 1],
                truth.numpy(),
                model_grid(exact, shown.pairs, truth),
                model_grid(self.score, shown.pairs, truth),
                field_on_grid(of_prior, float(truth[2]), SPACING),
                model_grid(self.energy, shown.pairs, truth),
                *(density(each, latitude, longitude, truth) for each in (prior, learned[0])),
            )

    def draw(self, contents: ToyContents) -> Figure:
        """See `viz.score_panels`. The models' fields and the exact one share a scale, the prior's has its own."""
        scale = longest(contents.exact)
        fields = [
            FieldPanel("exact score", contents.exact, scale),
            FieldPanel("score model", contents.score, scale),
            FieldPanel("prior, \u2212\u2207E", contents.prior),
            FieldPanel("energy model, \u2212\u2207E", contents.energy, scale),
        ]
        densities = [
            DensityPanel("prior, exp(\u2212E)", contents.prior_density),
            DensityPanel("energy model, exp(\u2212E)", contents.energy_density),
        ]
        return toy_figure(contents.reference, contents.query, contents.truth, fields, densities)

    def caption(self, contents: ToyContents) -> str:
        """See `PaperFigure`."""
        return (
            f"(a) Reference and query, {words(self.object)}; (b) exact score field; (c) of the score model; (d) of the "
            "prior's energy, in a scale of its own; (e) of the energy model; (f) exp(-E) of the prior's energy and (g) "
            "of the energy model, both over their greatest. The star is the true relative pose; all at its radius. "
            f"Of the prior: {noises_in_words(self.timesteps, self.noises)}"
        )
