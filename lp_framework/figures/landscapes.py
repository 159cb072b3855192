"""The prior's energy around objects (Figure 1), ways over it (Figure 2), and what it cannot tell (Failure Cases)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.analysis.fields import generated_views
from lp_framework.analysis.landscapes import landscape_grid
from lp_framework.analysis.pairs import object_index, solved_pairs, with_prior_energy
from lp_framework.analysis.shown import ShownPair
from lp_framework.data.sets.rendered import RenderedData
from lp_framework.errors import UserError
from lp_framework.figures.base import EnergyFigure
from lp_framework.geometry import apply_relative_pose, camera_to_world
from lp_framework.registry import register
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.twist import IFusion
from lp_framework.viz.panels import FailureRow, failures_figure, surfaces_figure, trajectories_figure

RESOLUTION = 256  # pixels a side of the views from a mesh


@register("figure", "landscapes")
@dataclass
class LandscapesFigure(EnergyFigure):
    """Reference, query and the surface of the prior's energy for some objects: one valley, a plateau, two valleys."""

    objects: Sequence[str] = ("robot", "celadon_bottle", "tram")
    latitude_step_degrees: float = 8.0
    longitude_step_degrees: float = 12.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.grid = landscape_grid(60.0, self.latitude_step_degrees, self.longitude_step_degrees)

    def analyse(self, seed: int, device: torch.device) -> list[ShownPair]:
        """The landscapes of all pairs at once."""
        pairs, shown = self.pairs(self.objects, device)
        return with_prior_energy(pairs, shown, self.prior, self.draws._replace(seed=seed), self.grid)

    def draw(self, contents: list[ShownPair]) -> tuple[Figure, str]:
        """See `PaperFigure`."""
        return surfaces_figure(contents), (
            "The prior's denoising error over relative longitude and latitude, at the true relative radius, for a "
            f"reference (left) and a query (right) of {', '.join(pair.title for pair in contents)}; the line and the "
            f"star are at the true relative pose. A plateau has hardly any relief along the longitude. "
            f"{self.draws.in_words()}"
        )


@register("figure", "trajectories")
@dataclass
class TrajectoriesFigure(EnergyFigure):
    """iFusion's ways from longitudes 0, 90, 180 and 270 over the prior's landscape, and views generated on them.

    Each way has `views` generated views, the first at its start and the last at its end, by `sampling_steps` of DDIM at
    a `guidance`; iFusion takes `steps`.
    """

    object: str = "tram"
    steps: int = 100
    views: int = 4
    sampling_steps: int = 50
    guidance: float = 3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 2 <= self.views <= 5:
            raise UserError(f"figure.views must be 2 to 5 generated views a trajectory, got {self.views}")
        self.solver = IFusion(self.prior, steps=self.steps)
        shares = [place / (self.views - 1) for place in range(self.views)]
        self.shown_steps = [round(self.steps * share**2) for share in shares]  # most happens at first

    def analyse(self, seed: int, device: torch.device) -> tuple[ShownPair, NDArray]:
        """The pair, solved once from all starts, and views `[N, K, H, W, 3]` at `shown_steps` of each trajectory."""
        pairs, shown = self.pairs([self.object], device)
        shown = solved_pairs(pairs, shown, self.solver, Ring().make(pairs, seed), seed)
        (pair,) = with_prior_energy(pairs, shown, self.prior, self.draws._replace(seed=seed))
        assert pair.trajectories is not None
        poses = torch.from_numpy(pair.trajectories[:, self.shown_steps])  # [N, K, 3]
        with torch.no_grad():
            source = self.prior.encode(pairs.images[pairs.reference])
        sampling = (self.sampling_steps, self.guidance, seed)
        views = generated_views(self.prior, source, poses.flatten(0, 1), *sampling)
        return pair, views.reshape(*poses.shape[:2], *views.shape[1:])

    def draw(self, contents: tuple[ShownPair, NDArray]) -> tuple[Figure, str]:
        """See `PaperFigure`."""
        return trajectories_figure(*contents, self.shown_steps), (
            f"(a) Reference and (b) query, {contents[0].title}. (c) Views that the prior generates from the reference "
            "at poses on each trajectory of iFusion, by the longitude of its start and the rotation error of its end. "
            "(d) The trajectories over the prior's denoising error, from above and as a surface: starts are hollow, "
            "ends filled, the answer (least energy) is coloured, + are local minima, the star is the true relative "
            f"pose. {self.draws.in_words()}"
        )


@register("figure", "failures")
@dataclass
class FailuresFigure(EnergyFigure):
    """Views around ambiguous objects, from the mesh (where the data have one) and by the prior, beside the landscape.

    `views` longitudes evenly around, the first is the reference's own, by `sampling_steps` of DDIM at a `guidance`.
    """

    objects: Sequence[str] = ("lotus_vase", "soup_can")
    views: int = 6
    sampling_steps: int = 50
    guidance: float = 3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 2 <= self.views <= 12:
            raise UserError(f"figure.views must be 2 to 12 around the object, got {self.views}")

    def analyse(self, seed: int, device: torch.device) -> list[FailureRow]:
        """The landscapes of all pairs at once, the views an object after the other."""
        pairs, shown = self.pairs(self.objects, device)
        around = torch.zeros(self.views, 3)
        around[:, 1] = torch.arange(self.views) * (2 * math.pi / self.views)
        shown = with_prior_energy(pairs, shown, self.prior, self.draws._replace(seed=seed))
        with torch.no_grad():
            codes = self.prior.encode(pairs.images)[pairs.reference]
        rows = []
        for number, pair in enumerate(shown):
            poses = apply_relative_pose(torch.from_numpy(pair.reference.pose), around.double())
            code, sampling = codes[number : number + 1], (self.sampling_steps, self.guidance, seed)
            generated = generated_views(self.prior, code, around, *sampling)
            rows.append(FailureRow(pair, self.rendered(pair.object, poses), generated))
        return rows

    def rendered(self, name: str, poses: Tensor) -> NDArray | None:
        """Views `[K, H, W, 3]` in [0, 1] of an object's mesh from view poses `[K, 3]`; None where there is no mesh."""
        source = self.data.source
        if not isinstance(source, RenderedData):
            return None
        scene = next(each for each in source.objects() if each.name == name).load()
        field_of_view = self.data.table("test").objects[object_index(self.data, name)].field_of_view
        views = source.renderer.render(scene, camera_to_world(poses), RESOLUTION, math.degrees(field_of_view)) / 255
        alpha = views[..., 3:]
        return np.asarray(views[..., :3] * alpha + 1 - alpha)

    def draw(self, contents: list[FailureRow]) -> tuple[Figure, str]:
        """See `PaperFigure`."""
        mesh = "rendered from the mesh (top) and " if contents[0].rendered is not None else ""
        return failures_figure(contents), (
            "(a) Reference above query. (b) Views turned around the object by the given longitudes from the reference, "
            f"{mesh}generated by the prior from the reference. (c) The prior's denoising error over relative longitude "
            "and latitude, dark where it is low; + are local minima, the star is the true relative pose. "
            f"{self.draws.in_words()}"
        )
