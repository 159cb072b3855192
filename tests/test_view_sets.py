"""Sets of several images: their enumeration, their batches, and `eval views=...`."""

from __future__ import annotations

import csv
import html
import math
from collections import Counter

import numpy as np
import pytest
import torch
from tiny_runs import OBJECTS, Commands, Ran
from view_folders import write_objects

from lp_framework.analysis.examples import read_examples
from lp_framework.data.module import PairDataModule
from lp_framework.data.views import RenderingsData
from lp_framework.errors import UserError
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.solvers.base import Cost, Pairs, Solution, Solver, ViewSets, ViewSolution
from lp_framework.solvers.starts import Random

TEST_VIEWS = 5


@pytest.fixture(scope="module")
def commands(tmp_path_factory, trained) -> Commands:
    return Commands(tmp_path_factory.mktemp("view_sets"), test_views=TEST_VIEWS, trained=trained)


@pytest.fixture
def data(tmp_path) -> PairDataModule:
    write_objects(tmp_path / "views", {"cup": "unique", "vase": "continuous"}, train=3, test=TEST_VIEWS)
    return PairDataModule(RenderingsData(str(tmp_path / "views")), str(tmp_path / "cache"), 16, 40, 3, 0)


class Remembering(Solver):
    """Keeps what it is asked; its answer for an image is that image's number in the batch, the same for each start."""

    def __init__(self) -> None:
        self.asked: list[tuple[ViewSets, torch.Tensor]] = []

    def solve(self, pairs: Pairs, starts: torch.Tensor, seed: int) -> Solution:
        raise AssertionError("a set is solved as a set")

    def solve_views(self, view_sets: ViewSets, starts: torch.Tensor, seed: int) -> ViewSolution:
        self.asked.append((view_sets, starts))
        sets, views = view_sets.views.shape
        poses = view_sets.views[:, 1:, None].expand(-1, -1, 3).float()
        return ViewSolution(
            poses, torch.zeros(sets, views, views), torch.ones(sets, dtype=torch.bool), Cost(sets, sets / 10)
        )


def pair_rows(ran: Ran) -> list[dict[str, str]]:
    with (ran.folder / "pairs.csv").open() as file:
        return list(csv.DictReader(file))


# ---------------------------------------------------------------- the protocol


@pytest.mark.parametrize("views", [2, 3, TEST_VIEWS])
def test_every_view_is_once_at_each_place_and_the_next_ones_follow_it(data, views):
    sets = data.table("test").view_sets(views)
    assert sets.shape == (2 * TEST_VIEWS, views)
    for place in range(views):
        assert sorted(sets[:, place]) == list(range(2 * TEST_VIEWS))
    for row in sets:
        own = row[0] // TEST_VIEWS * TEST_VIEWS
        assert row.tolist() == [own + (row[0] - own + place) % TEST_VIEWS for place in range(views)]


def test_sets_of_all_views_have_all_ordered_pairs(data):
    sets = data.table("test").view_sets(TEST_VIEWS)
    found = {(row[0], other) for row in sets.tolist() for other in row[1:]}
    assert found == {tuple(pair) for pair in data.table("test").pairs("ordered").tolist()}


def test_a_batch_holds_whole_sets(data):
    data.evaluate_on("ordered", batch_pairs=10, views=4)
    data.prepare_data()
    batches = list(data.test_dataloader())
    assert [len(batch) for batch in batches] == [9, 9, 9, 3]  # three sets of three pairs, not ten pairs
    wanted = data.table("test").view_sets(4)
    found = []
    for batch in batches:
        reference, query = (side.view(-1, 3) for side in (batch.reference, batch.query))
        assert (reference == reference[:, :1]).all()
        found += [[*row[0].tolist(), *row[1:, 1].tolist()] for row in batch.pairs.view(-1, 3, 2)]
        assert all(len(set(row.tolist())) == 3 for row in query)
    assert found == wanted.tolist()
    data.evaluate_on("ordered", 0)
    assert sum(len(batch) for batch in data.test_dataloader()) == 2 * TEST_VIEWS * (TEST_VIEWS - 1)


def test_a_solver_gets_sets_and_its_answers_are_returned_per_image(data):
    data.evaluate_on("ordered", views=3)
    data.prepare_data()
    (batch,) = data.test_dataloader()
    evaluation = Evaluation(Remembering(), Random(2), seed=3, views=3)
    evaluation.reset_metrics(data.table("test"))
    evaluation.test_step(batch, 0)
    ((asked, starts),) = evaluation.solver.asked
    assert torch.equal(asked.images, batch.images)
    assert asked.views.tolist() == data.table("test").view_sets(3).tolist()
    assert len(set(asked.ids.tolist())) == 2 * TEST_VIEWS
    assert starts.shape == (2 * TEST_VIEWS, 2, 2, 3)
    rows = evaluation.metrics.rows()
    for (_, other), answer in zip(rows["pair"].tolist(), rows["answer"].tolist(), strict=True):
        assert answer == [other] * 3
    result = evaluation.metrics.compute()
    assert result["pairs"] == 2 * 2 * TEST_VIEWS
    assert result["seconds_per_pair"] == pytest.approx(0.05)
    assert result["network_passes_per_pair"] == pytest.approx(0.5)


