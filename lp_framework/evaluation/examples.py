"""Examples of an evaluation: a few of its pairs with all that explains their answers, failures first, kept on disk.

    <folder>/examples.json          poses, starts, trajectories, errors and landscapes
    <folder>/0_reference.png ...    both images of each pair

They are gathered while the solver is at hand; what is drawn of them later needs neither models nor data.
"""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from lp_framework.data.pairs import PairData
from lp_framework.data.photographs import save_png
from lp_framework.errors import UserError
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.evaluation.landscape import Landscape, landscape_grid, model_landscape, prior_landscapes
from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS
from lp_framework.evaluation.tables import write_text
from lp_framework.evaluation.view_sets import ViewSetEvaluation
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Cost, Pairs, Solution, Solver, pairs_of

EXAMPLES, FILE = "examples", "examples.json"  # the folder among the pictures, and the file in it
MOST = 6
SIDE = 192  # pixels of an image that is kept
TIMESTEPS = (100, 300, 500, 700, 900)
# A prior's landscapes may take half a minute, or this share of the time that the solver took for all pairs.
SECONDS, SHARE = 30.0, 0.1
NO_COST = Cost(network_passes=0, seconds=0.0)
ABOUT = (
    "Poses are (latitude, longitude, radius) in radians and object sizes; relative ones are query minus reference. "
    "Errors are degrees and object sizes, one a start; a trajectory goes from its start to its end."
)


class Pick(NamedTuple):
    """A pair worth a picture: its row, and why."""

    row: int
    reason: str


@dataclass(frozen=True)
class View:
    """One image of a pair: its file's name, its pixels `[H, W, 3]` (uint8) and its true view pose `[3]`."""

    name: str
    image: NDArray
    pose: NDArray


@dataclass(frozen=True)
class Example:
    """A pair and what a solver did with it, for N starts; radians and object sizes, NaN where there is no number.

    `truth` `[3]`, `ends` `[N, 3]` and `starts` `[M, 3]` are relative poses, `trajectories` `[N, S + 1, 3]` have
    longitudes unreduced; solvers that keep no trajectory, or make candidates of their own, have None, and so has the
    truth of photographs. `energies` `[N]`
    are the solver's, `chosen` is its answer, `rotation_errors` (degrees) and `translation_errors` are `[N]`.
    `landscapes` are those that the solver walked on, by name, at the true relative radius.
    """

    object: str
    ambiguity: str
    reason: str
    reference: View
    query: View
    truth: NDArray | None
    starts: NDArray | None
    trajectories: NDArray | None
    ends: NDArray
    energies: NDArray
    chosen: int
    rotation_errors: NDArray
    translation_errors: NDArray
    landscapes: dict[str, Landscape]

    @property
    def failed(self) -> bool:
        """Whether the answer is known to be further off than the widest threshold; without an answer it is."""
        return self.truth is not None and not self.rotation_errors[self.chosen] <= ROTATION_THRESHOLDS[-1]


def gather_examples(evaluation: Evaluation, data: PairData) -> list[Example]:
    """After `Trainer.test`: up to `MOST` pairs, the largest error first, solved again to see their trajectories.

    Starts and draws are the evaluation's, so the answers are its answers; the errors are those that it counted. Pairs
    of sets of images are not solved again, for their answers came of all images of a set: they have no trajectories.
    """
    rows, table = evaluation.metrics.rows(), evaluation.table
    rotation, translation, chosen, objects = (
        rows[name].numpy() for name in ("rotation", "translation", "chosen", "object")
    )
    picks = pick_examples(rotation[np.arange(len(rotation)), chosen], objects, table.names, table.unique_answer)
    views = np.array([divmod(int(rows["pair"][pick.row]), len(table)) for pick in picks])
    batch = data[views]
    assert data.images is not None  # evaluation never caches features
    pairs = pairs_of(batch, table, evaluation.device)
    starts = evaluation.starts.make(pairs, evaluation.seed)
    solution = _retraced(evaluation, pairs, starts, rows["answer"][[pick.row for pick in picks]])
    truth = batch.relative_poses()
    landscapes = _landscapes(evaluation, pairs, truth[:, 2])
    examples = []
    for place, pick in enumerate(picks):
        index = int(objects[pick.row])
        reference, query = (
            View(table.files[view].name, np.asarray(data.images[view]), table.poses[view].numpy())
            for view in views[place]
        )
        examples.append(
            Example(
                table.names[index],
                table.ambiguities[index],
                pick.reason,
                reference,
                query,
                truth[place].numpy(),
                starts=_array(starts[place]) if solution.poses.shape == starts.shape else None,
                trajectories=None if solution.trajectory is None else _array(solution.trajectory[place]),
                ends=_array(solution.poses[place]),
                energies=_array(solution.energies[place]),
                chosen=int(chosen[pick.row]),
                rotation_errors=rotation[pick.row],
                translation_errors=translation[pick.row],
                landscapes={name: each[place] for name, each in landscapes.items()},
            )
        )
    return examples


