"""Results of solvers: predicted and true cameras, and recall over the number of random starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from lp_framework import registry
from lp_framework.analysis.ambiguity import NEAR_DEGREES
from lp_framework.analysis.pairs import named_pairs, object_index, solved_pairs, words
from lp_framework.data.module import PairDataModule
from lp_framework.data.photographs import read_image
from lp_framework.errors import UserError
from lp_framework.figures.base import PaperFigure, figure_model
from lp_framework.geometry import apply_relative_pose
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.report.runs import find_runs
from lp_framework.report.sweep_figures import is_swept, sweep_figure
from lp_framework.report.sweep_tables import LABELS, Objects, SweepTable, sweep_tables
from lp_framework.viz.cameras import CameraScene, camera_methods_figure

NAMES = {"ifusion": "iFusion", "id_pose": "ID-Pose", "two_stage": "two-stage"}  # as written in papers


@register("figure", "cameras")
@dataclass
class CamerasFigure(PaperFigure):
    """True and predicted cameras around some objects, methods side by side, from a few random starts per view.

    The first test view of an object is the reference; the next `targets` views (or as many as exist) are estimated.
    `methods` are names of solvers, used with their default settings. Solvers that need a model use the one from
    `score`, a training run or a checkpoint.
    """

    data: PairDataModule
    prior: Prior
    objects: Sequence[str] = ("tram", "suitcase", "fire_engine", "watering_can")
    targets: int = 5
    methods: Sequence[str] = ("ifusion", "two_stage")
    starts: int = 2
    score: str | None = None

    def __post_init__(self) -> None:
        if not self.objects or not self.methods or self.targets < 1 or self.starts < 1:
            raise UserError(
                "figure.objects and figure.methods need at least one name each; targets and starts must be at least 1"
            )
        wanted = {part for name in self.methods for part in registry.component_names(registry.get("solver", name))}
        self.model = figure_model("score", self.score) if "model" in wanted else None
        built = {"prior": self.prior, "model": self.model}
        self.solvers = [registry.build("solver", name, **built) for name in self.methods]
        self.named = [NAMES.get(name, words(name)) for name in self.methods]

    def analyse(self, seed: int, device: torch.device) -> list[CameraScene]:
        """Solve all objects and views together, one method at a time."""
        views = [self.data.table("test").objects[object_index(self.data, name)] for name in self.objects]
        targets = max(1, min(self.targets, *(len(each) - 1 for each in views)))
        objects = [name for name in self.objects for _ in range(targets)]
        pairs, shown = named_pairs(self.data, objects, [(0, k + 1) for k in range(targets)] * len(views), device)
        starts = registry.build("start", {"name": "random", "count": self.starts}).make(pairs, seed)
        solved = [solved_pairs(pairs, shown, solver, starts, seed) for solver in self.solvers]
        scenes = []
        for number, each in enumerate(views):
            methods = [found[number * targets : (number + 1) * targets] for found in solved]
            errors = [np.stack([pair.rotation_errors for pair in found]) for found in methods]
            ends = [torch.from_numpy(np.stack([pair.ends for pair in found])).double() for found in methods]
            scenes.append(
                CameraScene(
                    words(self.objects[number]),
                    [read_image(file).convert("RGBA") for file in each.files[: targets + 1]],
                    each.poses[: targets + 1].numpy(),
                    each.field_of_view[: targets + 1].numpy(),
                    [apply_relative_pose(each.poses[0], relative).numpy() for relative in ends],
                    [f"{(off <= NEAR_DEGREES).sum()} of {off.size} within {NEAR_DEGREES:g}°" for off in errors],
                )
            )
        return scenes

    def draw(self, contents: list[CameraScene]) -> tuple[Figure, str]:
        names = ", ".join(scene.title for scene in contents)
        return camera_methods_figure(contents, self.named), (
            f"Predicted (thin) and true (bold) cameras of {len(contents[0].images) - 1} views per object ({names}), "
            f"relative to the reference (red), from {self.starts} random starts per view, for "
            f"{' and '.join(self.named)}. Counts: predictions within {NEAR_DEGREES:g} degrees of the truth."
        )


EXPERIMENT, COUNT = "starts", "start.count"


@register("figure", "recall")
@dataclass
class RecallFigure(PaperFigure):
    """Recall within 30 degrees over the number of random starts and over time, one curve per solver.

    `runs` is a folder with finished jobs of `eval experiment=starts`; `objects` chooses all objects or only those
    with a unique answer.
    """

    runs: str = "runs/multirun/eval/starts"
    objects: Objects = "unique_answer"

    def analyse(self, seed: int, device: torch.device) -> SweepTable:
        """Read the table of the experiment; deterministic."""
        make = f"run `python -m lp_framework eval experiment={EXPERIMENT}` first"
        if not Path(self.runs).is_dir():
            raise UserError(f"figure.runs={self.runs}: there is no such folder of finished runs; {make}")
        found, _ = find_runs([Path(self.runs)])
        tables, unlabelled = sweep_tables(found, self.objects)
        table = next((each for each in tables if each.experiment == EXPERIMENT and is_swept(each, COUNT)), None)
        if table is None:
            reason = unlabelled[0].reason if unlabelled else f"no finished runs with several numbers of starts; {make}"
            raise UserError(f"figure.runs={self.runs}: {reason}")
        return table

    def draw(self, contents: SweepTable) -> tuple[Figure, str]:
        figure = sweep_figure(contents)
        assert figure is not None  # the number of starts varies
        seeds = max(len(row.seeds) for row in contents.rows)
        return figure, (
            "Recall within 30 degrees (and a translation error of 0.2) over the number of random starts, and over the "
            f"time they take, for {LABELS[self.objects]}. Error bars: standard deviation over {seeds} seeds."
        )
