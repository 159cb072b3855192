"""`eval` from the command line: results, protocols, sweeps, two processes, bad checkpoints."""

from __future__ import annotations

import copy
import csv
import json
import math
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_solver_contract import build
from tiny_runs import OBJECTS, Commands, Ran

from lp_framework.commands.eval import pairs_at_once
from lp_framework.data.module import EVALUATION_PAIRS
from lp_framework.data.pairs import PairBatch
from lp_framework.evaluation.evaluation import errors
from lp_framework.evaluation.metrics import summarise
from lp_framework.geometry import camera_to_world, relative_camera, rigid_transform, so3_exp
from lp_framework.models.checkpoints import SHIPPED
from lp_framework.solvers.base import Cost, Solution
from lp_framework.solvers.starts import Ring

METRICS = {f"{kind}@{degrees}" for kind in ("R", "R(R)", "SR", "SR(R)") for degrees in (5, 15, 30)}
METRICS |= {"rotation_error", "translation_error"}
TEST_VIEWS = 12  # 4 objects of 132 ordered pairs: 3 batches, which two processes cannot share evenly
PAIRS = len(OBJECTS) * TEST_VIEWS * (TEST_VIEWS - 1)


@pytest.fixture(scope="module")
def commands(tmp_path_factory, trained) -> Commands:
    return Commands(tmp_path_factory.mktemp("evaluation"), test_views=TEST_VIEWS, trained=trained)


@pytest.fixture(scope="module")
def evaluated(commands) -> Ran:
    """The score model, evaluated by default settings."""
    ran = commands.here("evaluated", "eval", "checkpoint=./score")
    assert ran.status == 0, ran.err
    return ran


def comparable(ran: Ran) -> dict[str, Any]:
    """The results without what differs from run to run."""
    return {key: value for key, value in ran.json().items() if key not in ("seconds_per_pair", "config")}


def pair_rows(ran: Ran) -> list[dict[str, str]]:
    with (ran.folder / "pairs.csv").open() as file:
        return list(csv.DictReader(file))


def close(found: Any, wanted: Any) -> bool:
    if isinstance(wanted, dict):
        return found.keys() == wanted.keys() and all(close(found[key], wanted[key]) for key in wanted)
    return found == pytest.approx(wanted, rel=1e-4, abs=1e-4) if isinstance(wanted, float) else found == wanted


# ---------------------------------------------------------------- results


def test_results_have_the_agreed_form(evaluated):
    results = evaluated.json()
    assert results.keys() >= {
        "metrics", "metrics_unique_answer", "per_object", "per_ambiguity", "protocol", "pairs", "seconds_per_pair",
        "config", "versions", "seed",
    }  # fmt: skip
    groups = [results["metrics"], results["metrics_unique_answer"]]
    groups += [*results["per_object"].values(), *results["per_ambiguity"].values()]
    for group in groups:
        assert group.keys() == METRICS
        assert all(0 <= group[name] <= 1 for name in METRICS if "@" in name)
        assert 0 <= group["rotation_error"] <= 180
        assert group["translation_error"] >= 0
        for name in ("R", "R(R)", "SR", "SR(R)"):
            assert group[f"{name}@5"] <= group[f"{name}@15"] <= group[f"{name}@30"]
    assert results["per_object"].keys() == OBJECTS.keys()
    assert list(results["per_ambiguity"]) == ["unique", "twofold", "continuous"]
    assert (results["protocol"], results["seed"], results["pairs"]) == ("ordered", 0, PAIRS)
    assert results["seconds_per_pair"] > 0
    assert results["config"]["solver"]["name"] == "langevin"
    assert results["config"]["start"]["name"] == "grid"
    assert results["checkpoint"] == str(Path("score/checkpoints/best.ckpt"))
    assert {"python", "torch", "lightning", "git"} <= results["versions"].keys()


