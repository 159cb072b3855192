"""Cameras that two methods find, beside the true ones (Qualitative Results)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lp_framework import registry
from lp_framework.analysis.ambiguity import NEAR_DEGREES
from lp_framework.analysis.pairs import named_pairs, object_index, solved_pairs
from lp_framework.analysis.shown import ShownPair, words
from lp_framework.data.module import PairDataModule
from lp_framework.data.photographs import read_image
from lp_framework.errors import UserError
from lp_framework.figures.base import PaperFigure, score_model
from lp_framework.geometry import apply_relative_pose
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.progress import shown_progress
from lp_framework.viz.cameras import CameraScene, camera_methods_figure

NAMES = {"ifusion": "iFusion", "id_pose": "ID-Pose", "two_stage": "two-stage"}  # as papers write them


@register("figure", "cameras")
class CamerasFigure(PaperFigure[list[CameraScene]]):
    """True and predicted cameras around some objects, methods side by side, from a few random starts for each view.

    The first test view of an object is the reference, the next `targets`, or all that there are, are estimated.
    `methods` are solvers by name with their default settings; those that ask for a model get that of `score`, a
    training run or a checkpoint.
    """

    def __init__(
        self,
        data: PairDataModule,
        prior: Prior,
        objects: Sequence[str] = ("tram", "suitcase", "fire_engine", "watering_can"),
        targets: int = 5,
        methods: Sequence[str] = ("ifusion", "two_stage"),
        starts: int = 2,
        score: str | None = None,
    ) -> None:
        if not objects or not methods or targets < 1 or starts < 1:
            raise UserError("figure.objects and figure.methods need a name each, targets and starts at least 1")
        self.data, self.prior, self.objects, self.targets = data, prior, list(objects), targets
        self.methods, self.named = list(methods), [NAMES.get(name, words(name)) for name in methods]
        wanted = {part for name in methods for part in registry.component_names(registry.get("solver", name))}
        self.model = score_model(score) if "model" in wanted else None
        self.solvers = {name: registry.build("solver", name, prior=prior, model=self.model) for name in methods}
        self.starts = registry.build("start", {"name": "random", "count": starts})

    def analyse(self, seed: int, device: torch.device) -> list[CameraScene]:
        """All objects and views are solved together, a method after the other."""
        views = [self.data.table("test").objects[object_index(self.data, name)] for name in self.objects]
        targets = max(1, min(self.targets, *(len(each) - 1 for each in views)))
        objects = [name for name in self.objects for _ in range(targets)]
        pairs, shown = named_pairs(self.data, objects, [(0, k + 1) for k in range(targets)] * len(views), device)
        starts = self.starts.make(pairs, seed)
        with shown_progress():
            solved = [solved_pairs(pairs, shown, self.solvers[name], starts, seed) for name in self.methods]
        scenes = []
        for number, each in enumerate(views):
            own = slice(number * targets, (number + 1) * targets)
            first, methods = shown[own][0], [pairs[own] for pairs in solved]
            errors = [np.concatenate([pair.rotation_errors for pair in method]) for method in methods]
            scenes.append(
                CameraScene(
                    first.title,
                    np.stack([first.reference.image, *(pair.query.image for pair in shown[own])]),
                    each.poses[: targets + 1].numpy(),
                    each.field_of_view,
                    np.asarray(read_image(each.files[0]).convert("RGBA")),
                    [np.stack([predicted(pair) for pair in method]) for method in methods],
                    [f"{(near <= NEAR_DEGREES).sum()} of {len(near)} within {NEAR_DEGREES:g}°" for near in errors],
                )
            )
        return scenes

    def draw(self, contents: list[CameraScene]) -> Figure:
        """See `viz.cameras`."""
        return camera_methods_figure(contents, self.named)

    def caption(self, contents: list[CameraScene]) -> str:
        """See `PaperFigure`."""
        names = ", ".join(scene.title for scene in contents)
        return (
            f"Predicted (thin) and true cameras (bold) of {len(contents[0].images) - 1} views of each object "
            f"({names}), relative to the reference (red), from {self.starts.count} random starts for each view: "
            f"{' and '.join(self.named)}. Counted are the predictions within {NEAR_DEGREES:g} degrees."
        )


def predicted(pair: ShownPair) -> NDArray:
    """The query's view poses `[N, 3]` that a solver predicts."""
    poses = apply_relative_pose(torch.from_numpy(pair.reference.pose), torch.from_numpy(pair.ends).double())
    return np.asarray(poses)
