"""Cameras that two methods find, beside the true ones (Qualitative Results)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure

from lp_framework import registry
from lp_framework.data.module import PairDataModule
from lp_framework.data.photographs import read_image
from lp_framework.errors import UserError
from lp_framework.figures.base import PaperFigure
from lp_framework.figures.models import score_model
from lp_framework.figures.shown_pairs import object_index, shown_pairs, words
from lp_framework.geometry import apply_relative_pose, camera_to_world, rotation_error
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.progress import shown_progress
from lp_framework.viz.camera_methods import CameraScene, camera_methods_figure

NEAR_DEGREES = 15.0
NAMES = {"ifusion": "iFusion", "id_pose": "ID-Pose", "two_stage": "two-stage"}  # as papers write them


class CameraContents(NamedTuple):
    """A scene an object, the methods' names as they are read, and the field of view (radians)."""

    scenes: list[CameraScene]
    methods: list[str]
    field_of_view: float


@register("figure", "cameras")
class CamerasFigure(PaperFigure[CameraContents]):
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
        self.methods = list(methods)
        wanted = {part for name in methods for part in registry.component_names(registry.get("solver", name))}
        self.model = score_model(score) if "model" in wanted else None
        self.solvers = {name: registry.build("solver", name, prior=prior, model=self.model) for name in methods}
        self.starts = registry.build("start", {"name": "random", "count": starts})

    def gather(self, seed: int, device: torch.device) -> CameraContents:
        """All objects and views are solved together, a method after the other."""
        table = self.data.table("test")
        fewest = min(len(table.objects[object_index(self.data, name)]) for name in self.objects)
        targets = max(1, min(self.targets, fewest - 1))
        objects = [name for name in self.objects for _ in range(targets)]
        shown = shown_pairs(self.data, objects, [(0, k + 1) for k in range(targets)] * len(self.objects), device)
        starts = self.starts.make(shown.pairs, seed)
        reference, query = (shown.poses[:, side, None] for side in (0, 1))
        predicted, near = [], []
        for name in self.methods:
            with shown_progress():
                solution = self.solvers[name].solve(shown.pairs, starts, seed)
            poses = apply_relative_pose(reference, solution.poses.detach().cpu().double())
            error = rotation_error(camera_to_world(poses), camera_to_world(query).expand(*poses.shape[:2], 4, 4))
            predicted.append(poses.unflatten(0, (len(self.objects), targets)).numpy())
            near.append((error <= NEAR_DEGREES).unflatten(0, (len(self.objects), targets)).flatten(1))
        scenes = []
        for number, name in enumerate(self.objects):
            own = slice(number * targets, (number + 1) * targets)
            views = table.objects[object_index(self.data, name)]
            scenes.append(
                CameraScene(
                    words(name),
                    np.concatenate([shown.images[own][:1, 0], shown.images[own, 1]]),
                    views.poses[: targets + 1].numpy(),
                    np.asarray(read_image(views.files[0]).convert("RGBA")),
                    [poses[number] for poses in predicted],
                    [
                        f"{int(each[number].sum())} of {each.shape[1]} within {NEAR_DEGREES:g}°" for each in near
                    ],
                )
            )  # fmt: skip
        return CameraContents(scenes, [NAMES.get(name, words(name)) for name in self.methods], views.field_of_view)

    def draw(self, contents: CameraContents) -> Figure:
        """See `viz.camera_methods`."""
        return camera_methods_figure(*contents)

    def caption(self, contents: CameraContents) -> str:
        """See `PaperFigure`."""
        names = ", ".join(scene.title for scene in contents.scenes)
        return (
            f"Predicted (thin) and true cameras (bold) of {len(contents.scenes[0].images) - 1} views of each object "
            f"({names}), relative to the reference (red), from {self.starts.count} random starts for each view: "
            f"{' and '.join(contents.methods)}. Counted are the predictions within {NEAR_DEGREES:g} degrees."
        )
