"""Damaged weights, of any origin, give the saved tensors or one sentence; code in them is never executed."""

from __future__ import annotations

import io
import json
import pickle
import shutil
import struct
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch
from corruptions import NONSENSE, damaged, json_damage, misshapen, read_or_reported, snapshot
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.torch import save
from tiny_runs import Commands
from torch import Tensor

import lp_framework
from lp_framework.models.checkpoints import SHIPPED, load_model, read_checkpoint
from lp_framework.priors.zero123.original import read_original
from lp_framework.priors.zero123.tensor_files import read_safetensors, read_state_dict

FUZZ = settings(
    max_examples=100,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
RECIPE = {"model": {"name": "score", "hidden": 4}, "backbone": {"name": "efficientnet_lite0"}}
TENSORS = {"weight": torch.arange(12.0).view(3, 4), "half": torch.ones(5).half(), "count": torch.tensor(3)}


def saved(contents: Any) -> bytes:
    buffer = io.BytesIO()
    torch.save(contents, buffer)
    return buffer.getvalue()


WHOLE = saved({"lp_framework": RECIPE, "state_dict": TENSORS, "epoch": 3, "optimizer_states": [TENSORS]})


class Runs:
    """When unpickled, makes the folder `executed` in the working directory."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.mkdir, (Path("executed"),))


# A pickle is a program: any opcodes, of real ones and with real names, may follow each other.
OPCODES = st.sampled_from(
    [
        *(bytes([code]) for code in b"()]}N.0210.aeus\x81\x85\x86\x87\x88\x89\x93\x94bRtldoQ"),
        *(b"cposix\nsystem\n", b"cbuiltins\nexec\n", b"cpathlib\nPosixPath\n", b"ctorch\nFloatStorage\n"),
        *(b"ctorch._utils\n_rebuild_tensor_v2\n", b"ccollections\nOrderedDict\n", b"ctorch.serialization\nload\n"),
        *(b"X\x05\x00\x00\x00touch", b"X\x0a\x00\x00\x00state_dict", b"X\x08\x00\x00\x00executed", b"K\x03"),
        *(b"J\xff\xff\xff\xff", b"h\x00", b"q\x00", b"q\x01", b"h\x01", b"G\x7f\xf0\x00\x00\x00\x00\x00\x00"),
        *(b"B\xff\xff\xff\x7f", b"\x8c\x02os"),
    ]
)  # fmt: skip


@st.composite
def archives(draw: st.DrawFn) -> bytes:
    """What `torch.save` writes, with damage to the archive, to its pickle, or with another pickle in it."""
    whole = draw(st.sampled_from(["archive", "pickle", "program", "record", "contents"]))
    if whole == "archive":
        return draw(damaged(WHOLE))
    if whole == "contents":
        contents = draw(misshapen({"lp_framework": RECIPE, "state_dict": {"a": [1], "b": {}}, "epoch": 3}))
        return saved(contents)
    old = zipfile.ZipFile(io.BytesIO(WHOLE))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as new:
        for info in old.infolist():
            data = old.read(info)
            if info.filename.endswith("data.pkl") and whole == "pickle":
                data = draw(damaged(data))
            elif info.filename.endswith("data.pkl") and whole == "program":
                data = b"\x80\x02" + b"".join(draw(st.lists(OPCODES, max_size=12))) + b"."
            elif "/data/" in info.filename and whole == "record":
                data = data[: draw(st.integers(0, len(data)))]
            compress = draw(st.sampled_from([zipfile.ZIP_STORED] * 4 + [zipfile.ZIP_DEFLATED]))
            new.writestr(info.filename, data, compress)
    return buffer.getvalue()


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def same_or_other_bits(tensors: dict[str, Tensor]) -> None:
    """Whole tensors; bits that were turned in a record cannot be seen, but nothing is read beyond it."""
    for tensor in tensors.values():
        assert tensor.numel() <= 10_000 and tensor.clone().shape == tensor.shape


@FUZZ
@given(content=archives())
def test_checkpoints_of_training(here, content):
    file = here / "last.ckpt"
    file.write_bytes(content)
    read_or_reported(lambda: load_model(file), file)
    assert file.read_bytes() == content and [each.name for each in here.iterdir()] == ["last.ckpt"]


@FUZZ
@given(content=archives())
def test_checkpoints_read_without_unpickling(here, content):
    file = here / "original.ckpt"
    file.write_bytes(content)
    tensors = read_or_reported(lambda: {name: stored.map() for name, stored in read_state_dict(file).items()}, file)
    assert file.read_bytes() == content and [each.name for each in here.iterdir()] == ["original.ckpt"]
    if tensors is not None:
        same_or_other_bits(tensors)


@st.composite
def safetensors(draw: st.DrawFn) -> bytes:
    """A safetensors file, damaged in its bytes or with a header that does not fit."""
    whole = save(TENSORS)
    if draw(st.booleans()):
        return draw(damaged(whole))
    (length,) = struct.unpack("<Q", whole[:8])
    header = draw(json_damage(json.loads(whole[8 : 8 + length])))
    size = draw(st.sampled_from([len(header), len(header) + 1, 0, 2**63, 2**64 - 1]))
    return struct.pack("<Q", size) + header + whole[8 + length :]


@FUZZ
@given(content=safetensors())
def test_safetensors(here, content):
    file = here / "model.safetensors"
    file.write_bytes(content)
    tensors = read_or_reported(lambda: {name: stored.map() for name, stored in read_safetensors(file).items()}, file)
    assert file.read_bytes() == content
    if tensors is not None:
        same_or_other_bits(tensors)


@pytest.fixture(scope="module")
def shipped(tmp_path_factory) -> Path:
    """The folders of the models that come with the package."""
    return Path(shutil.copytree(SHIPPED, tmp_path_factory.mktemp("shipped") / "weights"))


@settings(FUZZ, max_examples=40)
@given(data=st.data())
def test_folders_of_models(shipped, data):
    folder = shipped / data.draw(st.sampled_from(["score", "tiny"]), "model")
    file = folder / data.draw(st.sampled_from(["model.json", "model.safetensors"]), "file")
    whole = file.read_bytes()
    damage = (
        json_damage(json.loads(whole)) if file.suffix == ".json" else st.one_of(damaged(whole[:4096]), safetensors())
    )
    try:
        file.write_bytes(data.draw(damage, "content"))
        before = snapshot(folder)
        prior = folder.name == "tiny"
        load = (lambda: lp_framework.load_prior("tiny", path=str(folder))) if prior else (lambda: load_model(folder))
        read_or_reported(load, folder)
        assert snapshot(folder) == before
    finally:
        file.write_bytes(whole)


def test_a_folder_of_a_model_with_nonsense_as_weights(here):
    (here / "model.json").write_text(json.dumps({**RECIPE, "trunk": None}))
    for content in (b"", b"{}", pickle.dumps(Runs()), saved(Runs())):
        (here / "model.safetensors").write_bytes(content)
        read_or_reported(lambda: read_checkpoint(here / "model.safetensors"), "model.safetensors")
        assert not (here / "executed").exists()


# ---------------------------------------------------------------- code that a file brings


@pytest.mark.parametrize("container", [lambda code: code, lambda code: {"lp_framework": RECIPE, "state_dict": code}])
@pytest.mark.parametrize("write", [saved, pickle.dumps, lambda contents: pickle.dumps(contents, protocol=0)])
@pytest.mark.parametrize(
    "load",
    [
        load_model,
        read_checkpoint,
        lambda file: lp_framework.load_model(file),
        lambda file: lp_framework.load_prior("tiny", path=str(file)),
        lambda file: lp_framework.load_prior("zero123", path=str(file)),
        lambda file: read_original(file, "ema"),
        read_state_dict,
    ],
)
def test_no_loader_executes_code_from_a_file(here, load, write, container):
    pytest.importorskip("diffusers", reason="prior=zero123 is in the extra zero123")
    file = here / "evil.ckpt"
    file.write_bytes(write(container(Runs())))
    assert read_or_reported(lambda: load(file), file) is None
    assert not (here / "executed").exists()


def test_resuming_a_run_executes_no_code_from_its_checkpoint(tmp_path):
    commands = Commands(tmp_path, train_views=6, test_views=2)
    assert commands.here("run", "train", "trainer.max_epochs=1").status == 0
    (last, best) = (commands.folder / "run" / "checkpoints" / name for name in ("last.ckpt", "best.ckpt"))
    sound = torch.load(last, weights_only=True)
    for place in ("callbacks", "loops", "hyper_parameters", "lp_framework"):
        torch.save({**sound, place: Runs()}, last)
        shutil.copyfile(last, best)
        ran = commands.here("unused", "train", "resume=run", "trainer.max_epochs=2")
        assert ran.status == 1
        assert "is not a readable checkpoint (damaged, or contains more than numbers" in ran.error
        assert not (commands.folder / "executed").exists()


@pytest.mark.parametrize("value", [None, [], {"backbone": 3}, {"model": 3, "backbone": {"name": "small"}}])
def test_invalid_recipes(here, value):
    torch.save({"lp_framework": value, "state_dict": TENSORS}, here / "last.ckpt")
    assert read_or_reported(lambda: load_model(here / "last.ckpt"), "last.ckpt") is None


@FUZZ
@given(recipe=misshapen(RECIPE) | NONSENSE)
def test_recipes(here, recipe):
    (here / "last.ckpt").write_bytes(saved({"lp_framework": recipe, "state_dict": {}}))
    assert read_or_reported(lambda: load_model(here / "last.ckpt"), "last.ckpt") is None