def test_the_results_are_those_of_the_pairs(evaluated):
    rows, results = pair_rows(evaluated), evaluated.json()
    assert len({(row["object"], row["reference"], row["query"]) for row in rows}) == len(rows) == PAIRS
    for name, metrics in results["per_object"].items():
        rotation = np.array([float(row["rotation_error_degrees"]) for row in rows if row["object"] == name])
        translation = np.array([float(row["translation_error"]) for row in rows if row["object"] == name])
        assert len(rotation) == TEST_VIEWS * (TEST_VIEWS - 1)
        assert metrics["rotation_error"] == pytest.approx(np.median(rotation), abs=1e-4)
        assert metrics["R(R)@30"] == pytest.approx((rotation <= 30).mean())
        assert metrics["R@30"] == pytest.approx(((rotation <= 30) & (translation <= 0.2)).mean())


def test_a_pairs_errors_are_those_of_its_answer(evaluated, commands):
    for row in pair_rows(evaluated)[::37]:
        frames = json.loads((commands.folder / "views" / row["object"] / "test" / "transform.json").read_text())
        cameras = {frame["file_path"]: np.array(frame["transform_matrix"]) for frame in frames["frames"]}
        reference, query = cameras[row["reference"]], cameras[row["query"]]
        x, y, z = reference[:3, 3]
        radius = math.sqrt(x * x + y * y + z * z)
        latitude = math.asin(y / radius) + math.radians(float(row["latitude_degrees"]))
        longitude = math.atan2(x, z) + math.radians(float(row["longitude_degrees"]))
        radius += float(row["relative_radius"])
        flat = radius * math.cos(latitude)
        centre = np.array([flat * math.sin(longitude), radius * math.sin(latitude), flat * math.cos(longitude)])
        distance = np.linalg.norm(centre - query[:3, 3])
        assert float(row["translation_error"]) == pytest.approx(distance, abs=1e-3)


def test_the_table_has_the_papers_layout_and_the_last_lines_name_the_files(evaluated):
    assert f"renderings, langevin, start=grid, {PAIRS} pairs (ordered)" in evaluated.out
    table = evaluated.out[evaluated.out.index("renderings, langevin") :]
    for label in ("@5", "@15", "@30", "R(R)", "SR(R)", "Rot.", "Trans.", "all objects", "unique answer", "continuous"):
        assert label in table
    assert f"results:  {evaluated.folder.name}/results.json" in evaluated.out.splitlines()
    assert evaluated.err == ""
    with (evaluated.folder / "results.csv").open() as file:
        names = [row["name"] for row in csv.DictReader(file)]
    assert names == ["all objects", "unique answer", "unique", "twofold", "continuous", *OBJECTS]


def test_results_are_reproducible(evaluated, commands):
    again = commands.here("again", "eval", "checkpoint=./score/checkpoints/best.ckpt")
    assert comparable(again) == comparable(evaluated)
    assert (again.folder / "pairs.csv").read_bytes() == (evaluated.folder / "pairs.csv").read_bytes()
    other = commands.here("other", "eval", "checkpoint=./score", "seed=1")
    assert (other.folder / "pairs.csv").read_bytes() != (evaluated.folder / "pairs.csv").read_bytes()


def test_per_view_takes_every_test_view_once_as_query(commands):
    ran = commands.here("per_view", "eval", "checkpoint=./score", "protocol=per_view")
    rows = pair_rows(ran)
    assert {(row["object"], row["query"]) for row in rows} == {
        (name, f"{view:03d}.png") for name in OBJECTS for view in range(TEST_VIEWS)
    }
    assert ran.json()["pairs"] == len(rows) == len(OBJECTS) * TEST_VIEWS


def test_ifusions_protocol_takes_20_pairs_of_the_first_training_views(commands):
    ran = commands.here("ifusion", "eval", "checkpoint=./score", "protocol=ifusion")
    rows = pair_rows(ran)
    assert ran.json()["pairs"] == len(rows) == 20 * len(OBJECTS)
    assert {row["reference"] for row in rows} == {f"{view:03d}.png" for view in range(5)}


def test_the_energy_model_is_evaluated_and_may_choose_by_its_energy(commands):
    ran = commands.here("by_energy", "eval", "checkpoint=energy", "solver.choose_by=energy")
    assert ran.status == 0, ran.err
    assert ran.json()["metrics"].keys() == METRICS
    assert "choose_by=energy needs model=energy" in (
        commands.here("no_energy", "eval", "checkpoint=./score", "solver.choose_by=energy").error
    )


