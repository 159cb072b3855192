"""What a page shows of a finished run of each command: a title, the most important numbers, and sections."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lp_framework.analysis.examples import EXAMPLES, read_examples
from lp_framework.analysis.shown import words
from lp_framework.errors import UserError
from lp_framework.evaluation.tables import RESULT, summary_rows
from lp_framework.report.parts import About, Record, RunPart, Sections, packed, read_rows, run_part, tried
from lp_framework.report.plots import (
    cameras_plot,
    errors_plot,
    frame_steps,
    losses_plot,
    map_plot,
    pair_cameras_plot,
    surface_plot,
)
from lp_framework.report.runs import Kind, saved_config
from lp_framework.viz.style import CLASS_COLOURS
from lp_framework.viz.training import read_losses

LARGEST = 4_000_000  # letters that the plots of one run's pairs may take; the last ones are left out beyond it
MOST_CAMERAS = 40
WORST = 20  # pairs in the table of the worst
POSE = ("latitude_degrees", "longitude_degrees", "radius")


# ---------------------------------------------------------------- eval


def evaluation_part(folder: Path) -> RunPart:
    """Of the folder of an `eval`."""
    return run_part(
        folder,
        RESULT,
        _about_evaluation,
        [
            ("Summary", "summary", lambda result: {"rows": summary_rows(result), "result": result}),
            ("Pairs, failures first", "pairs", partial(_pairs, folder)),
            ("Objects", "objects", lambda result: _objects(result, read_rows(folder / "pairs.csv"))),
            ("Errors", "errors", lambda _: _errors(read_rows(folder / "pairs.csv"))),
        ],
    )


def _about_evaluation(result: Record) -> About:
    config, unique = result["config"], result["metrics_unique_answer"]
    metrics, over = (result["metrics"], "all objects") if unique is None else (unique, "unique answer")
    median = metrics["rotation_error"]
    return (
        f"{words(config['solver']['name'])} on {config['data']['name']}",
        f"evaluation of {result['pairs']} pairs ({result['protocol']}), start={config['start']['name']}, "
        f"seed {result['seed']}",
        {
            **{f"{name}, {over}": f"{metrics[name]:.1%}" for name in ("R@5", "R@15", "R(R)@15")},
            f"median rotation error, {over}": "\N{INFINITY}" if median is None else f"{median:.1f}°",
            "pairs": str(result["pairs"]),
            "seconds a pair": f"{result['seconds_per_pair']:.3g}",
        },
    )


def _pairs(folder: Path, record: Record) -> dict[str, Any]:
    """The pairs that a run keeps beside its pictures, each with its plots (packed, by kind) and the steps they show."""
    if record.get("config", {}).get("pictures") is False:
        raise UserError("the run was made with pictures=false")
    examples = read_examples(folder / "pictures" / EXAMPLES)
    shown: list[dict[str, Any]] = []
    room = LARGEST
    for example in examples:
        kinds = {"map": map_plot, "cameras": pair_cameras_plot}
        if example.landscapes:
            kinds["surface"] = surface_plot
        plots = {kind: packed(draw(example)) for kind, draw in kinds.items()}
        room -= sum(map(len, plots.values()))
        if shown and room < 0:
            break
        shown.append({"example": example, "plots": plots, "steps": frame_steps(example)})
    return {"pairs": shown, "left_out": len(examples) - len(shown)}


def _objects(result: Record, rows: Sequence[Mapping[str, str]]) -> dict[str, Any]:
    found = {name: metrics for name, metrics in result["per_object"].items() if metrics is not None}
    order = sorted(found, key=lambda name: (found[name]["R(R)@15"], found[name].get("SR(R)@30", 0), name))
    return {
        "objects": {name: found[name] for name in order},
        "classes_of": {row["object"]: row["ambiguity"] for row in rows},
        "counts": Counter(row["object"] for row in rows),
    }


def _errors(rows: Sequence[Mapping[str, str]]) -> dict[str, Any]:
    rotation = np.array([float(row["rotation_error_degrees"]) for row in rows])
    classes = np.array([row["ambiguity"] for row in rows])
    figure = errors_plot({name: rotation[classes == name] for name in CLASS_COLOURS if name in classes})
    order = np.argsort(-np.nan_to_num(rotation, nan=math.inf), kind="stable")[:WORST]
    worst = [(rows[place], rotation[place], float(rows[place]["translation_error"])) for place in order]
    return {"figure": figure, "worst": worst}


# ---------------------------------------------------------------- train


def training_part(folder: Path) -> RunPart:
    """Of the folder of a `train`, which may not have finished."""
    sections = [
        ("Losses", "losses", lambda _: _losses(folder)),
        ("Last values", "last", lambda report: {"final": report["final"]}),
    ]
    return run_part(folder, "training.json", partial(_about_training, folder), sections)


def _about_training(folder: Path, report: Record) -> About:
    config = saved_config(folder / "config.yaml")
    losses, _ = read_losses(folder / "metrics.csv")
    best = {"best validation loss": f"{np.nanmin(losses['val/loss'].value):.4g}"} if "val/loss" in losses else {}
    over = (
        f"training over {report['epochs']} epochs, seed {report['seed']}"
        if report
        else "training that has not finished"
    )
    counts = {key: str(report[key]) for key in ("epochs", "steps") if key in report}
    return f"{words(config['model']['name'])} model, trained on {config['data']['name']}", over, best | counts


def _losses(folder: Path) -> dict[str, Any]:
    losses, rate = read_losses(folder / "metrics.csv")
    if not losses:
        raise UserError("no loss was logged")
    return {"figure": losses_plot(losses, rate)}


# ---------------------------------------------------------------- estimate


def estimate_part(folder: Path) -> RunPart:
    """Of the folder of an `estimate`."""
    sections = [("Cameras", "cameras", lambda _: _cameras(folder)), ("Poses", "poses", lambda _: _poses(folder))]
    return run_part(folder, RESULT, partial(_about_estimate, folder), sections)


def _about_estimate(folder: Path, result: Record) -> About:
    rows = read_rows(folder / "poses.csv")
    found = sum(row["valid"] == "True" for row in rows)
    return (
        f"Cameras by {words(result['config']['solver']['name'])}",
        "camera poses of photographs; the first is the reference",
        {"photographs": str(len(rows)), "with a pose": str(found), "seconds": f"{result['seconds']:.3g}"},
    )


def _cameras(folder: Path) -> dict[str, Any]:
    rows = [row for row in read_rows(folder / "poses.csv") if row["valid"] == "True"]
    if not rows:
        raise UserError("no photograph has a pose")
    shown = rows[:MOST_CAMERAS]
    poses = np.array([[float(row[key]) for key in POSE] for row in shown])
    poses[:, :2] = np.radians(poses[:, :2])
    figure = cameras_plot(poses, [_image(folder, row) for row in shown])
    return {"figure": figure, "shown": len(shown), "count": len(rows)}


def _poses(folder: Path) -> dict[str, Any]:
    rows = read_rows(folder / "poses.csv")
    keys = [*POSE, *(f"relative_{key}" for key in POSE)]
    poses = [[float(row[key]) for key in keys] if row["valid"] == "True" else None for row in rows]
    images = [tried(partial(_image, folder, row), None) for row in rows]
    names = [Path(row["file"]).name for row in rows]
    return {"rows": list(zip(names, images, poses, [row["energy"] for row in rows], strict=True))}


def _image(folder: Path, row: Mapping[str, str]) -> NDArray:
    """The prepared image `[S, S, 4]` of a row; only what lies in the run's own folder is read."""
    with Image.open(folder / "images" / Path(row["image"]).name) as image:
        return np.asarray(image.convert("RGBA"))


