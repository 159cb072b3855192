"""The prior's energy around several objects (Figure 1)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from matplotlib.figure import Figure

from lp_framework.analysis.landscapes import landscape_grid
from lp_framework.analysis.pairs import named_pairs, with_prior_energy
from lp_framework.analysis.shown import ShownPair
from lp_framework.data.module import PairDataModule
from lp_framework.figures.base import PaperFigure, checked_draws, checked_objects
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.progress import shown_progress
from lp_framework.viz.panels import surfaces_figure


@register("figure", "landscapes")
class LandscapesFigure(PaperFigure[list[ShownPair]]):
    """Reference, query and the surface of the prior's energy for some objects: one valley, a plateau, two valleys.

    The pairs are two test views, by number. The energy is the mean over `timesteps`, `noises` each, on the paper's grid
    of relative latitudes and longitudes at the true relative radius.
    """

    def __init__(
        self,
        data: PairDataModule,
        prior: Prior,
        objects: Sequence[str] = ("robot", "celadon_bottle", "tram"),
        reference: int = 0,
        query: int = 1,
        latitude_step_degrees: float = 8.0,
        longitude_step_degrees: float = 12.0,
        timesteps: Sequence[int] = (100, 300, 500, 700, 900),
        noises: int = 1,
    ) -> None:
        self.data, self.prior = data, prior
        self.objects, self.places = checked_objects(objects), [(reference, query)] * len(objects)
        self.grid = landscape_grid(60.0, latitude_step_degrees, longitude_step_degrees)
        self.draws = checked_draws(prior, timesteps, noises)

    def analyse(self, seed: int, device: torch.device) -> list[ShownPair]:
        """The landscapes of all pairs at once."""
        pairs, shown = named_pairs(self.data, self.objects, self.places, device)
        with shown_progress():
            return with_prior_energy(pairs, shown, self.prior, self.draws._replace(seed=seed), self.grid)

    def draw(self, contents: list[ShownPair]) -> Figure:
        """See `viz.panels`."""
        return surfaces_figure(contents)

    def caption(self, contents: list[ShownPair]) -> str:
        """See `PaperFigure`."""
        return (
            "The prior's denoising error over relative longitude and latitude, at the true relative radius, for a "
            f"reference (left) and a query (right) of {', '.join(pair.title for pair in contents)}; the line and the "
            f"star are at the true relative pose. A plateau has hardly any relief along the longitude. "
            f"{self.draws.in_words()}"
        )
