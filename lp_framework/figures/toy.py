"""The paper's Toy Example: what a prior, a score model and an energy model make of one pair of views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from matplotlib.figure import Figure

from lp_framework.analysis.fields import (
    ExactModel,
    arrows,
    grid_poses,
    model_arrows,
    model_landscapes,
    prior_field,
    prior_landscapes,
)
from lp_framework.analysis.landscapes import Landscape, PoseMap, cell_grid, landscape_grid
from lp_framework.analysis.pairs import named_pairs, truths
from lp_framework.analysis.shown import ShownPair, words
from lp_framework.data.module import PairDataModule
from lp_framework.figures.base import PaperFigure, checked_draws, energy_model, score_model
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.progress import shown_progress
from lp_framework.viz.panels import toy_figure

SPACING = 20.0  # degrees, of arrows


Contents = tuple[ShownPair, dict[str, Landscape]]


@register("figure", "toy")
class ToyFigure(PaperFigure[Contents]):
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
        self.draws = checked_draws(prior, timesteps, noises)
        self.data, self.prior = data, prior
        self.object, self.places = object, (reference, query)
        self.energy, self.score = energy_model(energy), score_model(score)

    def analyse(self, seed: int, device: torch.device) -> Contents:
        """A pair with four maps of score fields, and exp(-E) of both energies by title, at the true relative radius.

        The models' arrows are in the scale of the exact field.
        """
        pairs, shown = named_pairs(self.data, [self.object], [self.places], device)
        truth, draws = truths(shown), self.draws._replace(seed=seed)
        radius, grid, cells = truth[:, 2], landscape_grid(), cell_grid(SPACING)
        exact, score, energy = (
            model_arrows(model, pairs, radius, SPACING)[0]
            for model in (ExactModel(self.score.kernel, truth), self.score, self.energy)
        )
        poses = grid_poses(radius.to(device), *cells)
        with shown_progress():
            (landscape,) = prior_landscapes(self.prior, pairs, radius, grid, draws)
            (prior,) = arrows(cells, prior_field(self.prior, pairs, poses.flatten(1, 2), draws).score.view_as(poses))
        (learned,) = model_landscapes(self.energy, pairs, radius, grid)
        scale = exact.longest()
        maps = [
            PoseMap("exact score", arrows=exact),
            PoseMap("score model", arrows=score._replace(scale=scale)),
            PoseMap("prior, \u2212\u2207E", arrows=prior),
            PoseMap("energy model, \u2212\u2207E", arrows=energy._replace(scale=scale)),
        ]
        densities = {"prior, exp(\u2212E)": landscape.density(), "energy model, exp(\u2212E)": learned.density()}
        return replace(shown[0], maps=maps), densities

    def draw(self, contents: Contents) -> Figure:
        """See `viz.panels`."""
        return toy_figure(*contents)

    def caption(self, contents: Contents) -> str:
        """See `PaperFigure`."""
        return (
            f"(a) Reference and query, {words(self.object)}; (b) exact score field; (c) of the score model; (d) of the "
            "prior's energy, in a scale of its own; (e) of the energy model; (f) exp(-E) of the prior's energy and (g) "
            "of the energy model, both over their greatest. The star is the true relative pose; all at its radius. "
            f"Of the prior: {self.draws.in_words()}"
        )
