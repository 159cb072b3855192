"""Views around ambiguous objects beside their landscapes (Failure Case Analysis)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.data.module import PairDataModule
from lp_framework.data.sources import RenderedData
from lp_framework.errors import UserError
from lp_framework.evaluation.landscape import Landscape, landscape_grid, prior_landscapes
from lp_framework.figures.base import PaperFigure
from lp_framework.figures.generated import generated_views
from lp_framework.figures.settings import check_noises, noises_in_words
from lp_framework.figures.shown_pairs import object_index, shown_pairs, words
from lp_framework.geometry import apply_relative_pose, camera_to_world
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.progress import shown_progress
from lp_framework.viz.landscape_panels import FailureRow, failures_figure

RESOLUTION = 256  # pixels a side of the views from a mesh


class FailureContents(NamedTuple):
    """A row a pair, and the longitudes of the views around, relative to the reference (degrees)."""

    rows: list[FailureRow]
    longitudes_degrees: list[float]


@register("figure", "failures")
class FailuresFigure(PaperFigure[FailureContents]):
    """Views around ambiguous objects, from the mesh (where the data have one) and by the prior, beside the landscape.

    The pairs are two test views, by number; `views` longitudes evenly around, the first is the reference's own, by
    `sampling_steps` of DDIM at a `guidance`. The landscape's energy is the mean over `timesteps`, `noises` each.
    """

    def __init__(
        self,
        data: PairDataModule,
        prior: Prior,
        objects: Sequence[str] = ("lotus_vase", "soup_can"),
        reference: int = 0,
        query: int = 1,
        views: int = 6,
        sampling_steps: int = 50,
        guidance: float = 3.0,
        timesteps: Sequence[int] = (100, 300, 500, 700, 900),
        noises: int = 1,
    ) -> None:
        check_noises(prior, timesteps, noises)
        if not objects or not 2 <= views <= 12:
            raise UserError(f"figure.objects needs a name, and figure.views must be 2 to 12 around it, got {views}")
        self.data, self.prior, self.objects, self.places = data, prior, list(objects), (reference, query)
        self.views, self.sampling = views, (sampling_steps, guidance)
        self.timesteps, self.noises = list(timesteps), noises

    def gather(self, seed: int, device: torch.device) -> FailureContents:
        """The landscapes of all pairs at once, the views an object after the other."""
        shown = shown_pairs(self.data, self.objects, [self.places] * len(self.objects), device)
        grid, radius = landscape_grid(), shown.truth[:, 2]
        around = torch.zeros(self.views, 3)
        around[:, 1] = torch.arange(self.views) * (2 * math.pi / self.views)
        rows = []
        with shown_progress():
            energies = prior_landscapes(self.prior, shown.pairs, radius, *grid, self.timesteps, self.noises, seed)
            with torch.no_grad():
                codes = self.prior.encode(shown.pairs.images)[shown.pairs.reference]
            for number, name in enumerate(self.objects):
                code = codes[number : number + 1]
                reference, query = shown.images[number]
                rows.append(
                    FailureRow(
                        words(name), reference, query,
                        self.rendered(name, apply_relative_pose(shown.poses[number, 0], around.double())),
                        generated_views(self.prior, code, around, *self.sampling, seed),
                        Landscape(*grid, radius[number].item(), energies[number].cpu()), shown.truth[number].numpy(),
                    )
                )  # fmt: skip
        return FailureContents(rows, [360 * place / self.views for place in range(self.views)])

    def rendered(self, name: str, poses: Tensor) -> NDArray | None:
        """Views `[K, H, W, 3]` in [0, 1] of an object's mesh from view poses `[K, 3]`; None where there is no mesh."""
        if not isinstance(self.data, RenderedData):
            return None
        scene = next(each for each in self.data.objects() if each.name == name).load()
        field_of_view = self.data.table("test").objects[object_index(self.data, name)].field_of_view
        views = self.data.renderer.render(scene, camera_to_world(poses), RESOLUTION, math.degrees(field_of_view)) / 255
        alpha = views[..., 3:]
        return np.asarray(views[..., :3] * alpha + 1 - alpha)

    def draw(self, contents: FailureContents) -> Figure:
        """See `viz.landscape_panels`."""
        return failures_figure(*contents)

    def caption(self, contents: FailureContents) -> str:
        """See `PaperFigure`."""
        mesh = "rendered from the mesh (top) and " if contents.rows[0].rendered is not None else ""
        return (
            "(a) Reference above query. (b) Views turned around the object by the given longitudes from the reference, "
            f"{mesh}generated by the prior from the reference. (c) The prior's denoising error over relative longitude "
            "and latitude, dark where it is low; + are local minima, the star is the true relative pose. "
            f"{noises_in_words(self.timesteps, self.noises)}"
        )
