"""The pictures of a run: which there are, and what goes into them."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lp_framework.data.pairs import PairBatch, PairData
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.evaluation.examples import EXAMPLES, gather_examples, pick_pairs, recording, save_examples
from lp_framework.evaluation.metrics import summarise
from lp_framework.models.objectives import PoseKernel
from lp_framework.models.pose_model import FieldValue, PoseModel
from lp_framework.solvers.base import Pairs, Solution, pairs_of
from lp_framework.solvers.langevin import Langevin
from lp_framework.viz.errors_plot import ObjectCard, errors_figure, objects_figure
from lp_framework.viz.fields import ARROW_SPACING, DENSITY_SPACING, FieldMap, field_figure, field_on_grid
from lp_framework.viz.style import save_figure
from lp_framework.viz.training import LOSSES, read_curves, training_figure


class ExactModel(nn.Module):
    """Stands in for a model in a solver: the kernel's own score around the truth `[3]`, the best there is to learn."""

    def __init__(self, kernel: PoseKernel, truth: Tensor, has_energy: bool = False) -> None:
        super().__init__()
        self.kernel, self.truth, self.has_energy = kernel, truth, has_energy

    def encode(self, images: Tensor) -> Tensor:
        """No features are needed: `[I, 1]`."""
        return images.new_zeros(len(images), 1)

    def condition(self, reference: Tensor, query: Tensor) -> Tensor:
        """See `PoseModel`."""
        return reference

    def field(self, condition: Tensor, pose: Tensor) -> FieldValue:
        """See `PoseModel`."""
        truth = self.truth.to(pose)
        energy = self.kernel.energy(pose, truth) if self.has_energy else None
        return FieldValue(self.kernel.score(pose, truth), energy)


def save_pictures(folder: Path, evaluation: Evaluation, data: PairData) -> list[Path]:
    """After `Trainer.test`: fields of some pairs (failures first), cumulative errors, and the objects, into `folder`.

    Each as PNG and PDF; returns the PNG files. The errors shown are the evaluation's; the fields' pairs are solved
    again to see their trajectories, with the same starts and draws.
    """
    evaluation.eval()
    rows, table = evaluation.metrics.rows(), evaluation.table
    rotation, translation = rows["rotation"].numpy(), rows["translation"].numpy()
    chosen, objects = rows["chosen"].numpy(), rows["object"].numpy()
    written: list[Path] = []
    answer = rotation[np.arange(len(rotation)), chosen]
    for number, pick in enumerate(pick_pairs(answer, objects, table.unique_answer)):
        views = np.array([divmod(int(rows["pair"][pick.row]), len(table))])
        index = int(objects[pick.row])
        start = chosen[pick.row]
        title = f"{table.names[index].replace('_', ' ')} ({table.ambiguities[index]})"
        degrees, distance = rotation[pick.row, start], translation[pick.row, start]
        off = "no answer" if np.isnan(degrees) else f"rotation error {degrees:.1f}°, translation error {distance:.2f}"
        note = f"{pick.reason}: {off}"
        figure = field_figure(*pair_contents(evaluation, data[views]), title, note)
        written += save_figure(figure, folder / f"field_{number}")
    return [*(file for file in written if file.suffix == ".png"), *save_summaries(folder, evaluation, data)]


def save_summaries(folder: Path, evaluation: Evaluation, data: PairData) -> list[Path]:
    """After `Trainer.test`, of pairs or sets: the cumulative errors and the objects; as `save_pictures`.

    `EXAMPLES` below the folder gets what the page of the run is drawn from.
    """
    save_examples(folder / EXAMPLES, gather_examples(evaluation, data))
    rows, table = evaluation.metrics.rows(), evaluation.table
    classes = [table.ambiguities[index] for index in rows["object"].tolist()]
    rotation, translation, chosen = (rows[name].numpy() for name in ("rotation", "translation", "chosen"))
    written = save_figure(errors_figure(rotation, translation, chosen, classes), folder / "errors")
    written += save_figure(objects_figure(object_cards(rows, data, evaluation.solver.one_answer)), folder / "objects")
    return [file for file in written if file.suffix == ".png"]