@pytest.mark.heavy
def test_a_sweep_has_a_folder_and_results_for_every_combination(commands):
    ran = commands.here(
        "unused", "eval", "--multirun", "checkpoint=./score", "protocol=per_view", "start=random", "start.count=1,2",
        "solver.gamma=0,0.3", "hydra.sweep.dir=sweep",
    )  # fmt: skip
    assert ran.status == 0, ran.err
    found = {}
    for job in range(4):
        results = json.loads((commands.folder / "sweep" / str(job) / "results.json").read_text())
        config = results["config"]
        found[config["solver"]["gamma"], config["start"]["count"]] = results["metrics"]
    assert found.keys() == {(0, 1), (0, 2), (0.3, 1), (0.3, 2)}
    assert found[0, 1] != found[0.3, 1]


# ---------------------------------------------------------------- errors of a solution


@pytest.mark.parametrize(
    ("solver", "starts", "pairs"), [("ifusion", 9, 4), ("two_stage", 2, 18), ("ifusion", 100, 1), ("id_pose", 9, 7)]
)
def test_a_batch_of_pairs_fills_a_large_prior_and_no_more(monkeypatch, solver, starts, pairs):
    built = build(solver)
    assert pairs_at_once(None, built, Ring(starts)) == EVALUATION_PAIRS
    monkeypatch.setattr("lp_framework.commands.eval.LARGE", -1)
    assert pairs_at_once(None, built, Ring(starts)) == pairs


def test_poses_are_not_computed_in_less_than_float32(commands):
    ran = commands.here("half", "eval", "checkpoint=./score", "trainer.precision=bf16-mixed")
    assert ran.error.startswith("trainer.precision must be 32-true, as poses are computed in float32")


def test_errors_compare_the_querys_predicted_camera_with_its_true_one():
    poses = torch.tensor([[0.1, 0.3, 1.5], [0.4, 2.0, 1.3]], dtype=torch.float64)
    batch = PairBatch(
        pixels=None, features=None, names=["a/0", "a/1"], poses=poses, cameras=camera_to_world(poses),
        objects=torch.zeros(2).long(), reference=torch.tensor([0, 1]), query=torch.tensor([1, 0]),
        pairs=torch.tensor([[0, 1], [1, 0]]),
    )  # fmt: skip
    true = batch.relative_poses()[:, None].double()
    turned = true + torch.tensor([0.0, math.radians(10), 0.0], dtype=torch.float64)
    predicted = torch.cat([true, turned], dim=1)
    empty = torch.zeros(2, 2)
    solution = Solution(predicted, empty, empty == 0, torch.zeros(2).long(), Cost(0, 0.0))
    rotation, translation = errors(solution, batch)
    assert rotation[:, 0].max() < 1e-3  # relative poses of a batch are float32
    assert translation[:, 0].max() < 1e-5
    torch.testing.assert_close(rotation[:, 1], torch.full((2,), 10.0, dtype=torch.float64), rtol=0, atol=1e-3)
    across = 2 * math.sin(math.radians(5)) * (poses[:, 2] * poses[:, 0].cos())[batch.query]
    torch.testing.assert_close(translation[:, 1], across, rtol=1e-4, atol=1e-5)


def test_a_start_that_is_not_valid_is_a_failure_wherever_it_ended():
    poses = torch.tensor([[0.1, 0.3, 1.5], [0.4, 2.0, 1.3]], dtype=torch.float64)
    batch = PairBatch(
        pixels=None, features=None, names=["a/0", "a/1"], poses=poses, cameras=camera_to_world(poses),
        objects=torch.zeros(2).long(), reference=torch.tensor([0, 1]), query=torch.tensor([1, 0]),
        pairs=torch.tensor([[0, 1], [1, 0]]),
    )  # fmt: skip
    right = batch.relative_poses()[:, None].double().expand(-1, 3, -1)
    valid, chosen = torch.tensor([[True, False, True], [True, True, False]]), torch.zeros(2).long()
    rotation, translation = errors(Solution(right, torch.zeros(2, 3), valid, chosen, Cost(0, 0.0)), batch)
    metrics = summarise(rotation, translation, chosen)
    assert metrics["SR@5"] == metrics["SR(R)@30"] == pytest.approx(4 / 6)
    assert metrics["R@5"] == metrics["R(R)@30"] == 1
    assert rotation.isnan().tolist() == translation.isnan().tolist() == (~valid).tolist()


