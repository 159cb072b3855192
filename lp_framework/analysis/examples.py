"""Examples of an evaluation: a few of its pairs with all that explains their answers, failures first, kept on disk.

    <folder>/examples.json          poses, starts, trajectories, errors and landscapes
    <folder>/0_reference.png ...    both images of each pair

They are gathered while the solver is at hand; what is drawn of them later needs neither models nor data.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from lp_framework.analysis.fields import Draws
from lp_framework.analysis.landscapes import Landscape, PoseMap, landscape_grid
from lp_framework.analysis.pairs import (
    shown_pairs,
    solved_pairs,
    with_fields,
    with_model_landscape,
    with_prior_energy,
    with_solution,
)
from lp_framework.analysis.shown import ShownPair, View, words
from lp_framework.data.pairs import PairData
from lp_framework.data.photographs import save_png
from lp_framework.errors import UserError
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.evaluation.tables import write_text
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Cost, Solution
from lp_framework.solvers.langevin import Langevin

EXAMPLES, FILE = "examples", "examples.json"  # the folder among the pictures, and the file in it
MOST = 6
SIDE = 192  # pixels of an image that is kept
TIMESTEPS = (100, 300, 500, 700, 900)
# A prior's landscapes may take half a minute, or this share of the time that the solver took for all pairs.
SECONDS, SHARE = 30.0, 0.1
ABOUT = (
    "Poses are (latitude, longitude, radius) in radians and object sizes; relative ones are query minus reference. "
    "Errors are degrees and object sizes, one a start; a trajectory goes from its start to its end."
)
# The arrays of an example by the lengths of their axes: ANY, or N, that of the ends.
ANY, N = None, -1
SHAPES: Mapping[str, tuple[int | None, ...]] = {
    "truth": (3,), "starts": (ANY, 3), "trajectories": (N, ANY, 3), "ends": (N, 3), "energies": (N,),
    "rotation_errors": (N,), "translation_errors": (N,),
}  # fmt: skip


class Pick(NamedTuple):
    """A pair worth a picture: its row, and why."""

    row: int
    reason: str


def gather_examples(evaluation: Evaluation, data: PairData) -> list[ShownPair]:
    """After `Trainer.test`: up to `MOST` pairs, the largest error first, solved again to see their trajectories.

    Starts and draws are the evaluation's, so the answers are its answers; the errors are those that it counted. Those
    of `pick_pairs` have maps. Pairs of sets of images are not solved again, for their answers came of all images of a
    set: they have neither trajectories nor maps.
    """
    evaluation.eval()
    rows, table = evaluation.metrics.rows(), evaluation.table
    rotation, translation, chosen = (rows[name].numpy() for name in ("rotation", "translation", "chosen"))
    objects, answer = rows["object"].numpy(), rotation[np.arange(len(rotation)), chosen]
    picks = pick_examples(answer, objects, table.names, table.unique_answer)
    numbers = [pick.row for pick in picks]
    views = rows["pair"][numbers].numpy()
    pairs, shown = shown_pairs(data, views, evaluation.device, [pick.reason for pick in picks])
    starts = evaluation.starts.make(pairs, evaluation.seed)
    solver, sets = evaluation.solver, evaluation.views is not None
    if sets:
        solution = _of_answers(rows["answer"][numbers, None].to(starts))
        shown = [with_solution(pair, solution, starts, place) for place, pair in enumerate(shown)]
    else:
        shown = solved_pairs(pairs, shown, solver, starts, evaluation.seed)
    prior, model = (getattr(solver, name, None) for name in ("prior", "model"))
    draws = Draws(TIMESTEPS, 1, evaluation.seed)
    if isinstance(prior, Prior) and _is_quick(evaluation, len(shown), draws):
        shown = with_prior_energy(pairs, shown, prior, draws)
    if isinstance(model, PoseModel):
        shown = with_model_landscape(pairs, shown, model)
    if isinstance(model, PoseModel) and not sets:
        ways, first_stage = [pair.ways for pair in shown], solver if isinstance(solver, Langevin) else None
        shown = with_fields(pairs, shown, model, ways, first_stage, starts, evaluation.seed)
    elif not sets:
        shown = [replace(pair, maps=[PoseMap("Starts and answer", ways=pair.ways)]) for pair in shown]
    mapped = {pick.row for pick in pick_pairs(answer, objects, table.unique_answer)}
    return [
        replace(
            pair,
            chosen=int(chosen[row]),
            rotation_errors=rotation[row],
            translation_errors=translation[row],
            maps=pair.maps if row in mapped else (),
        )
        for row, pair in zip(numbers, shown, strict=True)
    ]


def _of_answers(poses: Tensor) -> Solution:
    """A solution of which only the answers `[B, 1, 3]` are known."""
    first = torch.zeros(len(poses), dtype=torch.int64)
    unknown = torch.full_like(poses[..., 0], torch.nan)
    return Solution(poses, unknown, valid=poses.isfinite().all(dim=-1), chosen=first, cost=Cost(0, 0.0))


def _is_quick(evaluation: Evaluation, pairs: int, draws: Draws) -> bool:
    """Whether the prior's landscapes of so many pairs take little time, by what the evaluation's own passes took."""
    cost = evaluation.result()
    seconds, before = (cost["pairs"] * cost[f"{what}_per_pair"] for what in ("seconds", "network_passes"))
    latitude, longitude = landscape_grid()
    passes = 2 * pairs * len(draws.steps()) * len(latitude) * len(longitude)  # both directions
    return before > 0 and passes * seconds / before <= max(SECONDS, SHARE * seconds)


def pick_pairs(errors: NDArray, objects: NDArray, unique_answer: Sequence[bool | None]) -> list[Pick]:
    """Up to four pairs by their rotation errors `[P]` and object indices `[P]`, the largest error first.

    The worst, the median and the best among objects with a unique answer (among all where none is labelled so), and
    the median among those without one. Ties go to the earlier row.
    """
    failed = np.nan_to_num(errors, nan=np.inf)
    order = np.argsort(failed, kind="stable").tolist()
    judged = [row for row in order if unique_answer[objects[row]] is True]
    among = f"of {len(judged)} pairs with a unique answer" if judged else f"of {len(order)} pairs"
    judged = judged or order
    worst = next(row for row in judged if failed[row] == failed[judged[-1]])
    wanted = [
        Pick(worst, f"worst {among}"),
        Pick(judged[(len(judged) - 1) // 2], f"median {among}"),
        Pick(judged[0], f"best {among}"),
    ]
    others = [row for row in order if unique_answer[objects[row]] is False]
    if others:
        reason = f"median of {len(others)} pairs without a unique answer"
        wanted.append(Pick(others[(len(others) - 1) // 2], reason))
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
        picks.append(Pick(worst[index], f"worst of {int((objects == index).sum())} pairs of {words(names[index])}"))
    return sorted(picks, key=lambda pick: (-failed[pick.row], pick.row))


# ---------------------------------------------------------------- on disk


def save_examples(folder: Path, examples: Sequence[ShownPair]) -> Path:
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


def read_examples(folder: Path) -> list[ShownPair]:
    """The examples in `folder`; `UserError` where they are missing or damaged."""
    file = folder / FILE
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        return [_example(folder, number, entry) for number, entry in enumerate(content["examples"])]
    except FileNotFoundError as error:
        raise UserError(f"{error.filename}: there is no such file") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise UserError(f"{file}: is damaged ({type(error).__name__}: {error})") from error


def as_json(example: ShownPair) -> dict[str, Any]:
    """All of an example but pixels and maps, as names, lists and numbers (null for what is not finite)."""
    return {
        **{name: getattr(example, name) for name in ("object", "ambiguity", "reason")},
        "reference": {"file": example.reference.name, "pose": _numbers(example.reference.pose)},
        "query": {"file": example.query.name, "pose": _numbers(example.query.pose)},
        **{name: _numbers(getattr(example, name)) for name in SHAPES},
        "chosen": example.chosen or 0,
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


def _example(folder: Path, number: int, entry: Mapping[str, Any]) -> ShownPair:
    def view(name: str) -> View:
        with Image.open(folder / f"{number}_{name}.png") as image:
            pixels = np.asarray(image.convert("RGB"))
        return View(Path(entry[name]["file"]), pixels, _read(entry[name]["pose"], 3))

    count, chosen = len(entry["ends"]), int(entry["chosen"])
    if not 0 <= chosen < count:
        raise ValueError(f"chosen is {chosen} of {count}")
    arrays: dict[str, Any] = {
        name: _read(entry[name], *(count if length == N else length for length in shape))
        for name, shape in SHAPES.items()
        if entry[name] is not None or name not in ("truth", "starts", "trajectories")
    }
    landscapes = {str(each["name"]): _landscape(each) for each in entry["landscapes"]}
    return ShownPair(
        str(entry["object"]), str(entry["ambiguity"]), str(entry["reason"]), view("reference"), view("query"),
        chosen=chosen, landscapes=landscapes, **arrays,
    )  # fmt: skip


def _landscape(content: Mapping[str, Any]) -> Landscape:
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
