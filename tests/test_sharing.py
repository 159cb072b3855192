"""Sharing a trained model: loggers, a folder of weights with a model card, the Hugging Face hub."""

from __future__ import annotations

import json
import re
import shutil
import sys
import types
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from lp_framework import load_model
from lp_framework.commands import train
from lp_framework.commands.convert import upload
from lp_framework.commands.train import chosen_logger
from lp_framework.errors import UserError
from lp_framework.report.model_card import model_card


@pytest.fixture
def evaluation(tmp_path: Path) -> Path:
    """A folder with the results of an evaluation."""
    row = {f"{name}@{limit}": 0.5 for name in ("R", "R(R)", "SR", "SR(R)") for limit in (5, 15, 30)}
    row |= {"rotation_error": 12.5, "translation_error": 0.1, "R(R)@30": 0.875}
    config = {"data": {"name": "toy"}, "solver": {"name": "two_stage"}}
    content = {"metrics": row, "metrics_unique_answer": None, "per_ambiguity": {}, "config": config}
    (tmp_path / "eval").mkdir()
    (tmp_path / "eval" / "results.json").write_text(json.dumps(content))
    return tmp_path / "eval"


def test_a_shared_folder_holds_the_weights_and_a_card(
    trained: Path, evaluation: Path, lp: Any, tmp_path: Path, walker: Path
) -> None:
    given = f"path={trained}/score", f"output={tmp_path}/shared", f"results={evaluation}", "license=mit"
    ran = lp("convert", *given)
    assert ran.status == 0, ran.err
    _, metadata, card = (tmp_path / "shared" / "README.md").read_text().split("---\n", 2)
    assert yaml.safe_load(metadata) == {
        "library_name": "lp_framework", "tags": ["camera-pose-estimation", "score"], "license": "mit"
    }  # fmt: skip
    assert card.startswith("# shared\n")
    assert re.search(r"Command: `python -m lp_framework train .*model=score", card)
    assert "checkpoint=shared" in card
    assert "On `data=toy` with `solver=two_stage`" in card
    assert "| all objects | 0.500 |" in card and "| 0.875 |" in card and "| 12.500 |" in card
    training = json.loads((trained / "score" / "training.json").read_text())
    assert all(name in card for name in training["objects"])
    assert f"Seed {training['seed']}, 1 epochs" in card


def test_a_card_without_an_evaluation_says_so_and_a_damaged_one_is_named(trained: Path, tmp_path: Path) -> None:
    card = model_card(trained / "energy", "somebody/energy", None, None)
    assert "Not evaluated." in card
    assert "license" not in card
    with pytest.raises(UserError, match=r"the model card cannot be written: .*results\.json"):
        model_card(trained / "energy", "name", None, str(tmp_path))


def test_an_unfinished_run_is_converted_without_a_card_unless_requested(
    trained: Path, lp: Any, tmp_path: Path, walker: Path
) -> None:
    shutil.copytree(trained / "score", tmp_path / "stopped")
    (tmp_path / "stopped" / "training.json").unlink()
    given = f"path={tmp_path}/stopped", f"output={tmp_path}/shared"
    ran = lp("convert", *given, "license=mit")
    assert ran.status == 1
    assert "the model card cannot be written" in ran.error
    assert not (tmp_path / "shared").exists()
    ran = lp("convert", *given)
    assert ran.status == 0, ran.err
    assert "the model card cannot be written" in ran.err
    assert {file.name for file in (tmp_path / "shared").iterdir()} >= {"model.json", "model.safetensors"}
    assert not (tmp_path / "shared" / "README.md").exists()


def test_a_folder_is_uploaded_under_its_id(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    calls = []

    def create_repo(name: str, exist_ok: bool) -> str:
        calls.append((name, exist_ok))
        return f"https://huggingface.co/{name}"

    def upload_folder(repo_id: str, folder_path: Path) -> None:
        calls.append((repo_id, folder_path))
        if repo_id == "somebody/closed":
            raise OSError("403 Forbidden")

    hub = types.SimpleNamespace(create_repo=create_repo, upload_folder=upload_folder)
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    assert upload(tmp_path, "somebody/model") == "https://huggingface.co/somebody/model"
    assert calls == [("somebody/model", True), ("somebody/model", tmp_path)]
    with pytest.raises(UserError, match=f"403 Forbidden.*to retry: `hf upload somebody/closed {tmp_path}`"):
        upload(tmp_path, "somebody/closed")


def test_a_shared_model_is_loaded_offline_from_the_hubs_cache(
    lp: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("huggingface_hub")
    shipped = Path(train.__file__).parents[1] / "weights" / "score"
    snapshot = tmp_path / "cache" / "models--somebody--score" / "snapshots" / ("0" * 40)
    snapshot.mkdir(parents=True)
    for name in ("model.json", "model.safetensors"):
        (snapshot / name).symlink_to(shipped / name)
    (tmp_path / "cache" / "models--somebody--score" / "refs").mkdir()
    (tmp_path / "cache" / "models--somebody--score" / "refs" / "main").write_text("0" * 40)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.chdir(tmp_path)
    one, other = load_model("somebody/score"), load_model("score")
    assert all(torch.equal(a, b) for a, b in zip(one.state_dict().values(), other.state_dict().values(), strict=True))


def test_the_card_s_settings_belong_to_trainings(lp: Any, tmp_path: Path) -> None:
    ran = lp("convert", f"path={tmp_path}", f"output={tmp_path}/new", "license=mit")
    assert ran.status == 1
    assert ran.error == f"license applies only to training runs, and {tmp_path} is not one"


def test_loggers_get_the_settings_of_their_choice(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for package, name in (("wandb", "WandbLogger"), ("mlflow", "MLFlowLogger")):
        monkeypatch.setitem(sys.modules, package, types.ModuleType(package))
        monkeypatch.setattr(train, name, lambda *given, **named: (given, named))
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    wandb = {"name": "wandb", "project": "p", "entity": None, "offline": True}
    assert chosen_logger(wandb, tmp_path / "run") == [
        (("run",), {"save_dir": tmp_path / "run", "project": "p", "entity": None, "offline": True})
    ]
    mlflow = {"name": "mlflow", "experiment": "e", "tracking_uri": None}
    own = f"sqlite:///{tmp_path / 'run'}/mlflow.db"
    assert chosen_logger(mlflow, tmp_path / "run") == [(("e", "run"), {"tracking_uri": own})]
    given = {**mlflow, "tracking_uri": "http://there"}
    assert chosen_logger(given, tmp_path / "run") == [(("e", "run"), {"tracking_uri": "http://there"})]
    assert chosen_logger({"name": "csv"}, tmp_path) == []


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_a_logger_without_its_package_says_how_to_get_it(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(UserError, match=rf"logger={name} needs .*'{name}'.*lp_framework\[loggers\]"):
        chosen_logger({"name": name}, tmp_path)
