"""`landscape`: what it writes of a pair of views, of photographs, and of all objects."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_runs import Commands

from lp_framework.analysis.landscapes import Landscape
from lp_framework.analysis.pairs import ShownPair, View, with_solution
from lp_framework.data.views import read_views
from lp_framework.geometry import relative_pose
from lp_framework.solvers.base import Cost, Solution
from lp_framework.viz.maps import ends_in_words

COARSE = ("latitude_step_degrees=40", "longitude_step_degrees=60", "timesteps=[500]")
SHORT = ("solver.steps=3", "reference=0", "query=2", *COARSE)


@pytest.fixture(scope="module")
def commands(tmp_path_factory):
    return Commands(tmp_path_factory.mktemp("landscape"))


@pytest.fixture(scope="module")
def pair(commands):
    ran = commands.here("pair", "landscape", "object=tram", *SHORT)
    assert ran.status == 0, ran.err
    return ran


def arrays(ran) -> dict[str, np.ndarray]:
    with np.load(ran.folder / "landscape.npz") as content:
        return dict(content)


# ---------------------------------------------------------------- a pair of views


def test_the_files_of_a_pair(pair):
    names = {file.name for file in pair.folder.iterdir()}
    assert {"landscape.npz", "landscape.json"} <= names
    assert {f"{name}.{kind}" for name in ("landscape", "surface", "fields") for kind in ("png", "pdf")} <= names
    assert f"{pair.folder.name}/landscape.json" in pair.out and "landscape.png, surface.png, fields.png" in pair.out


def test_the_arrays_of_a_pair(commands, pair):
    content = arrays(pair)
    shapes = {name: each.shape for name, each in content.items()}
    assert shapes == {
        "latitude": (4,), "longitude": (6,), "radius": (), "energy": (4, 6), "trajectories": (4, 4, 3), "truth": (3,),
        "model_score": (4, 6, 3),
    }  # fmt: skip
    poses = read_views(commands.folder / "views", "tram", "test").poses
    np.testing.assert_allclose(content["truth"], relative_pose(poses[0], poses[2]), rtol=1e-5)
    assert content["radius"] == pytest.approx(content["truth"][2])
    assert all(np.isfinite(each).all() for each in content.values())


def test_the_summary_of_a_pair_is_that_of_its_arrays(pair):
    content, summary = arrays(pair), pair.json("landscape.json")
    landscape = Landscape(*(torch.tensor(content[name]) for name in ("latitude", "longitude", "radius", "energy")))
    assert [each["energy"] for each in summary["minima"]] == [each.energy for each in landscape.minima()]
    for shown, minimum in zip(summary["minima"], landscape.minima(), strict=True):
        assert math.radians(shown["longitude"]) == pytest.approx(minimum.longitude)
    assert summary["flatness"] == pytest.approx(landscape.flatness())
    assert [each["start_longitude"] for each in summary["descents"]] == pytest.approx([0, 90, 180, 270])
    ends = np.array([each["end"] for each in summary["descents"]])
    np.testing.assert_allclose(ends[:, 0], np.rad2deg(content["trajectories"][:, -1, 0]), rtol=1e-4, atol=1e-4)
    assert [each["chosen"] for each in summary["descents"]].count(True) == 1
    assert all(0 <= each["rotation_error"] <= 180 for each in summary["descents"])
    assert summary["reference"].endswith("tram/test/rgb/000.png") and summary["query"].endswith("002.png")
    assert summary["checkpoint"].endswith("model.safetensors") and summary["seed"] == 0


def test_both_stages_on_one_map(commands, no_drawing):
    ran = commands.here(
        "stages", "landscape", "object=tram", "query=2", "solver=two_stage", "solver.iterations=2",
        "solver.refinement_steps=3", "start=random", "start.count=2", *COARSE,
    )  # fmt: skip
    assert ran.status == 0, ran.err
    assert arrays(ran)["trajectories"].shape == (2, 2 + 3 + 1, 3)


def test_a_pair_of_photographs_has_no_truth(commands, no_drawing):
    views = commands.folder / "views" / "tram" / "test" / "rgb"
    ran = commands.here(
        "photographs", "landscape", f"images=[{views / '000.png'},{views / '001.png'}]", "crop=false",
        "data.path=nowhere", "solver.steps=3", *COARSE,
    )  # fmt: skip
    assert ran.status == 0, ran.err
    assert "truth" not in arrays(ran) and arrays(ran)["radius"] == 0 and "model_score" not in arrays(ran)
    assert not (ran.folder / "fields.png").exists() and (ran.folder / "landscape.png").exists()
    summary = ran.json("landscape.json")
    assert summary["truth"] is None and summary["checkpoint"] is None
    assert {each["rotation_error"] for each in summary["descents"]} == {None}


def test_a_start_without_a_final_pose_is_dropped():
    starts = torch.tensor([[[0.0, 0, 0], [0, 1, 0], [0, 2, 0]]])
    poses = starts.clone()
    poses[0, 1] = math.nan
    cost = Cost(0, 0.0)
    solution = Solution(poses, torch.tensor([[1.0, math.nan, 0.5]]), poses.isfinite().all(-1), torch.tensor([2]), cost)
    view = View(Path("a.png"), np.zeros((8, 8, 3), dtype=np.uint8), np.array([0.0, 0.0, 1.5]))
    pair = ShownPair("", "", "", view, view, np.array([0.0, 2.0, 0.0]))
    found = with_solution(pair, solution, starts, 0).finite()
    assert found.start_longitudes() == pytest.approx([0, math.degrees(2)]) and found.chosen == 1
    assert found.rotation_errors == pytest.approx([math.degrees(2), 0], abs=1e-3)
    assert ends_in_words(found) == [("0°", "115° off"), ("115°", "0° off")] and found.energies.tolist() == [1.0, 0.5]
    own = with_solution(replace(pair, truth=None), solution, starts[:, :2], 0).finite()
    assert own.starts is None and np.isnan(own.rotation_errors).all() and ends_in_words(own) == [("", "")] * 2
    assert own.start_longitudes() == [None, None]
    lost = with_solution(pair, replace(solution, chosen=torch.tensor([1])), starts, 0).finite()
    assert lost.chosen is None and lost.failed and len(lost.ends) == 2


# ---------------------------------------------------------------- all objects


def test_the_overview_has_an_ambiguity_for_every_object(commands):
    ran = commands.here("overview", "landscape", "azimuths=4", *COARSE)
    assert ran.status == 0, ran.err
    rows = ran.json("azimuth.json")["objects"]
    assert [row["object"] for row in rows] == ["cup", "mug", "tram", "vase"]
    for row in rows:
        score = row["ambiguity_score"]
        assert score["verdict"] in ("unique", "twofold", "several", "continuous") and 0 <= score["flatness"] <= 1
        assert isinstance(score["unique_answer"], bool) and score["minima"] >= 1
        assert score["verdict"] in ran.out
    assert "without a unique answer for this prior: " in ran.out or all(
        row["ambiguity_score"]["unique_answer"] for row in rows
    )


# ---------------------------------------------------------------- mistakes


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (["object=tran"], "the data set has no object 'tran'; did you mean 'tram'?"),
        (["object=tram", "query=4"], "object 'tram' has test views 0 to 3; there is no query 4"),
        (["object=tram", "query=0"], "reference and query must be two different views, got 0 for both"),
        (["object=tram", "query=last"], "query must be the number of a test view, got last"),
        (["object=tram", "images=[views,plugins]"], "give object=NAME for views of the data set or images="),
        (["images=[views,views,views]"], "images: a landscape needs two files, got 3"),
        (["images=[a.png,b.png]"], "images=a.png: there is no such file or folder"),
        (["query=3"], "query is for the landscape of a pair; also give object=NAME or images=[A.png,B.png]"),
        (["solver.steps=3"], "solver.steps is for the landscape of a pair; also give object=NAME"),
        (["object=tram", "query=1", "longitude_step_degrees=50"], "longitude_step_degrees must divide 360"),
        (["object=tram", "query=1", "timesteps=[]"], "timesteps must be a list of one or more whole numbers, got []"),
        (["object=tram", "query=1", "timesteps=[1000]"], "this prior has timesteps 0 to 999, got 1000"),
        (["object=tram", "query=1", "noises=0"], "noises must be a whole number, at least 1, got 0"),
        (["object=tram", "query=1", "batch=none"], "batch must be a whole number, at least 1, got none"),
        (
            ["object=tram", "query=1", "latitude_step_degrees=few"],
            "latitude_step_degrees=few does not fit; expected float",
        ),
        (["azimuths=1"], "azimuths must be a whole number, at least 2, got 1"),
        (["latitude_step_degrees=100"], "latitudes need a limit between 0 and 180 degrees and a step no larger"),
    ],
)
def test_mistakes(commands, settings, sentence):
    assert commands.here("mistake", "landscape", *settings).error.startswith(sentence)


def test_the_pictures_can_be_opened(pair):
    for name in ("landscape", "surface", "fields"):
        with Image.open(pair.folder / f"{name}.png") as picture:
            assert picture.width > 800 and np.asarray(picture).std() > 10
