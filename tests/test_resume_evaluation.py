"""An `eval` interrupted at any moment can be resumed, with the results of an uninterrupted run."""

from __future__ import annotations

import csv
import errno
import json
import os
import re
import shutil
import signal
import time
from pathlib import Path

import pytest
import torch
from tiny_runs import OBJECTS, Commands, Ran

from lp_framework.atomic import written
from lp_framework.commands.building import weights_fingerprint
from lp_framework.errors import UserError
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.evaluation.journal import Journal
from lp_framework.evaluation.metrics import SolvedBatch

pytestmark = pytest.mark.heavy
TEST_VIEWS = 5
PAIRS = len(OBJECTS) * TEST_VIEWS * (TEST_VIEWS - 1)
BATCH = 7  # 80 pairs are 12 batches, the last one of 3
EVALUATION = ("checkpoint=./score", f"batch_pairs={BATCH}", "solver.iterations=5")


@pytest.fixture(scope="module")
def commands(tmp_path_factory) -> Commands:
    commands = Commands(tmp_path_factory.mktemp("resumed"), test_views=TEST_VIEWS)
    trained = commands.here("score", "train", "trainer.max_epochs=1", "backbone.pause=0.03")
    assert trained.status == 0, trained.err
    return commands


@pytest.fixture(scope="module")
def whole(commands) -> Ran:
    """An uninterrupted evaluation."""
    ran = commands.here("whole", "eval", *EVALUATION)
    assert ran.status == 0, ran.err
    return ran


@pytest.fixture
def stop(commands, monkeypatch):
    """`stop(name, batches)`: an evaluation that breaks off when it has solved so many batches; its folder."""

    def stopped(name: str, batches: int, *overrides: str) -> Path:
        solve = Evaluation.test_step

        def until(self: Evaluation, batch, batch_idx: int) -> None:
            if batch_idx == batches:
                raise RuntimeError("stopped")
            solve(self, batch, batch_idx)

        with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="stopped"):
            patch.setattr(Evaluation, "test_step", until)
            commands.here(name, "eval", *EVALUATION, *overrides)
        return commands.folder / name

    return stopped


def journal(folder: Path) -> Path:
    return folder / "unfinished" / "rank_0.jsonl"


def assert_the_same(ran: Ran, wanted: Ran) -> None:
    """Every number but the time."""
    assert ran.status == 0, ran.err
    for name in ("pairs.csv", "results.csv"):
        assert (ran.folder / name).read_bytes() == (wanted.folder / name).read_bytes(), name
    apart = ("seconds_per_pair", "config")
    found, expected = ({key: value for key, value in each.json().items() if key not in apart} for each in (ran, wanted))
    assert found == expected
    assert not (ran.folder / "unfinished").exists()


def went_on(ran: Ran) -> int:
    """The number of pairs that were there."""
    (line,) = (line for line in ran.out.splitlines() if line.startswith("resuming: "))
    return int(line.split()[1])


# ---------------------------------------------------------------- stopped and gone on


def test_resuming_after_kill_9_gives_the_numbers_of_an_uninterrupted_run(commands, whole):
    process = commands.start("killed", "eval", *EVALUATION)
    lines = journal(commands.folder / "killed")
    deadline = time.monotonic() + 100
    while not (lines.exists() and lines.read_bytes().count(b"\n") >= 1) and time.monotonic() < deadline:
        assert process.poll() is None, process.communicate()
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert not (commands.folder / "killed" / "results.json").exists()
    solved = lines.read_bytes().count(b"\n")
    assert solved < 12  # it was killed on the way
    ran = commands.here("unused", "eval", "resume=killed")
    assert went_on(ran) == BATCH * solved
    ran.folder = commands.folder / "killed"
    assert_the_same(ran, whole)
    assert ran.json()["config"] == whole.json()["config"]


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5, 0.77, 0.999])
def test_a_truncated_journal_loses_only_the_truncated_batch(commands, whole, stop, share):
    lines = journal(stop(f"cut{share}", 5))
    content = lines.read_bytes()
    kept = content[: int(share * len(content))]
    lines.write_bytes(kept)
    again = commands.here(f"cut{share}", "eval", *EVALUATION)  # the same command, the same folder
    if kept.count(b"\n"):
        assert went_on(again) == BATCH * kept.count(b"\n")
    assert_the_same(again, whole)


