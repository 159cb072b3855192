"""A prior whose weights are divided among two processes: its energies, and an evaluation, are those of one process."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tiny_runs import Commands

from lp_framework.benchmarks.second_stage import NARROW
from lp_framework.priors.zero123.folders import write_folder
from lp_framework.priors.zero123.networks import Networks

pytestmark = pytest.mark.skipif(
    not (torch.distributed.is_available() and torch.distributed.is_gloo_available()),
    reason="PyTorch was built without gloo, by which processes on CPUs speak",
)
ZERO123 = ("solver=ifusion", "prior=zero123", "prior.path=zero123")
DIVIDED = ("trainer.devices=2", "trainer.strategy=model_parallel", "trainer.accelerator=cpu")

SHARES = """
import torch
from torch import distributed
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.tensor import DTensor

import lp_framework
from lp_framework.benchmarks.second_stage import NARROW, random_pair
from lp_framework.priors.zero123.networks import Networks
from lp_framework.priors.zero123.prior import Zero123Prior
from lp_framework.solvers.pair_energy import PairEnergy

distributed.init_process_group("gloo")
rank = distributed.get_rank()
torch.manual_seed(0)
prior = Zero123Prior(Networks(NARROW), max_batch=2)
pair = random_pair(torch.device("cpu"))
poses = torch.tensor([[[0.1, 0.2, 0.0], [-0.2, 3.0, 0.1], [0.3, 1.0, 0.0]]])[:, : rank + 2]  # not alike


def results():
    energy = PairEnergy(prior, pair, seed=0)
    variable = poses.clone().requires_grad_()
    energies = energy(variable, 300, energy.noise(0)[:, 0])
    (slope,) = torch.autograd.grad(energies.sum(), variable)
    generator = torch.Generator().manual_seed(0)
    view = prior.generate(energy.codes[:1], poses[0, :1], steps=2, generator=generator)
    return energy.codes.latent, energy.codes.embedding, energies.detach(), slope, view


whole, count = results(), sum(each.numel() for each in prior.parameters())
prior.shard(init_device_mesh("cpu", (1, 2), mesh_dim_names=("replicas", "shards")))
here = sum((each.to_local() if isinstance(each, DTensor) else each).numel() for each in prior.parameters())
assert here < 0.52 * count, (here, count)
for _ in range(2):
    for one, other in zip(results(), whole, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
print("shared out")
"""


def test_energies_gradients_and_views_are_those_of_the_whole_prior_where_batches_differ(tmp_path):
    (tmp_path / "shares.py").write_text(SHARES)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1]), "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", "shares.py"]
    ran = subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0 and ran.stdout.count("shared out") == 2, ran.stderr


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory) -> Commands:
    commands = Commands(tmp_path_factory.mktemp("sharded"), test_views=2)
    torch.manual_seed(0)
    write_folder(Networks(NARROW), commands.folder / "zero123")
    return commands


def test_an_evaluation_has_the_results_of_one_process(commands):
    # Eight pairs in batches of 3, 3 and 2, which pass the network in three slices and in two.
    few = ("batch_pairs=3", "prior.max_batch=5", "start=ring", "start.count=2", "solver=ifusion", "solver.steps=2")
    settings = ("prior=zero123", "prior.path=zero123", "data.image_size=64", "solver.rescoring=2", *few)
    one = commands.here("one", "eval", *settings)
    assert one.status == 0, one.err
    two = commands.process("two", "eval", *settings, *DIVIDED)
    assert (two.status, two.err) == (0, ""), two.err
    rows = []
    for ran in (one, two):
        with (ran.folder / "pairs.csv").open() as file:
            rows.append(list(csv.DictReader(file)))
    assert len(rows[0]) == 8
    for row, expected in zip(*rows, strict=True):
        assert float(row["rotation_error_degrees"]) == pytest.approx(
            float(expected["rotation_error_degrees"]), abs=0.01
        )
    assert two.json()["metrics"] == pytest.approx(one.json()["metrics"], abs=1e-4)
    assert {file.name for file in (two.folder / "pictures").iterdir()} == {
        file.name for file in (one.folder / "pictures").iterdir()
    }


@pytest.mark.parametrize(
    ("command", "settings", "sentence"),
    [
        ("eval", ("solver=ifusion", "prior=tiny"), "TinyPrior cannot be divided among processes"),
        ("eval", ("solver=features",), "trainer.strategy=model_parallel divides a prior, and this solver has none"),
        (
            "eval",
            (*ZERO123, "prior.channels_last=true"),
            "prior.channels_last=true and trainer.strategy=model_parallel",
        ),
        ("train", (), "trainer.strategy=model_parallel divides the prior of an eval; models are trained whole"),
    ],
)
def test_what_cannot_be_divided_says_so_in_a_sentence(commands, command, settings, sentence):
    ran = commands.process("wrong", command, *settings, *DIVIDED)
    assert ran.error.startswith(sentence)
