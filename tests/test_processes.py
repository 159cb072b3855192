"""`eval` and `train` on two processes give the numbers of one, also if sizes do not divide evenly."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
import torch
from tiny_runs import OBJECTS, ROOT, Commands, Ran

from lp_framework import registry
from lp_framework.data.module import PairDataModule
from lp_framework.data.pairs import PairBatch
from lp_framework.data.views import RenderingsData
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.models.pose_model import ScoreModel

pytestmark = [
    pytest.mark.heavy,
    pytest.mark.skipif(
        not (torch.distributed.is_available() and torch.distributed.is_gloo_available()),
        reason="PyTorch was built without gloo, by which processes on CPUs speak",
    ),
]
TEST_VIEWS = 5
SPREAD = ("trainer.devices=2", "trainer.strategy=ddp", "trainer.accelerator=cpu")
# 80 pairs are 12 batches, the last one of 3.
EVALUATION = ("checkpoint=./score", "batch_pairs=7", "solver.iterations=5")


@pytest.fixture(scope="module")
def commands(tmp_path_factory) -> Commands:
    commands = Commands(tmp_path_factory.mktemp("processes"), test_views=TEST_VIEWS)
    trained = commands.here("score", "train", "trainer.max_epochs=1", "backbone.pause=0.05")
    assert trained.status == 0, trained.err
    return commands


@pytest.fixture(scope="module")
def whole(commands) -> Ran:
    """An evaluation of all pairs in one process."""
    ran = commands.here("whole", "eval", *EVALUATION)
    assert ran.status == 0, ran.err
    return ran


def two_processes(commands: Commands, name: str, command: str, *overrides: str) -> Ran:
    """The command on two processes; that there were two is in the log of the first, which waits for the other."""
    process = commands.start(name, command, *overrides, *SPREAD)
    out, err = process.communicate(timeout=500)
    assert (process.returncode, err) == (0, ""), err
    log = (commands.folder / name / f"{command}.log").read_text()
    assert "MEMBER: 1/2" in log and "All distributed processes registered. Starting with 2 processes" in log
    return Ran(process.returncode, out, err, commands.folder / name)


def assert_the_same(ran: Ran, wanted: Ran) -> None:
    """Every number but the time, to the last bit: batches are the same however they are shared out."""
    for name in ("pairs.csv", "results.csv"):
        assert (ran.folder / name).read_bytes() == (wanted.folder / name).read_bytes(), name
    apart = ("seconds_per_pair", "config")
    found, expected = ({key: value for key, value in each.json().items() if key not in apart} for each in (ran, wanted))
    assert found == expected


# ---------------------------------------------------------------- evaluation


def test_a_run_of_two_killed_processes_is_resumed_by_one(commands, whole):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-m", "lp_framework", *commands.arguments("killed", "eval", *EVALUATION, *SPREAD)]
    process = subprocess.Popen(
        line, cwd=commands.folder, env=environment, start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    journals = [commands.folder / "killed" / "unfinished" / f"rank_{rank}.jsonl" for rank in (0, 1)]
    deadline = time.monotonic() + 300
    while not all(file.exists() for file in journals) and time.monotonic() < deadline:
        assert process.poll() is None
        time.sleep(0.002)
    os.killpg(process.pid, signal.SIGKILL)  # both
    process.wait()
    rows = [json.loads(row[9:]) for file in journals for row in file.read_bytes().split(b"\n")[:-1]]
    solved = {tuple(pair) for row in rows for pair in row["pair"]}
    assert 0 < len(solved) < whole.json()["pairs"]
    ran = commands.here("unused", "eval", "resume=killed", "trainer.devices=1", "trainer.strategy=auto")
    assert ran.status == 0, ran.err
    assert f"resuming: {len(solved)} pairs are already solved" in ran.out
    ran.folder = commands.folder / "killed"
    assert_the_same(ran, whole)


def test_an_evaluation_of_sets_started_by_one_process_is_resumed_by_two(commands, monkeypatch):
    settings = (*EVALUATION, "views=3", "solver=multiview", "solver.second_stage=false")
    whole = commands.here("sets_one", "eval", *settings)
    assert whole.json()["pairs"] == len(OBJECTS) * TEST_VIEWS * 2  # in batches of three sets, of which there are seven
    solve = Evaluation.test_step

    def until(self: Evaluation, batch: PairBatch, batch_idx: int) -> None:
        if batch_idx == 4:
            raise RuntimeError("stopped")
        solve(self, batch, batch_idx)

    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="stopped"):
        patch.setattr(Evaluation, "test_step", until)
        commands.here("sets_two", "eval", *settings)
    two = two_processes(commands, "sets_two", "eval", *settings)  # three batches are left for both
    assert "resuming: 24 pairs are already solved" in two.out
    assert_the_same(two, whole)


# ---------------------------------------------------------------- training


class Share(ScoreModel):
    """A score model that takes itself for one process among several; Lightning asks its trainer for these."""

    global_step, global_rank = 0, 0

    def log(self, *arguments: object, **named: object) -> None:
        """Nobody listens."""


def test_two_processes_train_as_one_that_takes_the_mean_gradient_of_both_shares(commands, clean_registry, tmp_path):
    settings = ("model.schedule=constant", "trainer.max_epochs=2", "data.batch_pairs=3", "data.validation_views=2")
    initial = commands.here("initial", "train", *settings, "model.learning_rate=0")
    two = two_processes(commands, "trained", "train", *settings)

    registry.discover([str(commands.folder / "plugins")])
    model = Share(registry.build("backbone", {"name": "tmp_tiny"}), hidden=16, schedule="constant")
    model.load_state_dict(initial.checkpoint()["state_dict"], strict=False)  # the trunk is not among them
    optimizer = model.configure_optimizers()
    loaders, here = [], SimpleNamespace(root_device=torch.device("cpu"))
    for rank in (0, 1):
        data = PairDataModule(RenderingsData(str(commands.folder / "views")), str(tmp_path / "cache"), 16, 3, 3, 2)
        data.trainer = SimpleNamespace(global_rank=rank, world_size=2, strategy=here)
        data.cache_features(model.extractor())
        loaders.append(data.train_dataloader())
    sizes = set()
    for epoch in range(2):
        for loader in loaders:
            loader.sampler.set_epoch(epoch)
        for batches in zip(*loaders, strict=True):
            sizes.add(tuple(map(len, batches)))
            optimizer.zero_grad()
            for model.global_rank, batch in enumerate(batches):
                (model.training_step(batch, 0) / 2).backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            optimizer.step()
            model.global_step += 1
    assert any(one != other for one, other in sizes)  # the shares are not alike
    trained = two.checkpoint()
    assert trained["global_step"] == model.global_step > 2
    for name, value in trained["state_dict"].items():
        torch.testing.assert_close(value, model.state_dict()[name], rtol=1e-4, atol=1e-6, msg=name)
    model.load_state_dict(trained["state_dict"], strict=False)
    model.eval()
    data.trainer.global_rank, data.trainer.world_size = 0, 1
    batches = list(data.val_dataloader())
    assert len(batches) == 3  # of which two processes meet one twice
    with torch.no_grad():
        for batch in batches:
            model.validation_step(batch, 0)
    loss = two.json("training.json")["final"]["val/loss"]
    assert loss == pytest.approx(model.validation_loss.compute().item(), rel=1e-6)
    moved = max((value - initial.checkpoint()["state_dict"][name]).abs().max() for name, value in
                trained["state_dict"].items())  # fmt: skip
    assert moved > 1e-3


def test_a_strategy_that_needs_gpus_says_so_in_a_sentence(commands):
    ran = commands.here("fsdp", "eval", "checkpoint=./score", "trainer.strategy=fsdp", "trainer.accelerator=cpu")
    assert ran.error.startswith("trainer: The strategy `fsdp` requires a GPU accelerator")


# ---------------------------------------------------------------- several nodes, of which this machine plays two


def torchrun(node: int) -> dict[str, str]:
    """What `torchrun --nnodes=2 --nproc-per-node=1` tells the process that it runs on a node."""
    return {
        "RANK": str(node), "LOCAL_RANK": "0", "GROUP_RANK": str(node), "WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "1",
        "MASTER_ADDR": "127.0.0.1", "TORCHELASTIC_RUN_ID": "7",
    }  # fmt: skip


def slurm(node: int) -> dict[str, str]:
    """What Slurm tells the process that `srun --nodes=2 --ntasks-per-node=1` runs on a node."""
    return {
        "SLURM_JOB_ID": "7", "SLURM_JOB_NAME": "eval", "SLURM_NTASKS": "2", "SLURM_NTASKS_PER_NODE": "1",
        "SLURM_NNODES": "2", "SLURM_NODELIST": "127.0.0.1", "SLURM_PROCID": str(node), "SLURM_NODEID": str(node),
        "SLURM_LOCALID": "0",
    }  # fmt: skip


@pytest.mark.parametrize("launch", [torchrun, slurm])
def test_two_nodes_give_the_results_of_one(commands, whole, launch, monkeypatch):
    name = f"{launch.__name__}_two"
    spread = ("trainer.num_nodes=2", "trainer.devices=1", "trainer.strategy=ddp", "trainer.accelerator=cpu")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    processes = []
    for node in (0, 1):
        with monkeypatch.context() as patch:
            patch.setenv("MASTER_PORT", str(port))
            for key, value in launch(node).items():
                patch.setenv(key, value)
            processes.append(commands.start(name, "eval", *EVALUATION, *spread))
    for process in processes:
        out, err = process.communicate(timeout=300)
        assert process.returncode == 0, out + err
    assert "MEMBER: 1/2" in (commands.folder / name / "eval.log").read_text()
    assert_the_same(Ran(0, "", "", commands.folder / name), whole)