@pytest.mark.parametrize("damage", ["a digit", "a line", "something else", "lines twice"])
def test_damaged_lines_are_solved_again(commands, whole, stop, damage):
    lines = journal(stop(damage, 5))
    rows = lines.read_bytes().splitlines(keepends=True)
    if damage == "a digit":
        place = rows[1].index(b".") + 1
        rows[1] = rows[1][:place] + (b"1" if rows[1][place : place + 1] != b"1" else b"2") + rows[1][place + 1 :]
    elif damage == "a line":
        del rows[1]
    elif damage == "something else":
        rows[1] = b"\x00\xff{}\n"
    else:
        rows += rows
    lines.write_bytes(b"".join(rows))
    ran = commands.here(damage, "eval", *EVALUATION)
    assert went_on(ran) == BATCH * (5 if damage == "lines twice" else 4)
    assert_the_same(ran, whole)


def test_a_run_may_be_interrupted_repeatedly(commands, whole, stop):
    for solved in (2, 1, 0, 3):
        with journal(stop("again", solved)).open("ab") as lines:
            lines.write(b'01234567 {"pair":[')  # what a kill leaves of a line
    ran = commands.here("again", "eval", *EVALUATION)
    assert went_on(ran) == BATCH * 6
    assert_the_same(ran, whole)


def test_a_run_stopped_before_its_tables_were_written_writes_them(commands, whole, monkeypatch):
    def fail(*arguments: object) -> None:
        raise RuntimeError("no space left")

    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="no space left"):
        patch.setattr("lp_framework.commands.eval.write_result", fail)
        commands.here("tables", "eval", *EVALUATION)
    ran = commands.here("tables", "eval", *EVALUATION)
    assert went_on(ran) == PAIRS
    assert ran.err == ""
    assert_the_same(ran, whole)