def save_training_picture(folder: Path) -> list[Path]:
    """`training.png` and `.pdf` in a training run's folder, from its `metrics.csv`; none where nothing was logged."""
    metrics = folder / "metrics.csv"
    curves = read_curves(metrics) if metrics.is_file() else {}
    losses = {name: curves[name] for name in LOSSES if name in curves}
    if not losses:
        return []
    rate = next((curve for name, curve in curves.items() if name.startswith("lr-")), None)
    return save_figure(training_figure(losses, rate), folder / "training")[:1]


def pair_contents(evaluation: Evaluation, batch: PairBatch) -> tuple[NDArray, NDArray, NDArray, list[FieldMap]]:
    """What `field_figure` draws of a batch of one pair: both images, the truth, and the maps.

    A solver with a model has two maps, its field and the exact one; any other has one, without arrows.
    """
    pairs = pairs_of(batch, evaluation.table, evaluation.device)
    starts = evaluation.starts.make(pairs, evaluation.seed)
    truth = batch.relative_poses()[0]
    solver = recording(evaluation.solver)
    solution = solver.solve(pairs, starts, evaluation.seed)
    model = getattr(solver, "model", None)
    if isinstance(model, PoseModel):
        field = "exp(-E) and score" if model.has_energy else "score"
        maps = [with_field(way("", solution, starts), f"Learned {field}", model, pairs, truth)]
        oracle = FieldMap("")
        exact = ExactModel(model.kernel, truth, model.has_energy)
        if isinstance(solver, Langevin):
            ideal = copy.copy(solver)
            ideal.model = exact  # type: ignore[assignment]  # has all of a PoseModel that this solver asks for
            oracle = way("", ideal.solve(pairs, starts, evaluation.seed), starts)
        maps.append(with_field(oracle, f"Exact {field} (oracle)", exact, pairs, truth))
    else:
        maps = [way("Starts and answer", solution, starts)]
    reference, query = (as_pixels(pairs.images[side[0]]) for side in (pairs.reference, pairs.query))
    return reference, query, truth.numpy(), maps


def way(title: str, solution: Solution, starts: Tensor) -> FieldMap:
    """A map of what a solver did with the first pair of `solution`: starts, trajectories if any, ends, answer.

    A solver whose answers are not as many as the starts has made candidates of its own: its map shows no starts.
    """
    return FieldMap(
        title,
        starts=starts[0].cpu().numpy() if solution.poses.shape == starts.shape else None,
        paths=None if solution.trajectory is None else solution.trajectory[0].cpu().numpy(),
        ends=solution.poses[0].detach().cpu().numpy(),
        chosen=int(solution.chosen[0]),
    )


def with_field(content: FieldMap, title: str, model: PoseModel | ExactModel, pairs: Pairs, truth: Tensor) -> FieldMap:
    """The map with the field of `model` for the first of `pairs`, at the radius of the true relative pose `[3]`."""
    device = pairs.images.device
    with torch.no_grad():
        features = model.encode(pairs.images)
        condition = model.condition(features[pairs.reference[:1]], features[pairs.query[:1]])[None]  # [1, 1, hidden]
        arrows, density = (
            field_on_grid(lambda pose: model.field(condition, pose.to(device)), float(truth[2]), spacing)
            for spacing in (ARROW_SPACING, DENSITY_SPACING)
        )
    return replace(content, title=title, arrows=arrows, density=None if density.energy is None else density)


def object_cards(rows: dict[str, Tensor], data: PairData, one_answer: bool) -> list[ObjectCard]:
    """A card for every object that has pairs among the `rows` of `PoseMetrics`, with its first view.

    With `one_answer` a pair there is no success rate.
    """
    table = data.table
    assert data.images is not None  # evaluation never caches features
    cards = []
    for index in rows["object"].unique().tolist():
        mask = rows["object"] == index
        metrics = summarise(rows["rotation"][mask], rows["translation"][mask], rows["chosen"][mask])
        image = np.asarray(data.images[table.views_of(index)[0]])
        success = None if one_answer else metrics["SR(R)@30"]
        cards.append(ObjectCard(table.names[index], table.ambiguities[index], image, metrics["R(R)@15"], success))
    return cards


def as_pixels(image: Tensor) -> NDArray:
    """Pixels `[H, W, 3]` in [0, 1] of an image `[3, H, W]` in [-1, 1]."""
    return ((image.float() + 1) / 2).clamp(0, 1).permute(1, 2, 0).cpu().numpy()
