"""The prior's energy around several objects (Figure 1)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from matplotlib.figure import Figure

from lp_framework.data.module import PairDataModule
from lp_framework.errors import UserError
from lp_framework.evaluation.landscape import FLAT, Landscape, landscape_grid, prior_landscapes
from lp_framework.figures.base import PaperFigure
from lp_framework.figures.settings import check_noises, noises_in_words
from lp_framework.figures.shown_pairs import shown_pairs, words
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.progress import shown_progress
from lp_framework.viz.landscape_panels import SurfacePanel, surfaces_figure


@register("figure", "landscapes")
class LandscapesFigure(PaperFigure[list[SurfacePanel]]):
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
        if not objects:
            raise UserError("figure.objects needs the name of an object")
        check_noises(prior, timesteps, noises)
        self.data, self.prior, self.objects, self.places = data, prior, list(objects), (reference, query)
        self.latitude, self.longitude = landscape_grid(60.0, latitude_step_degrees, longitude_step_degrees)
        self.timesteps, self.noises = list(timesteps), noises

    def gather(self, seed: int, device: torch.device) -> list[SurfacePanel]:
        """The landscapes of all pairs at once."""
        shown = shown_pairs(self.data, self.objects, [self.places] * len(self.objects), device)
        grid, radius = (self.latitude, self.longitude), shown.truth[:, 2]
        with shown_progress():
            energies = prior_landscapes(self.prior, shown.pairs, radius, *grid, self.timesteps, self.noises, seed)
        panels = []
        for number, name in enumerate(self.objects):
            landscape = Landscape(*grid, radius[number].item(), energies[number].cpu())
            count = len(landscape.minima())
            word = f"{count} minim{'um' if count == 1 else 'a'}"
            if landscape.flatness() >= FLAT:
                word = "plateau"
            reference, query = shown.images[number]
            panels.append(SurfacePanel(words(name), word, reference, query, landscape, shown.truth[number].numpy()))
        return panels

    def draw(self, contents: list[SurfacePanel]) -> Figure:
        """See `viz.landscape_panels`."""
        return surfaces_figure(contents)

    def caption(self, contents: list[SurfacePanel]) -> str:
        """See `PaperFigure`."""
        return (
            "The prior's denoising error over relative longitude and latitude, at the true relative radius, for a "
            f"reference (left) and a query (right) of {', '.join(panel.title for panel in contents)}; the line and the "
            f"star are at the true relative pose. A plateau has hardly any relief along the longitude. "
            f"{noises_in_words(self.timesteps, self.noises)}"
        )
