"""Loading Zero123's weights: the tensors read, the memory needed, and a message for every bad input."""

from __future__ import annotations

import argparse
import collections
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
import types
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from zero123_checkpoint import manifest, state_dict, write_checkpoint

from lp_framework import registry
from lp_framework.errors import UserError
from lp_framework.priors.zero123.networks import Networks, assemble
from lp_framework.priors.zero123.original import read_original
from lp_framework.priors.zero123.tensor_files import read_state_dict
from lp_framework.priors.zero123.weights import PROJECTIONS, download, load_networks, read_folder, write_folder

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def tensors():
    return state_dict()


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("checkpoint"))


@pytest.fixture(scope="module")
def networks(checkpoint) -> Networks:
    return load_networks(str(checkpoint), None, "ema", "float32")


@pytest.fixture(scope="module")
def folder(networks, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("folder") / "converted"
    write_folder(networks, path)
    return path


def copied(folder: Path, to: Path) -> Path:
    shutil.copytree(folder, to)
    return to


def same(one: torch.nn.Module, other: torch.nn.Module) -> bool:
    first, second = one.state_dict(), other.state_dict()
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


def refused(path: Path | str, weights="ema") -> str:
    """The sentence with which the weights are refused."""
    with pytest.raises(UserError) as caught:
        load_networks(str(path), None, weights, "float32")
    sentence = str(caught.value)
    assert "\n" not in sentence and str(path) in sentence
    return sentence


def saved(contents, folder: Path) -> Path:
    torch.save(contents, folder / "changed.ckpt")
    return folder / "changed.ckpt"


# ---------------------------------------------------------------- checkpoints of the training code


def test_sizes_come_from_the_tensors(checkpoint):
    sizes, (configs, _) = manifest(), read_original(checkpoint, "ema")
    base = sizes["unet"]["model_channels"]
    assert configs["unet"]["block_out_channels"] == [base * times for times in sizes["unet"]["channel_mult"]]
    assert configs["unet"]["attention_head_dim"] == sizes["unet"]["num_heads"]
    assert configs["unet"]["cross_attention_dim"] == sizes["unet"]["context_dim"]
    assert configs["unet"]["layers_per_block"] == sizes["unet"]["num_res_blocks"]
    assert configs["vae"]["block_out_channels"] == [sizes["vae"]["ch"] * times for times in sizes["vae"]["ch_mult"]]
    clip = configs["image_encoder"]
    wanted = {"width": "hidden_size", "layers": "num_hidden_layers", "patch": "patch_size", "image": "image_size"}
    assert {key: clip[name] for key, name in wanted.items()} == {key: sizes["clip"][key] for key in wanted}


@pytest.mark.parametrize("weights", ["ema", "raw"])
def test_moving_averages_or_raw_weights(checkpoint, tensors, weights):
    unet = load_networks(str(checkpoint), None, weights, "float32").unet
    key = "model_ema.diffusion_modelout2weight" if weights == "ema" else "model.diffusion_model.out.2.weight"
    assert torch.equal(unet.conv_out.weight, tensors[key])


def test_weights_take_the_dtype_and_the_projection_stays_single(checkpoint):
    networks = load_networks(str(checkpoint), None, "ema", "bfloat16")
    for part, network in networks.named_children():
        wanted = torch.float32 if part == "cc_projection" else torch.bfloat16
        assert {parameter.dtype for parameter in network.parameters()} == {wanted}


def test_a_checkpoint_without_averages_says_so(tensors, tmp_path):
    raw = {key: value for key, value in tensors.items() if not key.startswith("model_ema")}
    path = saved({"state_dict": raw}, tmp_path)
    assert "no moving averages" in refused(path) and "weights=raw" in refused(path)
    load_networks(str(path), None, "raw", "float32")
    one_less = {key: value for key, value in tensors.items() if key != "model_ema.diffusion_modelout2weight"}
    assert "holds no 'model_ema.diffusion_modelout2weight'" in refused(saved(one_less, tmp_path))


UNET_BIAS, SIZING = "model.diffusion_model.out.0.bias", "model.diffusion_model.input_blocks.0.0.weight"


@pytest.mark.parametrize(
    "key", [UNET_BIAS, SIZING, "cc_projection.weight", "cond_stage_model.model.visual.proj", "cc_projection.bias"]
)
def test_a_missing_tensor_is_named(tensors, tmp_path, key):
    rest = {name: value for name, value in tensors.items() if name != key}
    sentence = refused(saved({"state_dict": rest}, tmp_path), "raw")
    names = {UNET_BIAS: "conv_norm_out.bias", "cond_stage_model.model.visual.proj": "visual.proj"}
    assert names.get(key, key.removeprefix("cc_projection.")) in sentence


@pytest.mark.parametrize(
    "key", ["model.diffusion_model.extra.weight", "first_stage_model.decoder.extra", "discriminator"]
)
def test_an_unknown_tensor_is_named(tensors, tmp_path, key):
    sentence = refused(saved({"state_dict": {**tensors, key: torch.zeros(3)}}, tmp_path), "raw")
    assert ("unknown" in sentence or "Unexpected" in sentence) and key.rpartition("_model.")[2] in sentence


def test_a_tensor_of_another_shape_is_named(tensors, tmp_path):
    changed = {**tensors, UNET_BIAS: torch.zeros(3)}
    assert "size mismatch for conv_norm_out.bias: copying a param with shape torch.Size([3])" in refused(
        saved(changed, tmp_path), "raw"
    )
    assert "other shapes" in refused(saved({**tensors, SIZING: torch.zeros(())}, tmp_path), "raw")


def test_known_extra_tensors_are_ignored(tensors, tmp_path, networks):
    tables = ("betas", "alphas_cumprod", "alphas_cumprod_prev", "sqrt_alphas_cumprod", "log_one_minus_alphas_cumprod")
    tables += ("sqrt_one_minus_alphas_cumprod", "sqrt_recip_alphas_cumprod", "sqrt_recipm1_alphas_cumprod")
    tables += ("posterior_variance", "posterior_log_variance_clipped", "posterior_mean_coef1", "posterior_mean_coef2")
    extra = {name: torch.zeros(1000) for name in tables} | {"model_ema.decay": torch.tensor(0.9999)}
    extra |= {"model_ema.num_updates": torch.tensor(7), "scale_factor": torch.tensor(0.18215), "logvar": torch.zeros(9)}
    path = saved({"state_dict": {**tensors, **extra}}, tmp_path)
    assert same(load_networks(str(path), None, "ema", "float32"), networks)


def test_other_models_are_refused(tensors, tmp_path):
    stable_diffusion = {key: value for key, value in tensors.items() if not key.startswith("cc_projection")}
    assert "no 'cc_projection.weight'" in refused(saved({"state_dict": stable_diffusion}, tmp_path))
    assert "unknown tensor 'fc.weight'" in refused(saved({"fc.weight": torch.zeros(2)}, tmp_path))
    assert "no named tensors" in refused(saved({"state_dict": {"epoch": 3}}, tmp_path))
    assert "no named tensors" in refused(saved([torch.zeros(2)], tmp_path))


@pytest.mark.heavy
def test_peak_memory_is_that_of_the_weights_kept_and_the_modules_import_nothing_heavy(tensors, tmp_path):
    """Weights of 240 MB beside raw ones and optimizer states of 300 MB, measured in a process of its own."""
    if not Path("/proc/self/clear_refs").exists():
        pytest.skip("the peak is read from Linux's /proc")
    width, layers = 768, 7
    wide = dict(tensors)
    for key in [key for key in wide if ".visual." in key]:
        *front, last = wide[key].shape
        sizes = [width * size // 128 if size % 128 == 0 else size for size in (*front, last)]
        if "resblocks.0." in key:
            for layer in range(layers):
                wide[key.replace("resblocks.0.", f"resblocks.{layer}.")] = torch.zeros(sizes)
        elif ".resblocks." not in key:
            wide[key] = torch.zeros(
                [768 if key.endswith(".proj") and place else size for place, size in enumerate(sizes)]
            )
    states = {number: {"exp_avg": torch.zeros(25_000_000), "step": 5} for number in range(3)}
    path = saved({"state_dict": wide, "optimizer_states": [{"state": states}], "callbacks": {}}, tmp_path)
    code = f"""
        import gc, lp_framework.priors, sys, torch

        print({{"diffusers", "transformers.models.clip.modeling_clip"}} & {{*sys.modules}})  # lightning imports a shell

        from lp_framework.priors.zero123.networks import PUBLISHED, Networks
        from lp_framework.priors.zero123.weights import load_networks

        def resident(kind):
            lines = open("/proc/self/status").read().splitlines()
            return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(kind))

        with torch.device("meta"):
            Networks(PUBLISHED)  # imports
        for dtype in ("float32", "bfloat16"):
            open("/proc/self/clear_refs", "w").write("5")  # the peak starts anew
            before = resident("VmRSS")
            networks = load_networks({str(path)!r}, None, "ema", dtype)
            print(resident("VmHWM") - before, sum(parameter.nbytes for parameter in networks.parameters()))
            del networks
            gc.collect()
    """
    program = "\n".join(line[8:] for line in code.splitlines())
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    imported, *lines = done.stdout.splitlines()
    assert imported == "set()"
    (single, single_kept), (half, half_kept) = (map(int, line.split()) for line in lines)
    assert single_kept > 200e6 and half_kept > 100e6
    assert single < 1.3 * single_kept
    assert half < 1.3 * half_kept


# ---------------------------------------------------------------- files that are not what they should be


def test_a_file_that_is_missing_or_no_checkpoint(tmp_path):
    assert "there is no such file" in refused(tmp_path / "absent.ckpt")
    text = tmp_path / "text.ckpt"
    text.write_text("<html>404</html>")
    assert "not a PyTorch checkpoint" in refused(text)
    (tmp_path / "empty.ckpt").touch()
    assert "not a PyTorch checkpoint" in refused(tmp_path / "empty.ckpt")
    with zipfile.ZipFile(tmp_path / "archive.ckpt", "w") as archive:
        archive.writestr("readme.txt", "nothing")
    assert "not one that torch.save wrote" in refused(tmp_path / "archive.ckpt")


@pytest.mark.parametrize("share", [0.0001, 0.5, 0.999999])
def test_a_truncated_checkpoint(checkpoint, tmp_path, share):
    whole = checkpoint.read_bytes()
    cut = tmp_path / "cut.ckpt"
    cut.write_bytes(whole[: int(len(whole) * share)])
    assert "is cut short or damaged" in refused(cut)


def test_a_damaged_description(checkpoint, tmp_path):
    damaged = tmp_path / "damaged.ckpt"
    with zipfile.ZipFile(checkpoint) as old, zipfile.ZipFile(damaged, "w") as new:
        for info in old.infolist():
            data = old.read(info)
            new.writestr(info.filename, data[:-200] if info.filename.endswith("data.pkl") else data)
    assert "description of the tensors is damaged" in refused(damaged)


def test_a_tensor_larger_than_its_record(tmp_path):
    torch.save({"state_dict": {"a": torch.zeros(8)}}, tmp_path / "whole.ckpt")
    with zipfile.ZipFile(tmp_path / "whole.ckpt") as old, zipfile.ZipFile(tmp_path / "short.ckpt", "w") as new:
        for info in old.infolist():
            new.writestr(info.filename, old.read(info)[:16] if "/data/" in info.filename else old.read(info))
    assert "larger than its record" in refused(tmp_path / "short.ckpt")


class Runs:
    """When unpickled, calls `function(*arguments)`."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("place", ["beside", "inside", "key"])
@pytest.mark.parametrize("function", [os.system, exec, eval, open, subprocess.Popen, Path.touch, torch.load])
def test_a_pickle_that_would_run_code_is_refused_and_not_run(tensors, tmp_path, function, place):
    mark = tmp_path / "mark"
    arguments = {
        **{os.system: (f"touch {mark}",), exec: (f"open({str(mark)!r}, 'w')",), eval: (f"open({str(mark)!r}, 'w')",)},
        **{open: (str(mark), "w"), subprocess.Popen: (["touch", str(mark)],), Path.touch: (mark,)},
    }.get(function, (str(mark),))
    evil = Runs(function, *arguments)
    few = {"model.diffusion_model.out.2.bias": torch.zeros(4)}
    contents = {
        "beside": {"state_dict": few, "callbacks": evil},
        "inside": {"state_dict": {**few, "evil": evil}},
        "key": {"state_dict": few, "hyper_parameters": {"a": [(1, evil)]}},
    }[place]
    path = saved(contents, tmp_path)
    sentence = refused(path)
    name = "getattr" if function is Path.touch else function.__name__
    assert re.search(rf"is refused, because unpickling it would run '[\w.]+\.{name}'", sentence)
    assert not mark.exists()


def test_methods_reached_through_a_known_name_are_not_run(tmp_path):
    """Protocol 4 lets a pickle ask for a dotted name inside a module."""
    pickled = b"\x80\x04\x8c\x11pytorch_lightning\x8c\x09os.system\x93\x8c\x04exit\x85R."
    (path,) = [tmp_path / "dotted.ckpt"]
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", pickled)
        archive.writestr("archive/version", "3")
    assert "no named tensors" in refused(path)  # an empty object came of it


def test_objects_of_the_training_code_are_ignored(tensors, tmp_path, monkeypatch, networks):
    """As in published files: a callback's class as a key, its state, hyper-parameters, numbers of numpy."""
    module = types.ModuleType("pytorch_lightning.callbacks.model_checkpoint")

    class ModelCheckpoint:
        def __init__(self):
            self.best_k_models = {"a": 1.0}

        def __setstate__(self, state):
            raise AssertionError("code of the training framework has run")

    class AttributeDict(dict):
        pass

    for cls in (ModelCheckpoint, AttributeDict):
        cls.__module__, cls.__qualname__ = module.__name__, cls.__name__
        setattr(module, cls.__name__, cls)
    for name in ("pytorch_lightning", "pytorch_lightning.callbacks", module.__name__):
        monkeypatch.setitem(sys.modules, name, module)
    settings = AttributeDict(path=Path("x"), space=argparse.Namespace(a=1))
    path = saved(
        {
            "state_dict": tensors,
            "callbacks": {ModelCheckpoint: {"best": np.float64(3.5), "loss": torch.tensor(1.0)}},
            "loops": [ModelCheckpoint(), collections.defaultdict(dict, {1: {2: 3}}), {1, 2}, torch.float16, np.ones(2)],
            "hyper_parameters": settings,
        },
        tmp_path,
    )
    for name in ("pytorch_lightning", "pytorch_lightning.callbacks", module.__name__):
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(pickle.UnpicklingError):
        torch.load(path, weights_only=True)
    assert same(load_networks(str(path), None, "ema", "float32"), networks)


def test_every_kind_of_tensor_is_read(tmp_path):
    base = torch.arange(24.0).reshape(4, 6)
    cases = {
        **{"whole": base, "transposed": base.t(), "part": base[1:3, ::2], "scalar": torch.tensor(3.5)},
        **{"empty": torch.zeros(0, 3), "expanded": torch.ones(1, 3).expand(4, 3), "flags": torch.tensor([True, False])},
        **{"half": base.half(), "bfloat": base.bfloat16(), "double": base.double(), "integers": base.long()},
        "parameter": torch.nn.Parameter(base),
    }
    read = read_state_dict(saved(collections.OrderedDict(cases), tmp_path))
    assert read.keys() == cases.keys()
    for name, tensor in cases.items():
        assert read[name].map().dtype == tensor.dtype and torch.equal(read[name].map(), tensor), name


# ---------------------------------------------------------------- folders


def test_a_converted_folder_gives_equal_weights(networks, folder):
    assert not (folder.parent / ".converted.partial").exists()
    assert same(load_networks(str(folder), None, "ema", "float32"), networks)


def old_layout(folder: Path, to: Path) -> Path:
    """As the other published layout: another projection, .bin files, the autoencoder's former names, half precision."""
    copied(folder, to)
    (to / "cc_projection").rename(to / "clip_camera_projection")
    for part in ("unet", "vae", "image_encoder", "clip_camera_projection"):
        stem = "model" if part == "image_encoder" else "diffusion_pytorch_model"
        file = to / part / f"{stem}.safetensors"
        tensors = load_file(file)
        file.unlink()
        if part == "clip_camera_projection":
            tensors = {name.replace("projection.", "proj."): tensor for name, tensor in tensors.items()}
        if part == "vae":
            for new, old in {"to_q": "query", "to_k": "key", "to_v": "value", "to_out.0": "proj_attn"}.items():
                tensors = {name.replace(f".{new}.", f".{old}."): tensor for name, tensor in tensors.items()}
        if part == "image_encoder":
            tensors["vision_model.embeddings.position_ids"] = torch.arange(50)[None]
            torch.save(tensors, to / part / "pytorch_model.bin")
        elif part == "unet":
            save_file({name: tensor.half() for name, tensor in tensors.items()}, to / part / f"{stem}.fp16.safetensors")
        else:
            torch.save(tensors, to / part / f"{stem}.bin")
    return to


def test_the_other_layout_in_circulation(networks, folder, tmp_path):
    other = load_networks(str(old_layout(folder, tmp_path / "old")), None, "ema", "float32")
    assert same(other.vae, networks.vae) and same(other.image_encoder, networks.image_encoder)
    assert same(other.cc_projection, networks.cc_projection)
    half = {name: tensor.half().float() for name, tensor in networks.unet.state_dict().items()}
    assert all(torch.equal(tensor, half[name]) for name, tensor in other.unet.state_dict().items())


def test_weights_in_shards_with_an_index(folder, networks, tmp_path):
    path = copied(folder, tmp_path / "sharded")
    whole = path / "unet" / "diffusion_pytorch_model.safetensors"
    tensors = load_file(whole)
    whole.unlink()
    shards = {f"{whole.stem}-0000{number}-of-00002.safetensors": number for number in (1, 2)}
    owners = {name: [*shards][place % 2] for place, name in enumerate(tensors)}
    for shard in shards:
        save_file({name: tensor for name, tensor in tensors.items() if owners[name] == shard}, whole.with_name(shard))
    whole.with_name(f"{whole.name}.index.json").write_text(json.dumps({"weight_map": owners}))
    assert same(load_networks(str(path), None, "ema", "float32"), networks)
    whole.with_name([*shards][1]).unlink()
    assert "-00002-of-00002.safetensors: is not a safetensors file" in refused(path)
    whole.with_name(f"{whole.name}.index.json").write_text("[]")
    assert "names no files of weights" in refused(path)


def test_bad_folders(folder, tmp_path):
    (tmp_path / "empty").mkdir()
    assert "holds no pose projection" in refused(tmp_path / "empty")
    assert "one set of weights" in refused(folder, "raw")

    def changed(name: str) -> Path:
        return copied(folder, tmp_path / name)

    path = changed("no weights")
    (path / "vae" / "diffusion_pytorch_model.safetensors").unlink()
    assert "vae: holds no weights" in refused(path)
    path = changed("no projection")
    shutil.rmtree(path / "cc_projection")
    assert all(name in refused(path) for name in PROJECTIONS)
    path = changed("cut short")
    weights = path / "unet" / "diffusion_pytorch_model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])
    assert "is cut short" in refused(path)
    path = changed("bad config")
    (path / "vae" / "config.json").write_text("{")
    assert "is not readable JSON" in refused(path)
    path = changed("no config")
    (path / "vae" / "config.json").unlink()
    assert "no such file" in refused(path)
    path = changed("other sizes")
    config = json.loads((path / "unet" / "config.json").read_text())
    (path / "unet" / "config.json").write_text(json.dumps({**config, "in_channels": 4}))
    assert "size mismatch for" in refused(path)
    (path / "unet" / "config.json").write_text(json.dumps({**config, "block_out_channels": [32]}))
    assert "sizes are not those" in refused(path)
    path = changed("unknown tensor")
    weights = path / "cc_projection" / "diffusion_pytorch_model.safetensors"
    save_file({**load_file(weights), "projection.extra": torch.zeros(1)}, weights)
    assert 'Unexpected key(s) in state_dict: "extra"' in refused(path)


def test_writing_is_atomic(networks, folder, tmp_path, monkeypatch):
    with pytest.raises(UserError, match="converted: cannot be written"):
        write_folder(networks, folder)
    assert (folder / "unet" / "config.json").is_file()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("lp_framework.priors.zero123.weights.save_file", full)
    with pytest.raises(UserError, match="No space left on device"):
        write_folder(networks, tmp_path / "new")
    assert list(tmp_path.iterdir()) == []


def test_the_convert_command(lp, checkpoint, networks, tmp_path):
    finished = lp("convert", f"path={checkpoint}", "output=converted")
    assert finished.status == 0, finished.err
    assert "prior.path=converted" in finished.out
    assert same(assemble("converted", *read_folder(tmp_path / "converted"), "float32"), networks)
    assert "already exists" in lp("convert", f"path={checkpoint}", "output=converted").error
    assert "did you mean 'raw'?" in lp("convert", f"path={checkpoint}", "output=other", "weights=row").error
    assert "path needs a value" in lp("convert", "output=other").error
    missing = lp("convert", "path=absent.ckpt", "output=other").error
    assert "absent.ckpt: there is no such file or folder; get 105000.ckpt or zero123-xl.ckpt" in missing


# ---------------------------------------------------------------- the hub


def test_no_network_is_one_sentence(monkeypatch, tmp_path):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))

    def unreachable(*_, **__):
        raise ConnectionError("no route to host")

    monkeypatch.setattr("huggingface_hub.HfApi.list_repo_files", unreachable)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    assert "does not provide it (no route to host); set prior.path to" in refused("someone/zero123")


