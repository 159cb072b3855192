"""The results that ID-Pose's program writes, judged by our metrics.

    python -m lp_framework.report.idpose_results RESULTS VIEWS

RESULTS is its folder of outputs, `<object>_<views>/pose.json`, or one of JSON files that have such names in theirs;
VIEWS is the data in its layout (`data=omni3d`). A file has the anchor view, our reference, and for each other view
`rel_sph`, the relative spherical pose in Zero123's conventions: polar angle from the pole, azimuth, and radius in
Zero123's units, in which the anchor stands at 1.85.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from torch import Tensor

from lp_framework.data.sets.omni3d import RADIUS, omni3d_cameras, omni3d_objects
from lp_framework.errors import UserError
from lp_framework.evaluation.metrics import PoseMetrics
from lp_framework.evaluation.tables import summary_rows, terminal_table
from lp_framework.geometry import apply_relative_pose, camera_to_world, rotation_error, translation_error, view_pose
from lp_framework.solvers.base import Cost, Solution


@dataclass(frozen=True)
class IDPoseResults:
    """P pairs of views: their object, reference and query by name, and the solution, of one start a pair."""

    objects: list[str]
    references: list[str]
    queries: list[str]
    solution: Solution


def read_idpose_results(folder: str | Path, objects: Sequence[str]) -> IDPoseResults:
    """The results for `objects` in a folder. Energies are not on record: all are 0.

    Raises `UserError` naming the file that is malformed or about no known object.
    """
    folder = Path(folder)
    files = sorted([*folder.glob("*.json"), *folder.glob("*/pose.json")])
    if not files:
        raise UserError(f"{folder}: holds no results of ID-Pose; looked for {folder}/*/pose.json and {folder}/*.json")
    rows = [row for file in files for row in _pairs(file, objects)]
    poses = torch.stack([row[3] for row in rows])[:, None]
    solution = Solution(
        poses=poses,
        energies=torch.zeros(len(rows), 1),
        valid=poses.isfinite().all(-1),
        chosen=torch.zeros(len(rows), dtype=torch.int64),
        cost=Cost(network_passes=0, seconds=0.0),
    )
    return IDPoseResults([row[0] for row in rows], [row[1] for row in rows], [row[2] for row in rows], solution)


def _pairs(file: Path, objects: Sequence[str]) -> list[tuple[str, str, str, Tensor]]:
    label = file.parent.name if file.name == "pose.json" else file.stem
    try:
        content = json.loads(file.read_bytes())
        anchor = str(content["anchor_vid"])
        found = {
            str(view): torch.tensor(entry["rel_sph"], dtype=torch.float64)
            for view, entry in content["obs"].items()
            if str(view) != anchor
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise UserError(
            f"{file}: needs anchor_vid, and obs with rel_sph for each other view ({type(error).__name__}: {error})"
        ) from error
    if not found or any(pose.shape != (3,) for pose in found.values()):
        raise UserError(f"{file}: needs a rel_sph of three numbers for each other view")
    named = [name for name in objects if f"_{label}".find(f"_{name}_{anchor}+") >= 0]
    if not named:
        raise UserError(f"{file}: its name tells none of the objects {', '.join(objects)}")
    # Polar angles are counted from the pole, latitudes from the equator.
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    return [(max(named, key=len), anchor, view, pose * flip) for view, pose in found.items()]


def evaluate_idpose(results: str | Path, views: str | Path) -> dict[str, Any]:
    """Metrics as `PoseMetrics.compute` gives them, over all pairs of the results.

    Of the scene, scaled so that the reference stands at 1.85; the true camera is the one on record.
    """
    names = omni3d_objects(views)
    found = read_idpose_results(results, names)
    cameras = {name: omni3d_cameras(views, name) for name in set(found.objects)}
    pairs = list(zip(found.objects, found.references, found.queries, strict=True))
    for name, *both in pairs:
        for view in both:
            if view not in cameras[name]:
                raise UserError(
                    f"{results}: has view {view} of '{name}', but {views}/{name}/poses/{view}.npy is missing"
                )
    reference = torch.stack([cameras[name][view] for name, view, _ in pairs])
    query = torch.stack([cameras[name][view] for name, _, view in pairs])
    scale = RADIUS / reference[:, :3, 3].norm(dim=-1)
    for camera in (reference, query):
        camera[:, :3, 3] *= scale[:, None]
    predicted = camera_to_world(apply_relative_pose(view_pose(reference)[:, None], found.solution.poses))
    true = query[:, None].expand_as(predicted)
    metrics = PoseMetrics(names, ["unlabelled"] * len(names), [None] * len(names))
    metrics.update(
        torch.arange(len(pairs)),
        torch.tensor([names.index(name) for name in found.objects]),
        rotation_error(predicted, true),
        translation_error(predicted, true),
        found.solution.chosen,
        found.solution.answer(),
    )
    result: dict[str, Any] = metrics.compute()
    return result


def main(arguments: Sequence[str]) -> int:
    """Print the row of `RESULTS VIEWS`."""
    if len(arguments) != 2:
        print("usage: python -m lp_framework.report.idpose_results RESULTS VIEWS", file=sys.stderr)
        return 2
    try:
        result = evaluate_idpose(*arguments)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    rows = [
        (f"ID-Pose, {result['pairs']} pairs" if name == "all objects" else name, row)
        for name, row in summary_rows(result)
    ]
    Console(width=120).print(terminal_table(f"{arguments[0]} (units: reference radius {RADIUS})", rows))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
