"""iFusion from four longitudes on the landscape that it descends (Figure 2)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lp_framework.analysis.generated import generated_views
from lp_framework.analysis.pairs import named_pairs, solved_pairs, with_prior_energy
from lp_framework.analysis.shown import ShownPair, words
from lp_framework.data.module import PairDataModule
from lp_framework.errors import UserError
from lp_framework.figures.base import PaperFigure, checked_draws
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.ifusion import IFusion
from lp_framework.solvers.progress import shown_progress
from lp_framework.solvers.starts import Ring
from lp_framework.viz.panels import trajectories_figure


@register("figure", "trajectories")
class TrajectoriesFigure(PaperFigure[tuple[ShownPair, NDArray]]):
    """iFusion's ways from longitudes 0, 90, 180 and 270 over the prior's landscape, and views generated on them.

    The pair are two test views of `object`, by number. Each way has `views` generated views, the first at its start and
    the last at its end, by `sampling_steps` of DDIM at a `guidance`; iFusion takes `steps`. The landscape's energy is
    the mean over `timesteps`, `noises` each.
    """

    def __init__(
        self,
        data: PairDataModule,
        prior: Prior,
        object: str = "tram",
        reference: int = 0,
        query: int = 1,
        steps: int = 100,
        views: int = 4,
        sampling_steps: int = 50,
        guidance: float = 3.0,
        timesteps: Sequence[int] = (100, 300, 500, 700, 900),
        noises: int = 1,
    ) -> None:
        self.draws = checked_draws(prior, timesteps, noises)
        if not 2 <= views <= 5:
            raise UserError(f"figure.views must be 2 to 5 generated views a trajectory, got {views}")
        self.data, self.prior = data, prior
        self.object, self.places = object, (reference, query)
        self.solver = IFusion(prior, steps=steps)
        self.steps = [round(steps * (place / (views - 1)) ** 2) for place in range(views)]  # most happens at first
        self.sampling = (sampling_steps, guidance)

    def analyse(self, seed: int, device: torch.device) -> tuple[ShownPair, NDArray]:
        """The pair, solved once from all starts, and views `[N, K, H, W, 3]` at `steps` of each trajectory."""
        pairs, shown = named_pairs(self.data, [self.object], [self.places], device)
        with shown_progress():
            shown = solved_pairs(pairs, shown, self.solver, Ring().make(pairs, seed), seed)
            (pair,) = with_prior_energy(pairs, shown, self.prior, self.draws._replace(seed=seed))
            assert pair.trajectories is not None
            poses = torch.from_numpy(pair.trajectories[:, self.steps])  # [N, K, 3]
            with torch.no_grad():
                source = self.prior.encode(pairs.images[pairs.reference])
            views = generated_views(self.prior, source, poses.flatten(0, 1), *self.sampling, seed)
        return pair, views.reshape(*poses.shape[:2], *views.shape[1:])

    def draw(self, contents: tuple[ShownPair, NDArray]) -> Figure:
        """See `viz.panels`."""
        return trajectories_figure(*contents, self.steps)

    def caption(self, contents: tuple[ShownPair, NDArray]) -> str:
        """See `PaperFigure`."""
        return (
            f"(a) Reference and (b) query, {words(self.object)}. (c) Views that the prior generates from the reference "
            "at poses on each trajectory of iFusion, by the longitude of its start and the rotation error of its end. "
            "(d) The trajectories over the prior's denoising error, from above and as a surface: starts are hollow, "
            "ends filled, the answer (least energy) is coloured, + are local minima, the star is the true relative "
            f"pose. {self.draws.in_words()}"
        )
