"""Examples of an evaluation: a few of its pairs, failures first, saved with what explains their answers.

    <folder>/examples.json          poses, starts, trajectories, errors and landscapes
    <folder>/0_reference.png ...    both images of each pair

They are gathered while the solver is loaded, so that drawing them later needs neither models nor data.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from lp_framework.analysis.fields import Draws
from lp_framework.analysis.landscapes import Landscape, landscape_grid
from lp_framework.analysis.pairs import (
    PRIOR_ENERGY,
    PoseMap,
    ShownPair,
    View,
    shown_pairs,
    solved_pairs,
    with_fields,
    with_model_landscape,
    with_prior_energy,
    words,
)
from lp_framework.data.pairs import PairData
from lp_framework.data.photographs import save_png
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.evaluation.tables import write_text
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.langevin import Langevin

EXAMPLES, FILE = "examples", "examples.json"  # the folder inside that of the pictures, and its file
MOST = 6
SIDE = 192  # pixels per side of a saved image
TIMESTEPS = (100, 300, 500, 700, 900)
# A prior's landscapes may take half a minute, or this share of the solver's total time.
SECONDS, SHARE = 30.0, 0.1
ABOUT = (
    "Poses are (latitude, longitude, radius) in radians and object sizes; relative ones are query minus reference. "
    "Errors are in degrees and object sizes, one per start; a trajectory goes from its start to its end."
)
ARRAYS = ("truth", "starts", "trajectories", "ends", "energies", "rotation_errors", "translation_errors")


def gather_examples(evaluation: Evaluation, data: PairData) -> list[ShownPair]:
    """After `Trainer.test`, solve up to `MOST` pairs again for their trajectories, largest error first.

    Starts and draws are the evaluation's, so the answers are the same; the errors are taken from the evaluation. Pairs
    of image sets are not solved again and have no maps, since their answers depend on the whole set.
    """
    evaluation.eval()
    rows, table, seed = evaluation.metrics.rows(), evaluation.table, evaluation.seed
    rotation, translation, chosen = (rows[name].numpy() for name in ("rotation", "translation", "chosen"))
    answer = np.take_along_axis(rotation, chosen[:, None], axis=1)[:, 0]
    picks = pick_examples(answer, rows["object"].numpy(), table.names, table.unique_answer)
    numbers = list(picks)
    pairs, shown = shown_pairs(data, rows["pair"][numbers].numpy(), evaluation.device)
    starts = evaluation.starts.make(pairs, seed)
    solver, sets = evaluation.solver, evaluation.views is not None
    if sets:
        ends, unknown = rows["answer"][numbers, None].numpy(), np.full(1, np.nan)
        shown = [replace(pair, ends=end, energies=unknown) for pair, end in zip(shown, ends, strict=True)]
    else:
        shown = solved_pairs(pairs, shown, solver, starts, seed)
    prior, model = (getattr(solver, name, None) for name in ("prior", "model"))
    draws = Draws(TIMESTEPS, 1, seed)
    if isinstance(prior, Prior) and _is_quick(evaluation, len(shown), draws):
        shown = with_prior_energy(pairs, shown, prior, draws)
    if isinstance(model, PoseModel):
        shown = with_model_landscape(pairs, shown, model)
    if isinstance(model, PoseModel) and not sets:
        shown = with_fields(pairs, shown, model, shown, solver if isinstance(solver, Langevin) else None, starts, seed)
    elif not sets:
        shown = [replace(pair, maps=[PoseMap("Starts and answer", pair.landscapes.get(PRIOR_ENERGY), solved=pair)])
                 for pair in shown]  # fmt: skip
    return [
        replace(pair, reason=reason, chosen=int(chosen[row]), rotation_errors=rotation[row],
                translation_errors=translation[row])
        for (row, reason), pair in zip(picks.items(), shown, strict=True)
    ]  # fmt: skip


def _is_quick(evaluation: Evaluation, pairs: int, draws: Draws) -> bool:
    """Whether the prior's landscapes of `pairs` pairs are quick to compute, judged by the evaluation's own passes."""
    cost = evaluation.metrics.compute()
    seconds, before = (cost["pairs"] * cost[f"{what}_per_pair"] for what in ("seconds", "network_passes"))
    latitude, longitude = landscape_grid()
    passes = 2 * pairs * len(draws.steps()) * len(latitude) * len(longitude)  # both directions
    return before > 0 and passes * seconds / before <= max(SECONDS, SHARE * seconds)


def pick_examples(
    errors: NDArray, objects: NDArray, names: Sequence[str], unique_answer: Sequence[bool | None]
) -> dict[int, str]:
    """Pick up to `MOST` rows by rotation `errors` `[P]` and `objects` `[P]` (indices), each with the reason.

    Picks the worst, median and best among objects with a unique answer (among all if none is labelled so), and the
    median among those without; then the worst of each remaining object, objects with a unique answer first, because
    their failures are the solver's. Rows are sorted by decreasing error; ties go to the earlier row.
    """
    failed = np.nan_to_num(errors, nan=np.inf)
    order, worst_first = (np.argsort(each, kind="stable").tolist() for each in (failed, -failed))
    unique = [unique_answer[index] for index in objects.tolist()]
    judged = [row for row in order if unique[row] is True]
    others = [row for row in order if unique[row] is False]
    among = f"of {len(judged)} pairs with a unique answer" if judged else f"of {len(order)} pairs"
    judged = judged or order
    picks = {max(judged, key=lambda row: failed[row]): f"worst {among}"}
    picks.setdefault(judged[(len(judged) - 1) // 2], f"median {among}")
    picks.setdefault(judged[0], f"best {among}")
    if others:
        picks.setdefault(others[(len(others) - 1) // 2], f"median of {len(others)} pairs without a unique answer")
    shown = {int(objects[row]) for row in picks}
    for row in sorted(worst_first, key=lambda row: unique[row] is False):
        index = int(objects[row])
        if index not in shown and len(picks) < MOST:
            shown.add(index)
            picks[row] = f"worst of {(objects == index).sum()} pairs of {words(names[index])}"
    return {row: picks[row] for row in sorted(picks, key=lambda row: (-failed[row], row))}


def save_examples(folder: Path, examples: Sequence[ShownPair]) -> None:
    """Replace the examples in `folder`; the JSON file is written last."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for number, example in enumerate(examples):
        for name, view in (("reference", example.reference), ("query", example.query)):
            image = Image.fromarray(view.image)
            image.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
            save_png(folder / f"{number}_{name}.png", image)
    content = {"about": ABOUT, "examples": [_record(example) for example in examples]}
    write_text(folder / FILE, json.dumps(content) + "\n")


