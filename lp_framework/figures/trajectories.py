"""iFusion from four longitudes on the landscape that it descends (Figure 2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lp_framework.data.module import PairDataModule
from lp_framework.errors import UserError
from lp_framework.evaluation.landscape import Landscape, landscape_grid, prior_landscapes
from lp_framework.figures.base import PaperFigure
from lp_framework.figures.generated import generated_views
from lp_framework.figures.settings import check_noises, noises_in_words
from lp_framework.figures.shown_pairs import shown_pairs, words
from lp_framework.geometry import apply_relative_pose, camera_to_world, rotation_error
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.ifusion import IFusion
from lp_framework.solvers.progress import shown_progress
from lp_framework.solvers.starts import Ring
from lp_framework.viz.landscape_panels import TrajectoryRow, trajectories_figure


class TrajectoryContents(NamedTuple):
    """The arguments of `trajectories_figure`."""

    reference: NDArray
    query: NDArray
    rows: list[TrajectoryRow]
    steps: list[int]
    landscape: Landscape
    trajectories: NDArray
    truth: NDArray
    chosen: int


@register("figure", "trajectories")
class TrajectoriesFigure(PaperFigure[TrajectoryContents]):
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
        check_noises(prior, timesteps, noises)
        if not 2 <= views <= 5:
            raise UserError(f"figure.views must be 2 to 5 generated views a trajectory, got {views}")
        self.data, self.prior = data, prior
        self.object, self.places = object, (reference, query)
        self.solver = IFusion(prior, steps=steps, trajectory=True)
        self.shown = [round(steps * (place / (views - 1)) ** 2) for place in range(views)]  # most happens at first
        self.sampling = (sampling_steps, guidance)
        self.timesteps, self.noises = list(timesteps), noises

    def gather(self, seed: int, device: torch.device) -> TrajectoryContents:
        """The pair is solved once, from all starts together."""
        shown = shown_pairs(self.data, [self.object], [self.places], device)
        latitude, longitude = landscape_grid()
        starts = Ring().make(shown.pairs, seed)
        with shown_progress():
            solution = self.solver.solve(shown.pairs, starts, seed)
            assert solution.trajectory is not None
            path = solution.trajectory[0].detach().cpu()  # [N, S, 3]
            energy = prior_landscapes(
                self.prior, shown.pairs, shown.truth[:, 2], latitude, longitude, self.timesteps, self.noises, seed
            )[0]
            with torch.no_grad():
                source = self.prior.encode(shown.pairs.images[shown.pairs.reference])
            images = generated_views(self.prior, source, path[:, self.shown].flatten(0, 1), *self.sampling, seed)
        ends = camera_to_world(apply_relative_pose(shown.poses[0, 0], path[:, -1].double()))
        errors = rotation_error(ends, camera_to_world(shown.poses[0, 1]).expand_as(ends))
        rows = [
            TrajectoryRow(f"{math.degrees(start[1]):.0f}°", f"{error:.0f}° off", views)
            for start, error, views in zip(
                starts[0].tolist(), errors.tolist(), images.reshape(len(path), -1, *images.shape[1:]), strict=True
            )
        ]
        reference, query = shown.images[0]
        return TrajectoryContents(
            reference, query, rows, self.shown,
            Landscape(latitude, longitude, shown.truth[0, 2].item(), energy.cpu()),
            path.numpy(), shown.truth[0].numpy(), int(solution.chosen[0]),
        )  # fmt: skip

    def draw(self, contents: TrajectoryContents) -> Figure:
        """See `viz.landscape_panels`."""
        return trajectories_figure(*contents)

    def caption(self, contents: TrajectoryContents) -> str:
        """See `PaperFigure`."""
        return (
            f"(a) Reference and (b) query, {words(self.object)}. (c) Views that the prior generates from the reference "
            "at poses on each trajectory of iFusion, by the longitude of its start and the rotation error of its end. "
            "(d) The trajectories over the prior's denoising error, from above and as a surface: starts are hollow, "
            "ends filled, the answer (least energy) is coloured, + are local minima, the star is the true relative "
            f"pose. {noises_in_words(self.timesteps, self.noises)}"
        )