def test_full_cameras_are_judged_at_the_scale_that_suits_each_best():
    poses = torch.tensor([[0.1, 0.3, 1.5], [0.4, 2.0, 1.3]], dtype=torch.float64)
    batch = PairBatch(
        pixels=None, features=None, names=["a/0", "a/1"], poses=poses, cameras=camera_to_world(poses),
        objects=torch.zeros(2).long(), reference=torch.tensor([0, 1]), query=torch.tensor([1, 0]),
        pairs=torch.tensor([[0, 1], [1, 0]]),
    )  # fmt: skip
    true = relative_camera(batch.cameras, batch.cameras.flip(0))[:, None]
    half = rigid_transform(true[..., :3, :3], true[..., :3, 3] / 2)
    turned = true @ rigid_transform(so3_exp(torch.tensor([0.0, math.radians(10), 0.0])), torch.zeros(3)).double()
    aside = rigid_transform(true[..., :3, :3], true[..., :3, 3].roll(1, dims=-1))
    cameras = torch.cat([half, turned, aside, torch.full_like(true, torch.nan)], dim=1)
    empty = torch.zeros(2, 4)
    poses_given = torch.full((2, 4, 3), torch.nan)  # not looked at
    solution = Solution(poses_given, empty, empty == 0, torch.zeros(2).long(), Cost(0, 0.0), cameras)
    rotation, translation = errors(solution, batch)
    assert rotation[:, [0, 2]].max() < 1e-5 and translation[:, :2].max() < 1e-12
    torch.testing.assert_close(rotation[:, 1], torch.full((2,), 10.0, dtype=torch.float64), rtol=0, atol=1e-5)
    length = torch.linalg.vector_norm(true[:, 0, :3, 3], dim=-1)
    cosine = (aside[:, 0, :3, 3] * true[:, 0, :3, 3]).sum(-1) / length.square()
    torch.testing.assert_close(translation[:, 2], length * (1 - cosine.clamp(min=0).square()).sqrt())
    assert rotation[:, 3].isnan().all() and translation[:, 3].isnan().all()


# ---------------------------------------------------------------- bad checkpoints


class Code:
    """Unpickled carelessly, this makes a folder."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.mkdir, (Path("executed"),))


def stored(commands: Commands, name: str, **changes: Any) -> str:
    """A copy of the score model's checkpoint with other entries; what is None is left out."""
    checkpoint = torch.load(commands.folder / "score" / "checkpoints" / "best.ckpt", weights_only=True)
    checkpoint = {key: value for key, value in {**copy.deepcopy(checkpoint), **changes}.items() if value is not None}
    torch.save(checkpoint, commands.folder / name)
    return name


def recipe(commands: Commands, group: str, **changes: Any) -> dict[str, Any]:
    contents = torch.load(commands.folder / "score" / "checkpoints" / "best.ckpt", weights_only=True)["lp_framework"]
    return {**contents, group: {**contents[group], **changes}}


def test_unused_settings_are_reported_and_the_model_is_named(commands):
    quick = ("solver.iterations=1", "checkpoint=./score")
    ran = commands.here("unused", "eval", *quick, "prior.path=nowhere")
    assert ran.status == 0 and "WARNING: prior=... has no effect: solver=langevin takes no prior" in ran.err
    assert ran.out.startswith(f"model: {Path('score/checkpoints/best.ckpt')}\n")
    ran = commands.here("unused_model", "eval", "checkpoint=nowhere", "solver=features")
    assert "WARNING: checkpoint=... has no effect: solver=features takes no model" in ran.err