def read_examples(folder: Path) -> list[ShownPair]:
    """Read the examples in `folder`; missing or damaged files raise as in `open`, `json` and Pillow."""
    content = json.loads((folder / FILE).read_text(encoding="utf-8"))
    return [_example(folder, number, entry) for number, entry in enumerate(content["examples"])]


def _record(example: ShownPair) -> dict[str, Any]:
    return {
        **{name: getattr(example, name) for name in ("object", "ambiguity", "reason")},
        **{
            side: {"file": view.file.name, "pose": _numbers(view.pose), "field_of_view": view.field_of_view}
            for side, view in (("reference", example.reference), ("query", example.query))
        },
        **{name: _numbers(getattr(example, name)) for name in ARRAYS},
        "chosen": example.chosen or 0,
        "landscapes": [
            {
                "name": name,
                "radius": round(each.radius, 5),
                **{part: _numbers(getattr(each, part).numpy()) for part in ("latitude", "longitude", "energy")},
            }
            for name, each in example.landscapes.items()
        ],
    }


def _example(folder: Path, number: int, entry: Mapping[str, Any]) -> ShownPair:
    def view(name: str) -> View:
        with Image.open(folder / f"{number}_{name}.png") as image:
            pixels = np.asarray(image.convert("RGB"))
        seen = entry[name]
        return View(
            Path(seen["file"]), pixels, _array(seen["pose"]), float(seen.get("field_of_view", View.field_of_view))
        )

    values: dict[str, Any] = {name: _array(entry[name]) for name in ARRAYS if entry[name] is not None}
    landscapes = {}
    for each in entry["landscapes"]:
        grid = {part: torch.from_numpy(_array(each[part])) for part in ("latitude", "longitude", "energy")}
        landscapes[str(each["name"])] = Landscape(radius=float(each["radius"]), **grid)
    values |= {name: str(entry[name]) for name in ("object", "ambiguity", "reason")}
    values |= {name: view(name) for name in ("reference", "query")}
    return ShownPair(chosen=int(entry["chosen"]), landscapes=landscapes, **values)


def _numbers(values: NDArray | None) -> Any:
    """Nested lists of numbers to six digits; null if not finite."""
    if values is None:
        return None
    rounded = np.vectorize(lambda value: float(f"{value:.6g}") if np.isfinite(value) else None, otypes=[object])
    return rounded(values).tolist()


def _array(values: Any) -> NDArray:
    """The array of nested lists; null becomes NaN."""
    return np.array(values, dtype=float)