def test_a_sets_id_is_that_of_its_images_wherever_it_is_evaluated(data):
    data.evaluate_on("ordered", views=3)
    data.prepare_data()
    table, ids = data.table("test"), []
    order = [7, 2, 0]
    for chosen in (range(2 * TEST_VIEWS), order):
        sets = table.view_sets(3)[list(chosen)]
        pairs = np.stack([np.repeat(sets[:, :1], 2, axis=1), sets[:, 1:]], axis=-1).reshape(-1, 2)
        evaluation = Evaluation(Remembering(), Random(2), seed=0, views=3)
        evaluation.reset_metrics(table)
        evaluation.test_step(data.data("test")[pairs], 0)
        ((asked, starts),) = evaluation.solver.asked
        ids.append((asked.ids, starts))
    assert torch.equal(ids[1][0], ids[0][0][order])
    assert torch.equal(ids[1][1], ids[0][1][order])


@pytest.mark.parametrize("views", [1, 9, 2.5, "many"])
def test_how_many_images_there_may_be(data, views):
    with pytest.raises(UserError, match=f"views must be 2 to 8 images, or null for pairs; got {views}"):
        data.evaluate_on("ordered", views=views)


# ---------------------------------------------------------------- the command


def test_a_solver_of_pairs_gives_each_image_the_answer_of_its_pair(commands):
    ran = commands.here("sets", "eval", "checkpoint=./score", "solver.gamma=0", "views=3", "pictures=true")
    assert (ran.status, ran.err) == (0, "")
    ordered = commands.here("ordered", "eval", "checkpoint=./score", "solver.gamma=0")
    rows, results = pair_rows(ran), ran.json()
    assert (results["protocol"], results["config"]["views"]) == ("view_sets", 3)
    assert results["pairs"] == len(rows) == len(OBJECTS) * TEST_VIEWS * 2
    assert set(Counter((row["object"], row["reference"]) for row in rows).values()) == {2}
    by_pair = {(row["object"], row["reference"], row["query"]): row for row in pair_rows(ordered)}
    for row in rows:
        wanted = by_pair[row["object"], row["reference"], row["query"]]
        for key in ("rotation_error_degrees", "translation_error", "latitude_degrees", "longitude_degrees"):
            assert float(row[key]) == pytest.approx(float(wanted[key]), abs=0.02)
    metrics = results["metrics"]
    assert all(metrics[f"S{name}"] == metrics[name] for name in ("R@30", "R(R)@5", "R(R)@15", "R(R)@30"))
    rotation = np.array([float(row["rotation_error_degrees"]) for row in rows])
    assert metrics["R(R)@30"] == pytest.approx((rotation <= 30).mean())
    assert f"{len(rows)} poses in sets of 3 images" in ran.out
    assert {file.stem for file in (ran.folder / "pictures").iterdir()} == {"errors", "objects", "examples"}


def test_the_joint_solver_from_the_command_line(commands):
    settings = ("checkpoint=./score", "solver=multiview", "solver.refinement_steps=10", "views=4", "start=random")
    ran = commands.here("joint", "eval", *settings, "pictures=true")
    assert ran.status == 0, ran.err
    assert ran.json()["pairs"] == len(OBJECTS) * TEST_VIEWS * 3
    again = commands.here("again", "eval", *settings)
    assert (again.folder / "pairs.csv").read_bytes() == (ran.folder / "pairs.csv").read_bytes()
    by_pair = {(row["object"], row["reference"], row["query"]): row for row in pair_rows(ran)}
    examples = read_examples(ran.folder / "pictures" / "examples")
    assert {each.object for each in examples} == {*OBJECTS} and examples[0].rotation_errors[0] >= examples[
        -1
    ].rotation_errors[0]
    for example in examples:  # the answers of the sets, which are not those of the pairs by themselves
        row = by_pair[example.object, example.reference.file.name, example.query.file.name]
        assert float(row["longitude_degrees"]) == pytest.approx(math.degrees(example.ends[0, 1]), abs=0.02)
        assert example.trajectories is None and len(example.ends) == 1
    page = (ran.folder / "report.html").read_text()
    assert "the solver's steps were not recorded" in html.unescape(page) and "slider shows" not in page
    fit = commands.here("fit", "eval", *settings, "solver.second_stage=false")
    assert fit.json()["seconds_per_pair"] < ran.json()["seconds_per_pair"]


def test_mistakes_are_named(commands):
    assert commands.here("x", "eval", "checkpoint=./score", "views=9").error == (
        "views must be 2 to 8 images, or null for pairs; got 9"
    )
    assert commands.here("x", "eval", "checkpoint=./score", "views=6").error == (
        f"object '{sorted(OBJECTS)[0]}' has {TEST_VIEWS} views here; sets of views=6 need as many"
    )
    assert commands.here("x", "eval", "checkpoint=./score", "views=3", "protocol=per_view").error == (
        "protocol=per_view is for pairs; views=3 has its own protocol, so leave it out"
    )