def test_only_required_files_of_a_repository_are_downloaded(monkeypatch, folder, networks):
    asked = {}

    def files(self, hub_id, revision=None):
        names = [str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()]
        return [*names, "unet/diffusion_pytorch_model.bin", "safety_checker/model.safetensors", "105000.ckpt"]

    def snapshot(hub_id, revision=None, allow_patterns=None, local_files_only=False):
        asked.update(hub_id=hub_id, revision=revision, patterns=allow_patterns)
        return str(folder)

    monkeypatch.setattr("huggingface_hub.HfApi.list_repo_files", files)
    monkeypatch.setattr("huggingface_hub.snapshot_download", snapshot)
    assert same(load_networks("someone/zero123", "v1", "ema", "float32"), networks)
    assert (asked["hub_id"], asked["revision"]) == ("someone/zero123", "v1")
    assert "unet/diffusion_pytorch_model.safetensors" in asked["patterns"]
    assert not {"unet/diffusion_pytorch_model.bin", "safety_checker/model.safetensors"} & set(asked["patterns"])


def test_a_missing_repository(monkeypatch):
    from huggingface_hub.errors import RepositoryNotFoundError

    response = types.SimpleNamespace(status_code=404, headers={}, request=None)

    def absent(*_, **__):
        raise RepositoryNotFoundError("404", response=response)

    monkeypatch.setattr("huggingface_hub.HfApi.list_repo_files", absent)
    with pytest.raises(UserError, match=r"does not provide it at revision v9 \(404"):
        download("someone/zero123", "v9")


def test_a_revision_is_for_the_hub(checkpoint):
    with pytest.raises(UserError, match="is for ids of the Hugging Face hub"):
        load_networks(str(checkpoint), "v1", "ema", "float32")


# ---------------------------------------------------------------- as a plugin


def test_the_priors_are_registered_with_their_settings(checkpoint):
    assert {"zero123", "zero123xl"} <= set(registry.names("prior"))
    prior = registry.build("prior", {"name": "zero123xl", "path": str(checkpoint), "max_batch": 2})
    assert prior.chunks.size == 2
    with pytest.raises(UserError, match="did you mean 'raw'"):
        registry.build("prior", {"name": "zero123", "path": str(checkpoint), "weights": "row"})


@pytest.mark.parametrize("package", ["diffusers", "transformers"])
def test_a_missing_package_is_one_sentence(monkeypatch, checkpoint, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(UserError, match=rf"'{package}', which is not installed: pip install 'lp_framework\[zero123\]'"):
        registry.build("prior", {"name": "zero123", "path": str(checkpoint)})
