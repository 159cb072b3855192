"""`train` from the command line: output files, resuming after kill -9, two processes, early stopping, errors."""

from __future__ import annotations

import csv
import errno
import os
import re
import shutil
import signal
import sys
import time
import types
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny_runs import Commands, Ran

from lp_framework.commands.train import MetricsLogger
from lp_framework.errors import UserError
from lp_framework.models.checkpoints import SHIPPED, find_checkpoint, latest_checkpoint, load_model, read_checkpoint
from lp_framework.models.pose_model import ScoreModel
from lp_framework.run_folders import held

EVERYTHING = ("ema=0.9", "model.dropout=0.2", "trainer.max_epochs=6")


@pytest.fixture(scope="module")
def commands(tmp_path_factory) -> Commands:
    return Commands(tmp_path_factory.mktemp("training"))


@pytest.fixture(scope="module")
def score(commands) -> Ran:
    """A score model after three epochs."""
    ran = commands.here("score", "train")
    assert ran.status == 0, ran.err
    return ran


@pytest.fixture(scope="module")
def whole(commands) -> Ran:
    """An uninterrupted run with a moving average and dropout."""
    ran = commands.here("whole", "train", *EVERYTHING)
    assert ran.status == 0, ran.err
    return ran


@pytest.fixture(scope="module")
def killed(commands) -> Ran:
    """The same run in a process, killed as soon as its first checkpoint is there."""
    process = commands.start("killed", "train", *EVERYTHING, "backbone.pause=0.05")
    last = commands.folder / "killed" / "checkpoints" / "last.ckpt"
    deadline = time.monotonic() + 100
    while not last.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGKILL)
    out, err = process.communicate()
    assert process.returncode == -signal.SIGKILL
    return Ran(process.returncode, out, err, last.parents[1])


def rows(ran_folder: Path) -> list[dict[str, str]]:
    with (ran_folder / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def assert_equal(one: Any, two: Any, place: str = "") -> None:
    """Equal to the last bit, tensors included."""
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, two), place
    elif isinstance(one, dict):
        assert one.keys() == two.keys(), place
        for key in one:
            assert_equal(one[key], two[key], f"{place}/{key}")
    elif isinstance(one, list):
        assert len(one) == len(two), place
        for index, (first, second) in enumerate(zip(one, two, strict=True)):
            assert_equal(first, second, f"{place}/{index}")
    else:
        assert one == two, place


# ---------------------------------------------------------------- a run


def test_a_run_leaves_checkpoints_config_metrics_and_its_log(score):
    for name in ("checkpoints/best.ckpt", "checkpoints/last.ckpt", "config.yaml", "train.log", "training.json"):
        assert (score.folder / name).is_file(), name
    summary = score.json("training.json")
    assert len(summary["objects"]) == len(set(summary["objects"])) > 1
    assert summary["epochs"] == 3
    assert summary["model"]["name"] == "score"
    assert summary["backbone"]["name"] == "tmp_tiny"
    losses = [float(row["val/loss"]) for row in rows(score.folder) if row["val/loss"]]
    assert len(losses) == 3
    assert losses[-1] < losses[0]
    assert summary["final"]["val/loss"] == pytest.approx(losses[-1], rel=1e-6)


def test_the_console_ends_with_the_model_and_the_next_command(score):
    lines = [" ".join(line.split()) for line in score.out.splitlines()]
    # Relative to the working directory, in which the runs of these tests lie.
    assert f"model: {score.folder.name}/checkpoints/best.ckpt" in lines
    evaluation = f"next: python -m lp_framework eval checkpoint={score.folder.name} data=renderings"
    assert lines[-1] == f"{evaluation} data.image_size=16 data.path=views"


@pytest.mark.heavy
def test_the_console_has_no_notes_and_advertisements(score, killed):
    assert score.err == ""
    assert "Tip" not in score.out
    assert "Tip" in (score.folder / "train.log").read_text()  # Lightning's notes are in the log
    assert killed.err == ""  # in a process of its own nobody has set up logging before


