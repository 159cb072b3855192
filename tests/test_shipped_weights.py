"""The bundled prior and score model work out of the box, on unseen views of the embedded objects."""

from __future__ import annotations

import json
import math
import os
import re
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

import lp_framework
from lp_framework import cli, registry
from lp_framework.data.cache import decoded_views
from lp_framework.data.pairs import as_images
from lp_framework.data.views import read_views
from lp_framework.geometry import relative_pose
from lp_framework.models.checkpoints import SHIPPED
from lp_framework.solvers.base import Pairs

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
# The test views of every object are those of any other protocol, and no training view is used.
FEW_VIEWS = ("data.train_views=1", "data.test_views=5", "data.workers=1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("shipped")


@pytest.fixture(scope="module")
def landscape(folder) -> dict[str, Any]:
    """The result of `landscape` in an empty folder."""
    here, argv = Path.cwd(), sys.argv
    os.chdir(folder)
    try:
        sys.argv = ["lp", "landscape", *FEW_VIEWS, "noises=1", "timesteps=[300,700]", "hydra.run.dir=landscape"]
        assert cli.main() == 0
    finally:
        os.chdir(here)
        sys.argv = argv
    content: dict[str, Any] = json.loads((folder / "landscape" / "azimuth.json").read_text())
    return content


def test_the_weights_are_small_and_say_where_they_come_from():
    files = [file for file in SHIPPED.rglob("*") if file.is_file()]
    assert sum(file.stat().st_size for file in files if file.suffix == ".safetensors") < 10e6
    assert (SHIPPED / "tiny" / "model.safetensors").stat().st_size < 8e6
    for name in ("tiny", "score", "general"):
        assert {"config.yaml", "metrics.csv", "training.png"} <= {file.name for file in (SHIPPED / name).iterdir()}


def test_the_lowest_energy_is_at_the_true_azimuth(landscape):
    assert landscape["within_unique_answer"] >= 0.85


def test_twofold_objects_have_a_second_minimum_half_a_turn_away(landscape):
    twofold = [row for row in landscape["objects"] if row["ambiguity"] == "twofold"]
    assert len(twofold) == 3
    for row in twofold:
        first, second, *_ = row["minima"]
        assert abs(first["degrees"]) <= 15 and 180 - abs(second["degrees"]) <= 15, row["object"]


def test_the_relief_identifies_objects_without_a_unique_answer(landscape):
    relief = {answer: [row["relief"] for row in landscape["objects"] if row["unique_answer"] == answer]
              for answer in (True, False)}  # fmt: skip
    assert max(relief[False]) < 0.2 * min(relief[True])


def test_the_ambiguity_score_knows_the_classes(landscape):
    """Unlike the classes it goes by what the prior sees: some shapes without symmetry look alike from behind."""
    for row in landscape["objects"]:
        score = row["ambiguity_score"]
        assert score["unique_answer"] == row["unique_answer"], row["object"]
        assert (score["verdict"] == "continuous") == (not row["unique_answer"]), row["object"]
        assert row["ambiguity"] != "twofold" or score["verdict"] == "twofold", row["object"]
        assert score["flatness"] > 0.98 if score["verdict"] == "continuous" else score["flatness"] < 0.75
    verdicts = {row["object"]: row["ambiguity_score"]["verdict"] for row in landscape["objects"]}
    assert {verdicts[name] for name in ("duck", "robot", "watering_can")} == {"unique"}


@pytest.mark.parametrize("name", ["duck", "fire_engine", "tram"])
def test_generated_views_look_like_the_object_from_there(landscape, folder, name):
    """A view generated for the pose of each test view is nearest to that view, of all of them."""
    prior = lp_framework.load_prior("tiny")
    views = read_views(folder / "datasets" / "toy", name, "test")
    _, pixels = decoded_views(views.files, 64, folder / "cache")
    images, poses = as_images(torch.tensor(pixels)), views.poses.float()
    code = prior.encode(as_images(torch.tensor(decoded_views(views.files, 256, folder / "cache")[1])))
    source = code[torch.zeros(len(images), dtype=torch.long)]
    pose = relative_pose(poses[:1].expand_as(poses), poses)
    generated = prior.generate(source, pose, generator=torch.Generator().manual_seed(0))
    distance = torch.cdist(generated.flatten(1), images.flatten(1))
    assert (distance.argmin(dim=1) == torch.arange(len(images))).float().mean() >= 0.85
    assert distance.diagonal().square().mean() / images[0].numel() < 0.06  # mean square, of pixels in [-1, 1]


def test_the_score_model_finds_the_pose(landscape, folder):
    views = read_views(folder / "datasets" / "toy", "duck", "test")
    images = as_images(torch.tensor(decoded_views(views.files, 256, folder / "cache")[1]))
    model = lp_framework.load_model(SHIPPED / "score")
    solver = registry.build("solver", {"name": "langevin", "gamma": 0.0}, model=model)
    count = len(images)
    pairs = Pairs(images, torch.zeros(count - 1, dtype=torch.long), torch.arange(1, count), torch.arange(count - 1))
    starts = lp_framework.make_starts("grid").make(pairs, seed=0)
    poses = views.poses.float()
    truth = relative_pose(poses[:1].expand_as(poses), poses)[1:]
    turn = (solver.solve(pairs, starts, seed=0).answer()[:, 1] - truth[:, 1] + math.pi) % (2 * math.pi) - math.pi
    assert turn.abs().max() < math.radians(30)


def test_the_readmes_example_finds_the_pose(monkeypatch, capsys):
    (code,) = [block for block in re.findall(r"```python\n(.*?)```", README, re.DOTALL) if "estimate_pose" in block]
    monkeypatch.chdir(ROOT)
    exec(compile(code, "README.md", "exec"), {})
    latitude, longitude, probability = (float(part.rstrip("°")) for part in capsys.readouterr().out.split(", "))
    assert latitude == pytest.approx(10, abs=6) and longitude == pytest.approx(60, abs=6)  # as the README says
    assert probability > 0.9


def test_the_readme_shows_what_the_quickstart_estimates(lp):
    quickstart = (ROOT / "scripts" / "quickstart.sh").read_text()
    (images,) = re.findall(r'estimate "images=\[(.*?)\]"', quickstart)
    files = ",".join(str(ROOT / file) for file in images.split(","))
    out = lp("estimate", f"images=[{files}]", "hydra.run.dir=run").out
    shown = [
        line for line in README.splitlines() if line.startswith(("model: general", "example_0.png to", "the crop to"))
    ]
    assert len(shown) == 3 and all(line in out for line in shown)
    assert all(Path(file).stat().st_size < 50_000 for file in files.split(","))