def _retraced(evaluation: Evaluation, pairs: Pairs, starts: Tensor, answers: Tensor) -> Solution:
    """The solution of pairs with its trajectories, from starts `[B, N, 3]`; of sets of images the answers `[B, 3]`."""
    if not isinstance(evaluation, ViewSetEvaluation):
        return recording(evaluation.solver).solve(pairs, starts, evaluation.seed)
    poses = answers[:, None].to(starts)
    unknown, first = torch.full_like(poses[..., 0], torch.nan), torch.zeros_like(pairs.ids)
    return Solution(poses, unknown, valid=poses.isfinite().all(dim=-1), chosen=first, cost=NO_COST)


def pick_pairs(errors: NDArray, objects: NDArray, unique_answer: Sequence[bool | None]) -> list[Pick]:
    """Up to four pairs by their rotation errors `[P]` and object indices `[P]`, the largest error first.

    The worst, the median and the best among objects with a unique answer (among all where none is labelled so), and
    the median among those without one. Ties go to the earlier row.
    """
    failed = np.nan_to_num(errors, nan=np.inf)
    order = np.argsort(failed, kind="stable")
    unique = np.array([unique_answer[index] is True for index in objects])
    judged = order[unique[order]] if unique.any() else order
    among = f"of {len(judged)} pairs" + (" with a unique answer" if unique.any() else "")
    worst = judged[np.searchsorted(failed[judged], failed[judged[-1]])]  # the first row of those that tie
    wanted = [
        Pick(int(worst), f"worst {among}"),
        Pick(int(judged[(len(judged) - 1) // 2]), f"median {among}"),
        Pick(int(judged[0]), f"best {among}"),
    ]
    ambiguous = np.array([unique_answer[index] is False for index in objects])
    others = order[ambiguous[order]]
    if len(others):
        reason = f"median of {len(others)} pairs without a unique answer"
        wanted.append(Pick(int(others[(len(others) - 1) // 2]), reason))
    first = {pick.row: pick for pick in reversed(wanted)}
    return sorted(first.values(), key=lambda pick: (-failed[pick.row], pick.row))


def pick_examples(
    errors: NDArray, objects: NDArray, names: Sequence[str], unique_answer: Sequence[bool | None]
) -> list[Pick]:
    """Those of `pick_pairs`, and of the objects not among these the worst pairs, up to `MOST`; the largest error first.

    Objects with a unique answer come before those without one: a failure there is the solver's.
    """
    failed = np.nan_to_num(errors, nan=np.inf)
    picks = pick_pairs(errors, objects, unique_answer)
    shown = {int(objects[pick.row]) for pick in picks}
    worst = {int(objects[row]): int(row) for row in reversed(np.argsort(-failed, kind="stable"))}
    others = sorted(set(worst) - shown, key=lambda index: (unique_answer[index] is False, -failed[worst[index]]))
    for index in others[: MOST - len(picks)]:
        reason = f"worst of {int((objects == index).sum())} pairs of {names[index].replace('_', ' ')}"
        picks.append(Pick(worst[index], reason))
    return sorted(picks, key=lambda pick: (-failed[pick.row], pick.row))


def recording(solver: Solver) -> Solver:
    """The solver and those that it is made of, told to keep their trajectories where they have a setting of that name.

    It is a copy, so the given one stays as it is.
    """
    solver = copy.copy(solver)
    for name, part in vars(solver).items():
        if isinstance(part, Solver):
            vars(solver)[name] = recording(part)
    if isinstance(getattr(solver, "trajectory", None), bool):
        vars(solver)["trajectory"] = True
    return solver


def _landscapes(evaluation: Evaluation, pairs: Pairs, radius: Tensor) -> dict[str, list[Landscape]]:
    """What the solver's networks say of every pose at the relative radii `[B]`, a landscape a pair.

    Of a score model that is the length of the score: it is small where the model takes the pose for right.
    """
    latitude, longitude = landscape_grid()
    found: dict[str, Tensor] = {}
    prior, model = (getattr(evaluation.solver, name, None) for name in ("prior", "model"))
    passes = 2 * len(pairs) * len(TIMESTEPS) * len(latitude) * len(longitude)
    if isinstance(prior, Prior) and _is_quick(evaluation, passes):
        found["energy of the prior"] = prior_landscapes(
            prior, pairs, radius, latitude, longitude, TIMESTEPS, 1, evaluation.seed
        )
    if isinstance(model, PoseModel):
        score, energy = model_landscape(model, pairs, radius, latitude, longitude)
        name = "length of the model's score" if energy is None else "energy of the model"
        found[name] = score.norm(dim=-1) if energy is None else energy
    return {
        name: [Landscape(latitude, longitude, *each) for each in zip(radius.tolist(), values.cpu(), strict=True)]
        for name, values in found.items()
    }


def _is_quick(evaluation: Evaluation, passes: int) -> bool:
    """Whether so many passes through the prior take little time, by what the evaluation's own took."""
    costs = evaluation.costs.compute()
    seconds, before = costs["seconds"], costs["passes"]
    return before > 0 and passes * seconds / before <= max(SECONDS, SHARE * seconds)


def _array(values: Tensor) -> NDArray:
    array: NDArray = values.detach().cpu().double().numpy()
    return array


# ---------------------------------------------------------------- on disk


def save_examples(folder: Path, examples: Sequence[Example]) -> Path:
    """Write the examples into `folder`, anew; returns the JSON file, which is written last."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for number, example in enumerate(examples):
        for name, view in (("reference", example.reference), ("query", example.query)):
            image = Image.fromarray(view.image)
            image.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
            save_png(folder / f"{number}_{name}.png", image)
    content = {"about": ABOUT, "examples": [as_json(example) for example in examples]}
    write_text(folder / FILE, json.dumps(content) + "\n")
    return folder / FILE


def read_examples(folder: Path) -> list[Example]:
    """The examples in `folder`; `UserError` where they are missing or damaged."""
    file = folder / FILE
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        return [_example(folder, number, entry) for number, entry in enumerate(content["examples"])]
    except FileNotFoundError as error:
        raise UserError(f"{error.filename}: there is no such file") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise UserError(f"{file}: is damaged ({type(error).__name__}: {error})") from error


def as_json(example: Example) -> dict[str, Any]:
    """All of an example but the images' pixels, as names, lists and numbers (null for what is not finite)."""
    return {
        "object": example.object,
        "ambiguity": example.ambiguity,
        "reason": example.reason,
        "reference": {"file": example.reference.name, "pose": _numbers(example.reference.pose)},
        "query": {"file": example.query.name, "pose": _numbers(example.query.pose)},
        "truth": _numbers(example.truth),
        "starts": _numbers(example.starts),
        "trajectories": _numbers(example.trajectories),
        "ends": _numbers(example.ends),
        "energies": _numbers(example.energies),
        "chosen": example.chosen,
        "rotation_errors": _numbers(example.rotation_errors),
        "translation_errors": _numbers(example.translation_errors),
        "landscapes": [
            {
                "name": name,
                "latitude": _numbers(each.latitude.numpy()),
                "longitude": _numbers(each.longitude.numpy()),
                "radius": round(each.radius, 5),
                "energy": _numbers(each.energy.double().numpy()),
            }
            for name, each in example.landscapes.items()
        ],
    }


def _example(folder: Path, number: int, entry: dict[str, Any]) -> Example:
    def view(name: str) -> View:
        with Image.open(folder / f"{number}_{name}.png") as image:
            pixels = np.asarray(image.convert("RGB"))
        return View(str(entry[name]["file"]), pixels, _read(entry[name]["pose"], 3))

    ends = _read(entry["ends"], None, 3)
    count = len(ends)
    chosen = int(entry["chosen"])
    if not 0 <= chosen < count:
        raise ValueError(f"chosen is {chosen} of {count}")
    return Example(
        str(entry["object"]), str(entry["ambiguity"]), str(entry["reason"]), view("reference"), view("query"),
        truth=None if entry["truth"] is None else _read(entry["truth"], 3),
        starts=None if entry["starts"] is None else _read(entry["starts"], None, 3),
        trajectories=None if entry["trajectories"] is None else _read(entry["trajectories"], count, None, 3),
        ends=ends,
        energies=_read(entry["energies"], count),
        chosen=chosen,
        rotation_errors=_read(entry["rotation_errors"], count),
        translation_errors=_read(entry["translation_errors"], count),
        landscapes={str(each["name"]): _landscape(each) for each in entry["landscapes"]},
    )  # fmt: skip


def _landscape(content: dict[str, Any]) -> Landscape:
    latitude, longitude = _read(content["latitude"], None), _read(content["longitude"], None)
    energy = _read(content["energy"], len(latitude), len(longitude))
    return Landscape(
        torch.from_numpy(latitude), torch.from_numpy(longitude), float(content["radius"]), torch.from_numpy(energy)
    )


def _numbers(values: NDArray | None) -> Any:
    """Nested lists of numbers to six digits, null for what is not finite."""
    if values is None:
        return None
    rounded = np.vectorize(lambda value: float(f"{value:.6g}") if np.isfinite(value) else None, otypes=[object])
    return rounded(values).tolist()


def _read(values: Any, *shape: int | None) -> NDArray:
    """The array of nested lists, NaN for null; `ValueError` where its shape is another (None: any length)."""
    array = np.array(values, dtype=float)
    if array.ndim != len(shape) or any(want not in (None, have) for want, have in zip(shape, array.shape, strict=True)):
        raise ValueError(f"an array of shape {list(array.shape)} where {list(shape)} is wanted")
    return array
