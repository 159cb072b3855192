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
from pathlib import Path
from typing import Any, NamedTuple

import torch
from rich.console import Console
from torch import Tensor

from lp_framework.data.sets.omni3d import RADIUS, Omni3DData, omni3d_cameras
from lp_framework.errors import UserError
from lp_framework.evaluation.metrics import PoseMetrics, SolvedBatch
from lp_framework.evaluation.tables import summary_rows, terminal_table
from lp_framework.geometry import apply_relative_pose, camera_to_world, rotation_error, translation_error, view_pose


class IDPosePair(NamedTuple):
    """A pair of an object's views by name, and the relative pose `[3]` (radians, Zero123's units; float64) found."""

    object: str
    reference: str
    query: str
    pose: Tensor


def read_idpose_results(folder: str | Path, objects: Sequence[str]) -> list[IDPosePair]:
    """The results for `objects` in a folder; `UserError` names a file that is malformed or about no known object."""
    files = sorted([*Path(folder).glob("*.json"), *Path(folder).glob("*/pose.json")])
    if not files:
        raise UserError(f"{folder}: holds no results of ID-Pose; looked for {folder}/*/pose.json and {folder}/*.json")
    return [pair for file in files for pair in _pairs(file, objects)]


def _pairs(file: Path, objects: Sequence[str]) -> list[IDPosePair]:
    label = file.parent.name if file.name == "pose.json" else file.stem
    # Polar angles are counted from the pole, latitudes from the equator.
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    try:
        content = json.loads(file.read_bytes())
        anchor = str(content["anchor_vid"])
        others = {str(view): entry for view, entry in content["obs"].items() if str(view) != anchor}
        poses = {view: torch.tensor(entry["rel_sph"], dtype=torch.float64) for view, entry in others.items()}
        if not poses or any(pose.shape != (3,) for pose in poses.values()):
            raise ValueError("three numbers each are wanted")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        told = f"{type(error).__name__}: {error}"
        raise UserError(f"{file}: needs anchor_vid, and obs with rel_sph for each other view ({told})") from error
    named = [name for name in objects if f"_{name}_{anchor}+" in f"_{label}"]
    if not named:
        raise UserError(f"{file}: its name tells none of the objects {', '.join(objects)}")
    return [IDPosePair(max(named, key=len), anchor, view, pose * flip) for view, pose in poses.items()]


def evaluate_idpose(results: str | Path, views: str | Path) -> dict[str, Any]:
    """Metrics as `PoseMetrics.compute` gives them, over all pairs, in units where the reference stands at 1.85."""
    names = Omni3DData(str(views)).names()
    pairs = read_idpose_results(results, names)
    cameras = {name: omni3d_cameras(views, name) for name in {pair.object for pair in pairs}}
    for name, *both, _ in pairs:
        if missing := {*both} - {*cameras[name]}:
            raise UserError(f"{results}: has views whose {views}/{name}/poses/{missing.pop()}.npy is missing")
    reference = torch.stack([cameras[pair.object][pair.reference] for pair in pairs])
    query = torch.stack([cameras[pair.object][pair.query] for pair in pairs])
    scale = RADIUS / reference[:, :3, 3].norm(dim=-1, keepdim=True)
    reference[:, :3, 3] *= scale
    query[:, :3, 3] *= scale
    poses = torch.stack([pair.pose for pair in pairs])
    predicted = camera_to_world(apply_relative_pose(view_pose(reference), poses))
    metrics = PoseMetrics(names, ["unlabelled"] * len(names), [None] * len(names))
    metrics.update(
        SolvedBatch(
            pair=torch.arange(len(pairs)),
            object=torch.tensor([names.index(pair.object) for pair in pairs]),
            rotation=rotation_error(predicted, query)[:, None],
            translation=translation_error(predicted, query)[:, None],
            chosen=torch.zeros(len(pairs), dtype=torch.int64),
            answer=poses,
            probability=torch.full((len(pairs),), torch.nan, dtype=torch.float64),
            seconds=0.0,
            passes=0,
        )
    )
    result: dict[str, Any] = metrics.compute()
    return result


def main(arguments: Sequence[str]) -> int:
    """Print the row of `RESULTS VIEWS`."""
    try:
        if len(arguments) != 2:
            raise UserError("give RESULTS and VIEWS: python -m lp_framework.report.idpose_results RESULTS VIEWS")
        result = evaluate_idpose(*arguments)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    rows = summary_rows(result)
    rows[0] = (f"ID-Pose, {result['pairs']} pairs", rows[0][1])
    Console(width=120).print(terminal_table(f"{arguments[0]} (units: reference radius {RADIUS})", rows))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