def test_the_same_seed_gives_the_same_weights_and_another_gives_others(score, commands):
    again = commands.here("again", "train")
    assert_equal(again.checkpoint()["state_dict"], score.checkpoint()["state_dict"])
    other = commands.here("other", "train", "seed=1").checkpoint()["state_dict"]
    assert any(not torch.equal(value, other[key]) for key, value in score.checkpoint()["state_dict"].items())


def test_a_checkpoint_names_its_model_and_lacks_the_frozen_trunk(score, whole):
    for ran in (score, whole):
        checkpoint = ran.checkpoint()
        assert checkpoint["lp_framework"]["model"]["name"] == "score"
        assert checkpoint["lp_framework"]["backbone"]["name"] == "tmp_tiny"
        for state in {"state_dict", "current_model_state"} & checkpoint.keys():
            assert not any(key.startswith("backbone.net") for key in checkpoint[state])
            assert any(key.startswith("backbone.head") for key in checkpoint[state])
    assert "current_model_state" in whole.checkpoint()


def test_the_best_checkpoint_is_that_of_the_least_validation_loss(score):
    losses = [(float(row["val/loss"]), int(row["epoch"])) for row in rows(score.folder) if row["val/loss"]]
    assert score.checkpoint("best.ckpt")["epoch"] == min(losses)[1]


def test_a_moving_average_lags_behind_the_weights(whole):
    checkpoint = whole.checkpoint()
    average, current = checkpoint["state_dict"], checkpoint["current_model_state"]
    assert average.keys() == current.keys()
    assert any(not torch.equal(average[key], current[key]) for key in average)


def test_training_stops_where_the_validation_loss_no_longer_falls(commands):
    ran = commands.here("stopped", "train", "patience=1", "model.learning_rate=0.0", "trainer.max_epochs=9")
    assert ran.json("training.json")["epochs"] == 2


def test_no_validation_views_train_on_all_and_keep_the_last(commands):
    ran = commands.here("unvalidated", "train", "data.validation_views=0", "trainer.max_epochs=1")
    assert ran.status == 0, ran.err
    assert ran.checkpoint("best.ckpt")["global_step"] == ran.checkpoint()["global_step"] > 0
    assert "val/loss" not in ran.json("training.json")["final"]


def test_mixed_precision_and_a_backbone_that_trains_along(commands):
    mixed = ("trainer.precision=bf16-mixed", "backbone.frozen=false", "trainer.max_epochs=1")
    ran = commands.here("half", "train", *mixed)
    assert ran.status == 0, ran.err
    assert ran.json("training.json")["final"]["val/loss"] > 0
    weights = ran.checkpoint()["state_dict"]
    assert {value.dtype for value in weights.values()} == {torch.float32}
    start = torch.randn(weights["backbone.net.0.weight"].shape, generator=torch.Generator().manual_seed(0)) / 5
    assert (weights["backbone.net.0.weight"] - start).abs().max() > 1e-4


def test_the_papers_alternatives_train(commands):
    settings = ("model.noise=gaussian", "model.target=line", "model.schedule=constant", "model.view_loss=0")
    ran = commands.here("alternatives", "train", *settings, "trainer.max_epochs=1")
    assert ran.status == 0, ran.err
    assert ran.json("training.json")["final"]["val/loss"] > 0


# ---------------------------------------------------------------- resuming


@pytest.mark.heavy
def test_resuming_after_kill_9_gives_the_weights_of_an_uninterrupted_run(commands, whole, killed):
    last = killed.checkpoint()
    assert 1 <= last["epoch"] + 1 < 6  # it was killed on the way
    resumed = commands.here("resumed", "train", "resume=killed")
    assert resumed.status == 0, resumed.err
    end, wanted = killed.checkpoint(), whole.checkpoint()
    assert end["epoch"] == wanted["epoch"] == 5
    for part in ("state_dict", "current_model_state", "optimizer_states", "lr_schedulers"):
        assert_equal(end[part], wanted[part], part)
    assert_equal(killed.checkpoint("best.ckpt")["state_dict"], whole.checkpoint("best.ckpt")["state_dict"])


