"""`eval` with solvers that descend a prior: the same in one process and in two."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from tiny_runs import Commands, Ran

TRAINING = ("model=prior", "model.latent_dim=6", "model.width=16", "model.layers=1", "data.image_size=64")
DESCENT = ("prior.path=prior", "start=ring", "start.count=2", "data.image_size=64")
ANSWER = ("latitude_degrees", "longitude_degrees", "relative_radius", "rotation_error_degrees")


@pytest.fixture(scope="module")
def commands(tmp_path_factory) -> Commands:
    commands = Commands(tmp_path_factory.mktemp("eval_priors"))
    for name, settings in (("prior", TRAINING), ("score", ("trainer.max_epochs=1", "data.image_size=64"))):
        trained = commands.here(name, "train", *settings)
        assert trained.status == 0, trained.err
    return commands


def answers(folder: Path) -> list[list[float]]:
    with (folder / "pairs.csv").open() as file:
        return [[float(row[key]) for key in ANSWER] for row in csv.DictReader(file)]


@pytest.mark.heavy
def test_two_processes_give_the_answers_of_one(commands):
    settings = ("solver=two_stage", "solver.refinement_steps=4", "checkpoint=./score", *DESCENT)
    one: Ran = commands.here("one", "eval", *settings)
    assert one.status == 0, one.err
    spread = ("trainer.devices=2", "trainer.strategy=ddp", "trainer.accelerator=cpu")
    two = commands.process("two", "eval", *settings, *spread)
    assert (two.status, two.err) == (0, "")
    for row, expected in zip(answers(two.folder), answers(one.folder), strict=True):
        assert row == pytest.approx(expected, abs=0.01)
    assert one.json()["metrics"] == pytest.approx(two.json()["metrics"], abs=1e-4)
