"""The experiments on the paper's own data: what they compose to, and runs on small trees in the published layouts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from bop_layout import write_hopev2
from co3d_layout import write_category
from scanned_layouts import write_gso, write_oo3d
from tiny_runs import Commands, Ran

from lp_framework.report.paper import paper_table

SMALL = ("data.resolution=24", "data.image_size=24")
RENDERED = (
    "data.seen=2", "data.unseen=1", "data.test_views=3", "data.latitude_step_degrees=60",
    "data.longitude_step_degrees=120", "data.workers=1", "renderer=raycast",
)  # fmt: skip
HOPE = ("data=hopev2", "data.path=hope", "data.train_views=5", "data.test_views=3")
CO3D = ("data=co3d", "data.path=co3d_data", "data.scenes=1", "data.train_views=6", "data.test_views=3")
GSO = ("data=gso", "data.path=GSO", *RENDERED)


@pytest.fixture(autouse=True)
def paths(tmp_path):
    """Where the commands say that data and a trained model are."""
    (tmp_path / "FOLDER").mkdir()
    (tmp_path / "runs" / "model").mkdir(parents=True)


@pytest.fixture
def jobs(monkeypatch):
    """The config of every job of `eval`."""
    import lp_framework.commands.eval as command

    jobs = []
    monkeypatch.setattr(command, "run", jobs.append)
    return jobs


@pytest.mark.parametrize(
    ("experiment", "data", "protocol", "solvers"),
    [
        ("main", "gso", "per_view", {"dust3r", "vggt", "id_pose", "ifusion", "two_stage"}),
        ("unseen", "gso", "per_view", {"dust3r", "vggt", "ifusion", "two_stage"}),
        ("hopev2", "hopev2", "ordered", {"vggt", "ifusion", "two_stage"}),
        ("co3d", "co3d", "per_view", {"id_pose", "ifusion", "two_stage"}),
    ],
)
def test_an_experiment_is_the_papers_setting(lp, jobs, experiment, data, protocol, solvers):
    ran = lp("eval", f"experiment={experiment}", "data.path=FOLDER", "checkpoint=runs/model", "seed=0")
    assert ran.status == 0, ran.err
    assert len(jobs) == len(solvers) and {config.solver.name for config in jobs} == solvers
    for config in jobs:
        assert (config.data.name, config.data.path, config.protocol) == (data, "FOLDER", protocol)
        assert (config.prior.name, config.start.name, config.checkpoint) == ("zero123xl", "grid", "runs/model")
        assert (config.data.get("objects") == "unseen") == (experiment == "unseen")
    # Every method of the paper's table is in it, under the settings that the table names.
    assert {row.settings["solver.name"] for row in paper_table(experiment).rows} == solvers


def test_the_main_table_is_of_two_data_sets(lp, jobs):
    ran = lp("eval", "experiment=main", "data=oo3d", "data.path=FOLDER", "solver=ifusion", "seed=0")
    assert ran.status == 0, ran.err
    assert [(config.data.name, config.protocol) for config in jobs] == [("oo3d", "per_view")]


@pytest.mark.parametrize(
    ("data", "counts"),
    [("gso", (70, 10, 8)), ("oo3d", (70, 10, 8)), ("hopev2", (100, 4)), ("co3d", (29, 8))],
)
def test_data_sets_have_the_papers_sizes(lp, jobs, data, counts):
    assert lp("eval", f"data={data}", "data.path=FOLDER").status == 0
    keys = {
        "hopev2": ("train_views", "test_views"),
        "co3d": ("scenes", "test_views"),
    }.get(data, ("seen", "unseen", "test_views"))
    assert tuple(jobs[0].data[key] for key in keys) == counts


@pytest.fixture(scope="module")
def commands(tmp_path_factory) -> Commands:
    """A working folder with a download of each data set."""
    commands = Commands(tmp_path_factory.mktemp("paper"), train_views=3, test_views=2)
    write_gso(commands.folder / "GSO", *(f"Object_{index}" for index in range(4)))
    write_oo3d(commands.folder / "raw_scans", "apple_001", "apple_002", "toy_car_001")
    write_hopev2(commands.folder / "hope")
    write_category(commands.folder / "co3d_data")
    return commands


def trained(commands: Commands, name: str, *data: str) -> Ran:
    """The paper's training, on a network of nothing, for an epoch."""
    return commands.here(
        name, "train", "experiment=paper", *data, *SMALL, "trainer.max_epochs=1", "trainer.precision=32-true",
        "backbone.arch=resnet18", "backbone.pretrained=false", "backbone.image_size=24", "backbone=resnet",
        "data.validation_views=0",
    )  # fmt: skip


def evaluated(commands: Commands, experiment: str, checkpoint: str, *data: str) -> tuple[Ran, Path]:
    """The table, with what is quick of it, and where it lies."""
    folder = commands.folder / f"{experiment}_on_{checkpoint}"
    ran = commands.here(
        "unused", "eval", f"experiment={experiment}", f"checkpoint={checkpoint}", *data, *SMALL, "prior=tiny",
        "solver=two_stage", "solver.iterations=2", "solver.refinement_steps=2", "seed=0",
        f"hydra.sweep.dir={folder.name}", "hydra.sweep.subdir=${hydra.job.num}",
    )  # fmt: skip
    return ran, folder / "0"


@pytest.mark.filterwarnings("ignore:.*are left out")
@pytest.mark.parametrize(
    ("experiment", "data", "pairs", "row"),
    [("main", GSO, 2 * 3, "GSO, Ours"), ("hopev2", HOPE, 3 * 2, "Ours"), ("co3d", CO3D, 3, "Ours")],
)
def test_training_and_table_run_on_a_download(commands, experiment, data, pairs, row):
    ran = trained(commands, f"trained_{experiment}", *data)
    assert ran.status == 0, ran.err
    ran, folder = evaluated(commands, experiment, f"trained_{experiment}", *data)
    assert ran.status == 0, ran.err
    result = json.loads((folder / "results.json").read_text())
    assert result["pairs"] == pairs and result["config"]["data"]["name"] == data[0].removeprefix("data=")
    ran = commands.here(f"report_{experiment}", "report", f"runs={folder.parent.name}", "objects=all")
    assert ran.status == 0, ran.err
    assert f"paper: {row}" in ran.out
    assert "paper: OO3D, Ours" not in ran.out.split("paper: GSO, Ours")[0]  # GSO's own comes first, beside ours


def test_other_data_with_the_model_of_another(commands):
    assert trained(commands, "gso_model", *GSO).status == 0
    ran, folder = evaluated(commands, "unseen", "gso_model", *GSO, "data.objects=unseen")
    assert ran.status == 0, ran.err
    unseen = json.loads((folder / "results.json").read_text())
    lists = json.loads((commands.folder / "datasets" / "gso" / "objects.json").read_text())
    assert list(unseen["per_object"]) == lists["unseen"] and not set(lists["unseen"]) & set(lists["seen"])
    ran, folder = evaluated(commands, "main", "gso_model", "data=oo3d", "data.path=raw_scans", *RENDERED)
    assert ran.status == 0, ran.err
    assert len(json.loads((folder / "results.json").read_text())["per_object"]) == 2
    ran = commands.here("report_oo3d", "report", f"runs={folder.parent.name}", "objects=all")
    assert "paper: OO3D, Ours" in ran.out.split("paper: GSO, Ours")[0]
