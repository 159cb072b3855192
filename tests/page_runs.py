"""Synthetic folders of finished runs, made without models, for every command that writes a page."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from result_folders import metrics, write_job, write_result

from lp_framework.analysis.examples import EXAMPLES, save_examples
from lp_framework.analysis.landscapes import Landscape, landscape_grid
from lp_framework.analysis.pairs import ShownPair, View
from lp_framework.evaluation.tables import PAIR_COLUMNS

NASTY = "</script><img src=x onerror=alert(1)>&_$cup"
OBJECTS = {NASTY: "unique", "red_mug": "twofold", "vase": "continuous"}
ERRORS = {NASTY: 170.0, "red_mug": 3.0, "vase": 80.0}
STEPS, STARTS = 20, 4


def example(
    name: str = "red_mug", error: float = 3.0, reason: str = "worst of 4 pairs", steps: int = STEPS
) -> ShownPair:
    """Four starts on straight lines to the answer, `error` degrees of longitude from the truth, in two basins."""
    latitude, longitude = landscape_grid()
    truth = np.array([0.3, 2.0, 0.1])
    away = longitude - truth[1]
    energy = 2.0 - away.cos() - 0.8 * (2 * away).cos() + (latitude[:, None] - truth[0]).square()
    starts = np.array([[0.0, place * math.pi / 2, 0.0] for place in range(STARTS)])
    ends = np.repeat(truth[None] + [0.0, math.radians(error), 0.0], STARTS, axis=0)
    share = np.linspace(0, 1, steps + 1)[None, :, None]
    shade = np.random.default_rng(0).integers(0, 255, (24, 24, 3), dtype=np.uint8)
    return ShownPair(
        name, OBJECTS.get(name, "unique"), reason, View(Path("000.png"), shade, np.array([0.1, 1.0, 1.4])),
        View(Path("001.png"), shade[::-1].copy(), np.array([0.4, 3.0, 1.5])), truth, starts,
        (1 - share) * starts[:, None] + share * ends[:, None], ends, np.array([2.0, 1.0, 3.0, np.nan]), chosen=1,
        rotation_errors=np.full(STARTS, error), translation_errors=np.full(STARTS, 0.1),
        landscapes={"energy of the prior": Landscape(latitude, longitude, 0.1, energy),
                    "length of the model's score": Landscape(latitude, longitude, 0.1, energy.sqrt())},
    )  # fmt: skip


def write_evaluation(folder: Path, seed: int = 0) -> Path:
    """What an `eval` on three objects leaves."""
    recalls = {NASTY: 0.1, "red_mug": 0.9, "vase": 0.4}
    write_result(
        folder, {"seed": seed}, per_object={name: metrics(recall) for name, recall in recalls.items()},
        per_ambiguity={kind: metrics(0.5) for kind in OBJECTS.values()}, versions={"torch": "2.13"}, unanswered=0.0,
    )  # fmt: skip
    with (folder / "pairs.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(PAIR_COLUMNS)
        for name, error in ERRORS.items():
            for place in range(4):
                errors = ["nan", "nan"] if place == 3 else [error + place, 0.1]
                writer.writerow([name, OBJECTS[name], "000.png", f"{place}.png", *errors, 0, 1.0, 2.0, 0.1])
    examples = [example(name, error) for name, error in sorted(ERRORS.items(), key=lambda item: -item[1])]
    save_examples(folder / "pictures" / EXAMPLES, examples)
    return folder


def write_training(folder: Path) -> Path:
    """What a `train` leaves."""
    write_job(folder, command="train")
    (folder / "config.yaml").write_text("model: {name: score}\ndata: {name: toy}\nseed: 0\n")
    lines = ["epoch,lr-Adam,step,train/loss,val/loss"]
    lines += [f"0,{0.01 / (step + 1)},{step},{1 / (step + 1)}," for step in range(0, 100)]
    lines += [f"{epoch},,{50 * epoch + 49},,{0.5 / (epoch + 1)}" for epoch in range(2)]
    (folder / "metrics.csv").write_text("\n".join(lines) + "\n")
    report = {"seed": 0, "epochs": 2, "steps": 100, "final": {"val/loss": 0.25}, "versions": {"torch": "2.13"}}
    (folder / "training.json").write_text(json.dumps(report))
    return folder


def write_estimate(folder: Path) -> Path:
    """What an `estimate` of three photographs leaves, one of them without a pose."""
    write_job(folder, command="estimate")
    (folder / "images").mkdir()
    rows = []
    for place in range(3):
        pixels = np.full((64, 64, 4), 255, dtype=np.uint8)
        pixels[16:48, 16:48, :3] = [200, 60 * place, 40]
        Image.fromarray(pixels).save(folder / "images" / f"{place:03d}.png")
        pose = [10.0 * place, 60.0 * place, 1.4]
        rows.append(
            [f"photos/{place}.jpg", f"images/{place:03d}.png", *pose, *pose, "" if place == 0 else 0.5, place != 2]
        )
    names = ("latitude_degrees", "longitude_degrees", "radius")
    with (folder / "poses.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["file", "image", *names, *(f"relative_{name}" for name in names), "energy", "valid"])
        writer.writerows(rows)
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": math.radians(49.1), "frames": []}))
    result = {"seconds": 1.5, "config": {"solver": {"name": "two_stage"}}, "versions": {"torch": "2.13"}}
    (folder / "results.json").write_text(json.dumps(result))
    return folder


def write_overview(folder: Path) -> Path:
    """What a `landscape` of a data set leaves."""
    write_job(folder, command="landscape")
    degrees = [float(each) for each in range(-165, 181, 15)]
    objects = [
        {"object": name, "ambiguity": kind, "within": 0.5, "relief": 0.8, "pairs": 6, "degrees": degrees,
         "minima": [{"degrees": 0.0, "height": 0.0}], "energy": [1 - math.cos(math.radians(each)) for each in degrees],
         "ambiguity_score": {"flatness": 0.2, "verdict": "unique"}}
        for name, kind in OBJECTS.items()
    ]  # fmt: skip
    config = {"data": {"name": "toy"}, "prior": {"name": "tiny"}}
    record = {"objects": objects, "within": 0.5, "within_unique_answer": None, "config": config, "versions": {}}
    (folder / "azimuth.json").write_text(json.dumps(record))
    return folder


def write_pair_landscape(folder: Path) -> Path:
    """What a `landscape` of one pair leaves."""
    write_job(folder, command="landscape")
    save_examples(folder / "pictures" / EXAMPLES, [example()])
    Image.new("RGB", (40, 20), "white").save(folder / "landscape.png")
    record = {
        **{"reference": "a/000.png", "query": "a/001.png", "minima": [{}, {}], "flatness": 0.2},
        **{"descents": [{"chosen": True, "rotation_error": 3.0}], "config": {"object": "red_mug"}, "versions": {}},
    }
    (folder / "landscape.json").write_text(json.dumps(record))
    return folder


WRITERS = {
    "eval": write_evaluation, "train": write_training, "estimate": write_estimate, "landscape": write_overview,
    "pair": write_pair_landscape,
}  # fmt: skip


def torch_equal(left: Landscape, right: Landscape) -> bool:
    """Whether two landscapes are the same to the digits that are kept."""
    pairs = zip((*left[:2], left.energy), (*right[:2], right.energy), strict=True)
    return all(torch.allclose(a.double(), b.double(), rtol=1e-5) for a, b in pairs)