def test_a_resumed_run_keeps_its_metrics_and_settings(commands):
    commands.here("prolonged", "train", "trainer.max_epochs=2")
    first = rows(commands.folder / "prolonged")
    ran = commands.here("onwards", "train", "resume=prolonged", "trainer.max_epochs=3")
    assert ran.status == 0, ran.err
    every = rows(commands.folder / "prolonged")
    assert [row["val/loss"] for row in every[: len(first)]] == [row["val/loss"] for row in first]
    assert [row["epoch"] for row in every if row["val/loss"]] == ["0", "1", "2"]
    finished = commands.here("finished", "train", "resume=prolonged")  # not up to the default number of epochs
    assert finished.error == ("prolonged: all epochs are done; to train longer: resume=prolonged trainer.max_epochs=N")
    (commands.folder / "prolonged" / "training.json").unlink()  # as if it had been killed at the very end
    assert commands.here("reported", "train", "resume=prolonged").status == 0
    assert (commands.folder / "prolonged" / "training.json").is_file()


def test_ctrl_c_says_how_to_resume(commands, monkeypatch):
    begin = ScoreModel.on_train_epoch_start

    def interrupted(self: ScoreModel) -> None:
        if self.current_epoch == 1:
            raise KeyboardInterrupt
        begin(self)

    handler = signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as patch:
        patch.setattr(ScoreModel, "on_train_epoch_start", interrupted)
        ran = commands.here("interrupted", "train", "trainer.max_epochs=2")
    signal.signal(signal.SIGINT, handler)  # Lightning has switched it off
    assert (ran.status, ran.err.splitlines()[-1]) == (130, "interrupted; to continue: resume=interrupted")
    assert commands.here("unused", "train", "resume=interrupted").status == 0


@pytest.mark.parametrize("written_by", ["this version", "an earlier one"])
def test_the_best_epoch_of_a_moved_run_stays_the_best(commands, score, written_by):
    moved = commands.folder / f"moved by {written_by}"
    shutil.copytree(score.folder, moved)
    best, last = moved / "checkpoints" / "best.ckpt", moved / "checkpoints" / "last.ckpt"
    checkpoint = torch.load(last, weights_only=True)
    (key,) = (key for key in checkpoint["callbacks"] if "val/loss" in key)
    state = checkpoint["callbacks"][key]
    assert str(commands.folder) not in str(checkpoint["callbacks"])
    here = "" if written_by == "this version" else "/an/earlier/place/checkpoints/"
    unbeatable = torch.tensor(-1.0)
    checkpoint["callbacks"][key] = state | {
        "dirpath": here, "best_model_path": f"{here}best.ckpt", "kth_best_model_path": f"{here}best.ckpt",
        "best_model_score": unbeatable, "kth_value": unbeatable, "best_k_models": {f"{here}best.ckpt": unbeatable},
    }  # fmt: skip
    torch.save(checkpoint, last)
    before = best.read_bytes()
    ran = commands.here("unused", "train", f"resume='{moved.name}'", "trainer.max_epochs=4")
    assert ran.status == 0 and ran.err == "", ran.err
    assert best.read_bytes() == before
    after = torch.load(last, weights_only=True)
    assert after["epoch"] == 3 and after["callbacks"][key]["best_model_score"] == unbeatable


def test_a_resumed_run_writes_only_to_its_own_folder(commands, score):
    folder = shutil.copytree(score.folder, commands.folder / "logged")
    hydra = (folder / ".hydra" / "overrides.yaml").read_text()
    log = (folder / "train.log").read_text()
    assert commands.here("unused", "train", "resume=logged", "trainer.max_epochs=4").status == 0
    assert (folder / "train.log").read_text().startswith(log) and (folder / "train.log").read_text() != log
    assert (folder / ".hydra" / "overrides.yaml").read_text() == hydra
    assert not (commands.folder / "unused").exists()


def test_a_second_training_in_a_folder_is_refused_and_changes_nothing(commands, score):
    folder = shutil.copytree(score.folder, commands.folder / "held")
    weights = (folder / "checkpoints" / "last.ckpt").read_bytes()
    with held(folder):
        for overrides in ((), ("resume=held", "trainer.max_epochs=4")):
            ran = commands.here("held", "train", *overrides)
            assert ran.error == "held: is in use by another command; wait for it, or choose another folder"
    assert (folder / "checkpoints" / "last.ckpt").read_bytes() == weights
    assert commands.here("unused", "train", "resume=held", "trainer.max_epochs=4").status == 0