@pytest.mark.parametrize("place", ["journal", "tables", "pictures"])
def test_an_evaluation_resumes_after_a_full_disk(commands, whole, monkeypatch, place):
    def full(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def no_room_for_pictures(folder: Path, *arguments: object) -> None:
        folder.mkdir()
        with written(folder / "errors.png") as partial:
            partial.write_bytes(b"half")
            full()

    name = f"full_{place}"
    with monkeypatch.context() as patch:
        if place == "journal":
            sync, room = os.fsync, iter(range(3))
            patch.setattr(os, "fsync", lambda file: sync(file) if next(room, None) is not None else full())
        elif place == "tables":
            replace = os.replace
            patch.setattr(os, "replace", lambda a, b: full() if b.name == "pairs.csv" else replace(a, b))
        else:
            patch.setattr("lp_framework.commands.eval.save_pictures", no_room_for_pictures)
        ran = commands.here(name, "eval", *EVALUATION, f"pictures={str(place == 'pictures').lower()}")
    file = {"journal": "unfinished/rank_0.jsonl", "tables": "pairs.csv", "pictures": "pictures/errors.png"}[place]
    said = (
        rf"{name}/{file}: cannot be written \(No space left on device: it needs more than the [\d.]+ MB that are free\)"
    )
    assert re.fullmatch(f"{said}; free some space, then continue with resume={name}", ran.error)
    again = commands.here("unused", "eval", f"resume={name}", "pictures=false")
    assert went_on(again) == (4 * BATCH if place == "journal" else PAIRS)
    again.folder = commands.folder / name
    assert_the_same(again, whole)
    assert not (commands.folder / "unused").exists()


def test_a_terminated_command_says_how_to_resume(commands, whole, monkeypatch):
    solve = Evaluation.test_step

    def ended(self: Evaluation, batch, batch_idx: int) -> None:
        if batch_idx == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        solve(self, batch, batch_idx)

    interrupt = signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as patch:
        patch.setattr(Evaluation, "test_step", ended)
        ran = commands.here("ended", "eval", *EVALUATION)
    signal.signal(signal.SIGINT, interrupt)  # Lightning has switched it off
    assert (ran.status, ran.err.splitlines()[-1]) == (143, "interrupted; to continue: resume=ended")
    ran = commands.here("ended", "eval", *EVALUATION)
    assert went_on(ran) == 2 * BATCH
    assert_the_same(ran, whole)


def test_evaluations_of_view_sets_resume(commands, stop):
    settings = ("views=3", "solver.gamma=0.1")
    wanted = commands.here("sets", "eval", *EVALUATION, *settings)
    assert len(wanted.json()["per_object"]) == len(OBJECTS)
    stop("stopped_sets", 2, *settings)
    ran = commands.here("stopped_sets", "eval", *EVALUATION, *settings)
    assert went_on(ran) == 2 * 6  # a batch of seven pairs is three sets of two
    assert_the_same(ran, wanted)


def test_a_job_of_a_sweep_resumes(commands, whole, stop):
    stop("sweep/0", 4)
    sweep = commands.here("unused", "eval", "--multirun", *EVALUATION, "hydra.sweep.dir=sweep", "seed=0,1")
    assert went_on(sweep) == 4 * BATCH
    sweep.folder = commands.folder / "sweep" / "0"
    assert_the_same(sweep, whole)
    assert (commands.folder / "sweep" / "1" / "results.json").is_file()


def test_a_finished_run_is_repeated(commands, whole):
    shutil.copytree(whole.folder, commands.folder / "finished")
    ran = commands.here("finished", "eval", *EVALUATION)
    assert "going on" not in ran.out
    assert_the_same(ran, whole)


def test_starting_another_evaluation_removes_old_results(commands, whole, stop):
    shutil.copytree(whole.folder, commands.folder / "others")
    folder = stop("others", 1, "seed=1")
    assert not (folder / "results.json").exists()
    assert went_on(commands.here("others", "eval", *EVALUATION, "seed=1")) == BATCH


# ---------------------------------------------------------------- what does not go together


def test_another_configuration_is_refused_and_nothing_is_lost(commands, stop):
    folder = stop("mixed", 2)
    before = journal(folder).read_bytes()
    expected = "mixed: contains another unfinished evaluation ({}); choose another folder or remove mixed/unfinished"
    wrong = commands.here("mixed", "eval", *EVALUATION, "solver.gamma=0.2", "seed=3")
    assert wrong.error == expected.format("seed was 0, is 3; solver.gamma was [0.0, 0.3, 0.0], is 0.2")
    os.makedirs(commands.folder / "copy", exist_ok=True)
    shutil.copy(commands.folder / "score" / "checkpoints" / "best.ckpt", commands.folder / "copy" / "best.ckpt")
    wrong = commands.here("mixed", "eval", *EVALUATION, "checkpoint=copy")
    assert wrong.error == expected.format("checkpoint was score/checkpoints/best.ckpt, is copy/best.ckpt")
    assert journal(folder).read_bytes() == before
    moved = commands.here("mixed", "eval", *EVALUATION, "trainer.devices=1", "trainer.accelerator=cpu")
    assert went_on(moved) == 2 * BATCH


def test_a_retrained_model_is_refused(commands, stop):
    checkpoint = commands.folder / "score" / "checkpoints" / "best.ckpt"
    kept = checkpoint.read_bytes()
    stop("retrained", 1)
    content = torch.load(checkpoint, weights_only=True)
    bias = next(key for key in content["state_dict"] if key.startswith("network.") and key.endswith("bias"))
    content["state_dict"][bias] += 1
    torch.save(content, checkpoint)
    try:
        assert "unfinished evaluation (different weights)" in commands.here("retrained", "eval", *EVALUATION).error
        assert "unfinished evaluation (different weights)" in commands.here("unused", "eval", "resume=retrained").error
    finally:
        checkpoint.write_bytes(kept)


def test_views_that_have_changed_are_refused(commands, stop):
    stop("redrawn", 1)
    transforms = commands.folder / "views" / "cup" / "test" / "transform.json"
    kept = transforms.read_text()
    content = json.loads(kept)
    content["ambiguity"] = "twofold"
    transforms.write_text(json.dumps(content))
    try:
        assert "redrawn: contains another unfinished evaluation (different views)" in (
            commands.here("redrawn", "eval", *EVALUATION).error
        )
    finally:
        transforms.write_text(kept)


def test_an_unfinished_evaluation_without_results_is_replaced(commands, stop):
    stop("empty", 0)
    ran = commands.here("empty", "eval", *EVALUATION, "seed=1")
    assert ran.status == 0, ran.err
    assert ran.json()["seed"] == 1


def test_what_cannot_be_resumed_is_named(commands, whole, stop):
    assert commands.here("unused", "eval", "resume=whole").error == (
        "resume=whole: that run is finished; its results are in whole/results.json"
    )
    assert commands.here("unused", "eval", "resume=score").error == (
        "resume=score: contains no unfinished evaluation to resume"
    )
    stop("kept", 1)
    assert commands.here("unused", "eval", "resume=kept", "solver.gamma=0").error == (
        "solver.gamma cannot be changed in a resumed run; leave it out (kept/unfinished has its value)"
    )
    assert commands.here("unused", "eval", "resume=kept", "trainer.devices=1").status == 0


def test_a_resumed_run_keeps_its_model_despite_a_later_one(commands, stop, monkeypatch):
    shutil.copytree(commands.folder / "score", commands.folder / "runs" / "train" / "early")
    stop("default", 1, "checkpoint=latest")
    later = shutil.copytree(commands.folder / "score", commands.folder / "runs" / "train" / "later")
    os.utime(later / "checkpoints" / "last.ckpt", (time.time() + 60, time.time() + 60))
    assert "checkpoint was runs/train/early" in commands.here("default", "eval", *EVALUATION, "checkpoint=latest").error
    assert commands.here("unused", "eval", "resume=default").status == 0
    result = json.loads((commands.folder / "default" / "results.json").read_text())
    assert result["checkpoint"] == "runs/train/early/checkpoints/best.ckpt"
    shutil.rmtree(commands.folder / "runs")


# ---------------------------------------------------------------- parts


def solved(pairs: int = 4, starts: int = 3) -> SolvedBatch:
    """Numbers with all their digits, and some that are none."""
    generator = torch.Generator().manual_seed(pairs)
    rotation, translation = (
        torch.randn(pairs, starts, dtype=torch.float64, generator=generator).exp() for _ in range(2)
    )
    rotation[0, 0], translation[0, 0], translation[0, 1] = torch.nan, torch.inf, 5e-324
    numbers, answer = torch.arange(pairs), torch.rand(pairs, 3).double() / 3
    pair = torch.stack([numbers, numbers + 1], dim=1)
    return SolvedBatch(pair, numbers % 2, rotation, translation, numbers % starts, answer, answer[:, 0], 0.1, 12)


def test_a_journal_gives_back_every_bit(tmp_path):
    given = [solved(4), solved(2)]
    subject, other = ({"config": {"seed": seed}, "checkpoint": None} for seed in (0, 1))
    for rank, batch in enumerate(given):
        book = Journal(tmp_path, subject)
        book.begin("views")
        book.append(batch, rank)
    found = Journal(tmp_path, subject).begin("views")
    for batch, wanted in zip(found, given, strict=True):
        assert (batch.seconds, batch.passes) == (wanted.seconds, wanted.passes)
        for one, two in zip(batch[:-2], wanted[:-2], strict=True):
            assert one.dtype == two.dtype
            torch.testing.assert_close(one, two, rtol=0, atol=0, equal_nan=True)
    with pytest.raises(UserError, match="different views"):
        Journal(tmp_path, subject).begin("others")
    with pytest.raises(UserError, match="seed was 0, is 1"):
        Journal(tmp_path, other).begin("views")


def test_results_record_their_inputs(commands, whole):
    results = whole.json()
    assert results["fingerprints"].keys() == {"weights", "views"}
    training = json.loads((commands.folder / "score" / "training.json").read_text())
    assert training["fingerprints"].keys() == {"views"}
    assert training["fingerprints"]["views"] != results["fingerprints"]["views"]  # of other views
    assert {"git", "torch", "python"} <= results["versions"].keys() == training["versions"].keys()
    assert results["versions"]["git"] in ("not a checkout", "unknown") or len(results["versions"]["git"]) >= 40


def test_the_fingerprint_of_networks_changes_with_every_tensor():
    network = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.BatchNorm1d(4)).requires_grad_(False)
    found = {weights_fingerprint([network])}
    assert weights_fingerprint([network]) in found
    for value in network.state_dict().values():
        value.flatten()[-1:].add_(1)
        found.add(weights_fingerprint([network]))
    assert len(found) == 1 + len(network.state_dict())
    assert weights_fingerprint([network.to(torch.bfloat16)]) not in found


def test_pairs_are_saved_few_at_a_time_where_networks_are_large(commands, monkeypatch):
    monkeypatch.setattr("lp_framework.commands.eval.LARGE", 100)
    ran = commands.here("large", "eval", "checkpoint=./score", "solver.iterations=0", "protocol=per_view")
    assert ran.status == 0
    with (ran.folder / "pairs.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(OBJECTS) * TEST_VIEWS
    assert commands.here("none", "eval", *EVALUATION[:1], "batch_pairs=0").error == (
        "batch_pairs must be a number of pairs, or null; got 0"
    )