def test_without_a_checkpoint_the_model_is_the_one_that_ships(commands):
    """Whatever has been trained here last: only `checkpoint=latest` means that."""
    latest = commands.folder / "runs" / "train" / "latest"
    shutil.copytree(commands.folder / "score", latest)
    try:
        quick = ("solver.iterations=1", "solver.gamma=0")
        shipped = commands.here("shipped", "eval", *quick)
        assert shipped.out.startswith("model: score, which ships with lp_framework (trained on the twelve embedded ")
        assert Path(shipped.json()["checkpoint"]) == SHIPPED / "score" / "model.safetensors"
        asked = commands.here("asked", "eval", *quick, "checkpoint=latest")
        assert asked.out.startswith(f"model: {Path('runs/train/latest/checkpoints/best.ckpt')}\n")
    finally:
        shutil.rmtree(latest.parents[1])


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("log_every_n_steps=abc", "trainer.log_every_n_steps=abc does not fit; expected Optional[int]"),
        (
            "deterministic=maybe",
            "trainer.deterministic=maybe does not fit; expected Union[bool, Literal['warn'], NoneType]",
        ),
        ("accelerator=tpu", "trainer: Requirement 'torch_xla"),
    ],
)
def test_odd_settings_of_the_trainer(commands, setting, sentence):
    assert commands.here("odd", "eval", f"++trainer.{setting}", "checkpoint=./score").error.startswith(sentence)


def test_a_missing_checkpoint(commands):
    assert commands.here("x", "eval", "checkpoint=gone.ckpt").error == "gone.ckpt: there is no such checkpoint"
    assert commands.here("x", "eval", "checkpoint=views").error.startswith("views: contains no checkpoints/best.ckpt")


@pytest.mark.parametrize("kind", ["text", "empty", "truncated", "code", "code in a checkpoint"])
def test_a_file_that_is_no_readable_checkpoint(commands, kind):
    file = commands.folder / "bad.ckpt"
    whole = (commands.folder / "score" / "checkpoints" / "best.ckpt").read_bytes()
    contents = {"text": b"weights, surely\n" * 50, "empty": b"", "truncated": whole[: len(whole) // 2]}
    if kind == "code":
        file.write_bytes(pickle.dumps(Code()))
    elif kind == "code in a checkpoint":
        torch.save({"lp_framework": {}, "state_dict": Code()}, file)
    else:
        file.write_bytes(contents[kind])
    ran = commands.here("x", "eval", "checkpoint=bad.ckpt")
    assert ran.error.startswith("bad.ckpt: is not a readable checkpoint")
    assert not (commands.folder / "executed").exists()


def test_checkpoints_of_other_programs(commands):
    stored(commands, "foreign.ckpt", lp_framework=None)
    wanted = "foreign.ckpt: is not a checkpoint written by `lp train`"
    assert commands.here("x", "eval", "checkpoint=foreign.ckpt").error == wanted


def test_weights_of_another_size_or_model(commands):
    stored(commands, "wider.ckpt", lp_framework=recipe(commands, "model", hidden=32))
    assert commands.here("x", "eval", "checkpoint=wider.ckpt").error.startswith(
        "wider.ckpt: its weights do not fit its score model: size mismatch for network."
    )
    stored(commands, "deeper.ckpt", lp_framework=recipe(commands, "model", layers=4))
    assert 'weights do not fit its score model: Missing key(s) in state_dict: "network.residual.3' in (
        commands.here("x", "eval", "checkpoint=deeper.ckpt").error
    )


def test_a_checkpoint_of_an_unknown_backbone_or_setting(commands):
    stored(commands, "unknown.ckpt", lp_framework=recipe(commands, "backbone", name="tmp_tinny"))
    error = commands.here("x", "eval", "checkpoint=unknown.ckpt").error
    assert error.startswith("unknown.ckpt: ")
    assert "tmp_tiny" in error
    stored(commands, "setting.ckpt", lp_framework=recipe(commands, "model", widht=3))
    error = commands.here("x", "eval", "checkpoint=setting.ckpt").error
    assert error.startswith("setting.ckpt: ")
    assert "widht" in error


def test_a_frozen_trunk_with_other_weights_is_detected(commands):
    stored(commands, "drawn.ckpt", lp_framework=recipe(commands, "backbone", draw=1))
    assert commands.here("x", "eval", "checkpoint=drawn.ckpt").error == (
        "drawn.ckpt: the frozen part of its backbone has other weights here than when the model was trained; "
        "use the same pretrained weights"
    )


def test_objects_need_no_training_views_to_be_evaluated(commands):
    folder = commands.folder / "only_tests" / "cup"
    shutil.copytree(commands.folder / "views" / "cup" / "test", folder / "test")
    ran = commands.here("only", "eval", "checkpoint=./score", "data.path=only_tests")
    assert ran.status == 0, ran.err
    assert list(ran.json()["per_object"]) == ["cup"]