def test_a_full_disk_leaves_complete_checkpoints_to_resume_from(commands, score, monkeypatch):
    write, room = Path.write_bytes, [3]

    def write_while_there_is_room(path: Path, content: bytes) -> int:
        if ".ckpt" in path.name:
            if room[0] == 0:
                write(path, bytes(content)[: len(content) // 2])
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            room[0] -= 1
        return write(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", write_while_there_is_room)
        ran = commands.here("filled", "train")
    folder = commands.folder / "filled"
    assert re.fullmatch(
        r"filled/checkpoints/(best|last)\.ckpt: cannot be written \(No space left on device: it needs more than the "
        r"[\d.]+ MB that are free\); free some space, then continue with resume=filled",
        ran.error,
    )
    assert sorted(each.name for each in (folder / "checkpoints").iterdir()) == ["best.ckpt", "last.ckpt"]
    assert all("epoch" in read_checkpoint(file) for file in (folder / "checkpoints").iterdir())
    assert all(None not in row.values() for row in rows(folder)) and rows(folder)
    assert commands.here("unused", "train", "resume=filled").status == 0
    for name in ("last.ckpt", "best.ckpt"):
        found = torch.load(folder / "checkpoints" / name, weights_only=True)
        assert_equal(found["state_dict"], score.checkpoint(name)["state_dict"])
    losses = [[row["val/loss"] for row in rows(each) if row["val/loss"]] for each in (folder, score.folder)]
    assert losses[0] == losses[1]


def test_metrics_are_complete_after_a_full_disk(tmp_path, monkeypatch):
    logger, write = MetricsLogger(tmp_path), Path.write_text
    logger.log_metrics({"train/loss": 1.0}, step=0)
    logger.save()

    def half(path: Path, text: str, **_: Any) -> None:
        write(path, text[: len(text) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch, pytest.raises(UserError, match=r"metrics\.csv: cannot be written \(No space"):
        patch.setattr(Path, "write_text", half)
        logger.log_metrics({"train/loss": 0.5, "val/loss": 0.7}, step=99)
    assert [row["train/loss"] for row in rows(tmp_path)] == ["1.0"]
    logger.finalize("failed")
    assert [(row["step"], row["train/loss"], row["val/loss"]) for row in rows(tmp_path)] == [
        ("0", "1.0", ""), ("99", "0.5", "0.7"),
    ]  # fmt: skip
    assert [each.name for each in tmp_path.iterdir()] == ["metrics.csv"]


def test_the_same_command_resumes_and_another_one_does_not_overwrite(commands, score):
    weights = score.checkpoint()["state_dict"]
    assert commands.here("score", "train").error.startswith("score: all epochs are done")
    assert commands.here("score", "train", "model=energy").error.startswith(
        "score: contains a training run with other set"
    )
    assert_equal(score.checkpoint()["state_dict"], weights)
    for missing in ("training.json", "report.html"):  # as a kill or a full disk leaves it
        (score.folder / missing).unlink()
        assert commands.here("score", "train").status == 0
        assert (score.folder / missing).is_file()
    assert_equal(score.checkpoint()["state_dict"], weights)


def test_a_diverged_training_is_an_error_and_its_model_is_not_used(commands, monkeypatch):
    ran = commands.here("runs/train/far", "train", "model.learning_rate=1e30", "trainer.max_epochs=1")
    assert ran.status == 1 and re.search(r"error: .*far: training diverged \(not finite: .*loss.*\)", ran.err)
    monkeypatch.chdir(commands.folder)
    with pytest.raises(UserError, match="checkpoint=latest: there is no training run of a model in "):
        find_checkpoint("latest")


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("ema=2", "ema must be a share from 0 to 1, or null for none; got 2"),
        ("ema=abc", "ema must be"),
        ("patience=-1", "patience must be a number of epochs, or null"),
        ("trainer.max_epochs=0", "trainer.max_epochs must be at least 1, got 0"),
    ],
)
def test_mistakes(commands, setting, sentence):
    assert commands.here("mistake", "train", setting).error.startswith(sentence)


@pytest.mark.parametrize("content", ["{", "[1]"])
def test_a_damaged_configuration_is_named(commands, score, content):
    folder = shutil.copytree(score.folder, commands.folder / f"damaged_{len(content)}")
    (folder / "config.yaml").write_text(content)
    sentence = f"{folder.name}/config.yaml: is missing or damaged ("
    assert commands.here("onwards", "train", f"resume={folder.name}").error.startswith(sentence)
    assert commands.here(folder.name, "train").error.startswith(sentence)


def test_resuming_a_missing_run_is_an_error(commands):
    for folder, said in (
        ("nowhere", "there is no such file or folder"),
        ("views", "contains no checkpoints/last.ckpt to resume from"),
    ):
        assert commands.here("nothing", "train", f"resume={folder}").error.startswith(f"resume={folder}: {said}")
        assert not (commands.folder / "nothing").exists()


def test_a_resumed_run_keeps_its_settings(commands, score):
    ran = commands.here("changed", "train", "resume=score", "model.hidden=32")
    assert ran.error == (
        f"model.hidden cannot be changed in a resumed run; leave it out ({Path('score/config.yaml')} has its value)"
    )


# ---------------------------------------------------------------- two processes


def test_the_validation_loss_does_not_depend_on_the_batches(commands):
    settings = ("model.learning_rate=0.0", "trainer.max_epochs=1")  # nothing is learned: both look at one network
    losses = []
    for size in (5, 7):  # 24 pairs, in batches of which the last is smaller
        ran = commands.here(f"batches_of_{size}", "train", *settings, f"data.batch_pairs={size}")
        losses.append(ran.json("training.json")["final"]["val/loss"])
    assert losses[0] == pytest.approx(losses[1], rel=1e-6)


# ---------------------------------------------------------------- checkpoint files


def test_a_run_a_checkpoint_and_the_latest_run_are_found(score, commands, tmp_path, monkeypatch):
    best = score.folder / "checkpoints" / "best.ckpt"
    assert find_checkpoint(score.folder) == best
    assert find_checkpoint(score.folder / "checkpoints") == best
    assert find_checkpoint(best) == best
    for age, name in enumerate(("new", "old")):
        shutil.copytree(score.folder / "checkpoints", tmp_path / name / "checkpoints")
        last = tmp_path / name / "checkpoints" / "last.ckpt"
        os.utime(last, (1e9 - age, 1e9 - age))
    assert latest_checkpoint(tmp_path) == tmp_path / "new" / "checkpoints" / "best.ckpt"
    (tmp_path / "new" / "checkpoints" / "best.ckpt").unlink()
    assert latest_checkpoint(tmp_path).name == "last.ckpt"
    assert find_checkpoint("score") == SHIPPED / "score" / "model.safetensors"
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "new").rename(tmp_path / "runs" / "train")
    (tmp_path / "runs" / "train" / "checkpoints").rename(tmp_path / "runs" / "checkpoints")
    (tmp_path / "runs" / "train" / "one").mkdir()
    (tmp_path / "runs" / "checkpoints").rename(tmp_path / "runs" / "train" / "one" / "checkpoints")
    assert find_checkpoint("latest") == Path("runs/train/one/checkpoints/last.ckpt")


def test_a_checkpoint_of_the_hub_is_fetched_by_its_id(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    asked = []

    def snapshot_download(name, allow_patterns):
        asked.append((name, sorted(allow_patterns)))
        if name == "somebody/nothing":
            raise OSError("no such repository")
        return str(tmp_path)

    hub = types.SimpleNamespace(snapshot_download=snapshot_download)
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    assert find_checkpoint("somebody/model") == tmp_path / "model.safetensors"
    assert asked == [("somebody/model", ["model.json", "model.safetensors"])]
    with pytest.raises(UserError, match="checkpoint=somebody/nothing: is neither a file, a folder nor on the hub"):
        find_checkpoint("somebody/nothing")
    (tmp_path / "runs").mkdir()
    assert find_checkpoint("runs/nothing") == Path("runs/nothing")  # a path whose folder is here asks nobody


def test_reading_a_checkpoint_executes_no_code(score):
    assert read_checkpoint(score.folder / "checkpoints" / "last.ckpt")["epoch"] == 2
    with pytest.raises(ValueError, match="there is no backbone 'tmp_tiny'"):
        load_model(score.folder)  # the plugin is not loaded here