# ---------------------------------------------------------------- landscape


def landscape_part(folder: Path) -> RunPart:
    """Of the folder of a `landscape`: of one pair, or of a whole data set."""
    if (folder / "landscape.json").is_file():
        sections: Sections = [
            ("Landscape", "pairs", partial(_pairs, folder)),
            ("Pictures", "pictures", lambda _: _sheets(folder)),
        ]
        return run_part(folder, "landscape.json", _about_landscape, sections)
    return run_part(folder, "azimuth.json", _about_azimuths, [("Objects", "azimuths", lambda record: record)])


def _about_landscape(record: Record) -> About:
    files = " and ".join(Path(record[name]).name for name in ("reference", "query"))
    name = record["config"]["object"]
    numbers = {"minima": str(len(record["minima"])), "flatness along longitude": f"{record['flatness']:.2f}"}
    answer = next((each for each in record["descents"] if each["chosen"]), None)
    if answer is not None and answer["rotation_error"] is not None:
        numbers["rotation error of the answer"] = f"{answer['rotation_error']:.1f}°"
    return (
        f"Landscape of {files}" if name is None else f"Landscape of {words(name)}, {files}",
        "the energy of the prior over the relative pose of a pair, and the ways of a solver over it",
        numbers,
    )


def _sheets(folder: Path) -> dict[str, Any]:
    files = [folder / f"{name}.png" for name in ("landscape", "fields") if (folder / f"{name}.png").is_file()]
    if not files:
        raise UserError("there is no landscape.png")
    return {"files": files}


def _about_azimuths(record: Record) -> About:
    names = {"within": "least energy within 15°, all objects", "within_unique_answer": "the same, unique answer"}
    return (
        f"Landscapes of {record['config']['data']['name']}, prior {record['config']['prior']['name']}",
        "the energy of the prior around each object, all but the azimuth true",
        {label: f"{record[key]:.1%}" for key, label in names.items() if record.get(key) is not None},
    )


# By the command, with the heading of its runs in a table of several.
PARTS: Mapping[Kind, tuple[str, Callable[[Path], RunPart]]] = {
    "eval": ("Evaluations", evaluation_part), "train": ("Trainings", training_part),
    "estimate": ("Estimates", estimate_part), "landscape": ("Landscapes", landscape_part),
}  # fmt: skip
