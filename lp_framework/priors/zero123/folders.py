"""Folders in diffusers' layout: one subfolder a network, each with a config.json and the weights.

Two layouts of Zero123 are in circulation. They differ in the name of the pose projection and of its tensors:
`cc_projection` (`projection.weight`) and `clip_camera_projection` (`proj.weight`).
"""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from lp_framework.errors import UserError
from lp_framework.priors.zero123.networks import Configs, Networks, Weights
from lp_framework.priors.zero123.safetensors_file import read_safetensors
from lp_framework.priors.zero123.torch_file import read_state_dict

PROJECTIONS = {"cc_projection": "projection", "clip_camera_projection": "proj"}  # subfolder -> its linear layer
STEMS = {"image_encoder": ("model", "pytorch_model")}  # of the weights' file: safetensors, bin; transformers' and ...
STEM = ("diffusion_pytorch_model", "diffusion_pytorch_model")  # ... diffusers'
VARIANTS = ("", ".fp16")

OLD_VAE_NAMES = {"query": "to_q", "key": "to_k", "value": "to_v", "proj_attn": "to_out.0"}  # before diffusers 0.18
LEFT_OVER = ("vision_model.embeddings.position_ids",)  # before transformers 4.31


def is_folder(path: Path) -> bool:
    """Whether this is a folder of Zero123's networks."""
    return (path / "unet" / "config.json").is_file()


def weight_files(part: str) -> list[str]:
    """File names that the weights of a subfolder may have, best first."""
    safetensors, torch = STEMS.get(part, STEM)
    return [f"{safetensors}{variant}.safetensors" for variant in VARIANTS] + [
        f"{torch}{variant}.bin" for variant in VARIANTS
    ]


def read_folder(path: Path) -> tuple[Configs, Weights]:
    """Sizes and tensors of the four networks of a folder; `UserError` where a file is missing or cannot be read."""
    parts = {part: path / part for part in ("unet", "vae", "image_encoder")}
    configs = {part: _config(folder / "config.json") for part, folder in parts.items()}
    weights: dict[str, Mapping[str, Callable[[], Tensor]]] = {part: _weights(folder) for part, folder in parts.items()}
    weights["vae"] = {_vae_name(name): partial(_matrix, name, mapped) for name, mapped in weights["vae"].items()}
    projection = next((name for name in PROJECTIONS if (path / name).is_dir()), None)
    if projection is None:
        raise UserError(f"{path}: holds no pose projection, a folder {' or '.join(PROJECTIONS)}")
    prefix = f"{PROJECTIONS[projection]}."
    weights["cc_projection"] = {
        name.removeprefix(prefix): mapped for name, mapped in _weights(path / projection).items()
    }
    return configs, weights


def _config(file: Path) -> dict[str, Any]:
    try:
        config = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"{file}: there is no such file; a folder of Zero123 in diffusers' layout has it") from None
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{file}: cannot be read as JSON: {str(error).splitlines()[0]}") from error
    if not isinstance(config, dict):
        raise UserError(f"{file}: is no configuration, a JSON object is wanted")
    return config


def _weights(folder: Path) -> Mapping[str, Callable[[], Tensor]]:
    names = weight_files(folder.name)
    file = next((folder / name for name in names if (folder / name).is_file()), None)
    if file is None:
        raise UserError(f"{folder}: holds no weights, {' or '.join(name for name in names if '.fp16' not in name)}")
    tensors = read_state_dict(file) if file.suffix == ".bin" else read_safetensors(file)
    return {name: stored.map for name, stored in tensors.items() if name not in LEFT_OVER}


def _vae_name(name: str) -> str:
    if ".attentions." not in name:
        return name
    module, _, kind = name.rpartition(".")
    parent, _, last = module.rpartition(".")
    return f"{parent}.{OLD_VAE_NAMES[last]}.{kind}" if last in OLD_VAE_NAMES else name


def _matrix(name: str, mapped: Callable[[], Tensor]) -> Tensor:
    """Attention weights that an old converter left as 1x1 convolutions, as matrices."""
    tensor = mapped()
    return tensor.flatten(1) if ".attentions." in name and tensor.ndim == 4 else tensor


# ---------------------------------------------------------------- writing


def write_folder(networks: Networks, path: Path) -> None:
    """Write the networks as safetensors in diffusers' layout (`cc_projection`), whole or not at all.

    Raises `UserError` where the folder exists already or cannot be written.
    """
    if path.exists():
        raise UserError(f"{path}: exists already; give another folder or remove it")
    partial_folder = path.with_name(f"{path.name}.partial")
    try:
        shutil.rmtree(partial_folder, ignore_errors=True)
        _write(networks, partial_folder)
        partial_folder.rename(path)
    except (OSError, SafetensorError) as error:
        shutil.rmtree(partial_folder, ignore_errors=True)
        full = (isinstance(error, OSError) and error.errno == errno.ENOSPC) or "No space left" in str(error)
        raise UserError(f"{path}: cannot be written: {'the disk is full' if full else error}") from error


def _write(networks: Networks, path: Path) -> None:
    path.mkdir(parents=True)
    networks.unet.save_pretrained(path / "unet")
    networks.vae.save_pretrained(path / "vae")
    networks.image_encoder.save_pretrained(path / "image_encoder")
    projection = networks.cc_projection
    folder = path / "cc_projection"
    folder.mkdir()
    sizes = {
        "_class_name": "CCProjection",
        "in_channel": projection.in_features,
        "out_channel": projection.out_features,
    }
    (folder / "config.json").write_text(json.dumps(sizes, indent=2) + "\n", encoding="utf-8")
    tensors = {f"projection.{name}": tensor for name, tensor in projection.state_dict().items()}
    save_file(tensors, folder / "diffusion_pytorch_model.safetensors", metadata={"format": "pt"})
