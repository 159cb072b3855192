"""Checkpoints of the published training code (latent-diffusion): sizes from the tensors, tensors by diffusers' names.

Its layout: `model.diffusion_model` is the U-Net and `model_ema` the moving averages of it, `first_stage_model` the
autoencoder, `cond_stage_model` OpenAI's CLIP (of which Zero123 uses the image half), `cc_projection` the projection of
embedding and pose.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from lp_framework.errors import UserError
from lp_framework.priors.zero123.networks import Configs, Weights, clip_config, unet_config, vae_config
from lp_framework.priors.zero123.original_names import clip_modules, renamed, unet_modules, vae_modules
from lp_framework.priors.zero123.stored_tensor import StoredTensor
from lp_framework.priors.zero123.torch_file import read_state_dict

Averages = Literal["ema", "raw"]
Tensors = Mapping[str, StoredTensor]

UNET, VAE, CLIP, PROJECTION = "model.diffusion_model.", "first_stage_model.", "cond_stage_model.", "cc_projection."
EMA = "model_ema."
VISUAL = f"{CLIP}model.visual."
# What a checkpoint may hold besides: the schedule's tables, CLIP's text half, the training loss of the autoencoder.
LEFT_OVER = re.compile(
    r"betas|(sqrt_|log_)?(one_minus_|recip_|recipm1_)?alphas_cumprod(_prev)?|posterior_\w+|logvar|scale_factor|"
    r"lvlb_weights|model_ema\..*|cond_stage_model\.(?!model\.visual\.).*|first_stage_model\.loss\..*"
)


def read_original(path: Path, weights: Averages) -> tuple[Configs, Weights]:
    """Sizes and tensors of the four networks; `weights` chooses the U-Net's moving averages or the raw ones.

    Raises `UserError` for a file that cannot be read, or that is not a checkpoint of Zero123.
    """
    tensors = read_state_dict(path)
    for key in tensors:
        if not key.startswith((UNET, VAE, VISUAL, PROJECTION)) and not LEFT_OVER.fullmatch(key):
            raise UserError(f"{path}: is no Zero123 checkpoint: it holds an unknown tensor '{key}'")
    if f"{PROJECTION}weight" not in tensors:
        raise UserError(
            f"{path}: is no Zero123 checkpoint: it holds no '{PROJECTION}weight', the projection of the pose"
        )
    unet, vae, clip, projection = (_part(tensors, prefix) for prefix in (UNET, VAE, VISUAL, PROJECTION))
    try:
        configs = {"unet": _unet_sizes(unet), "vae": _vae_sizes(vae), "image_encoder": _clip_sizes(clip)}
    except KeyError as error:
        raise UserError(f"{path}: is no Zero123 checkpoint: it holds no '{error.args[0]}'") from error
    except (IndexError, ValueError) as error:  # tensors of too few or too many dimensions
        raise UserError(f"{path}: is no Zero123 checkpoint: its tensors have other shapes") from error
    chosen = unet if weights == "raw" else _averages(path, tensors, unet)
    unet_names, vae_names = unet_modules(configs["unet"]), vae_modules(configs["vae"])
    return configs, {
        "unet": {renamed(key, unet_names): stored.map for key, stored in chosen.items()},
        "vae": {renamed(key, vae_names): partial(_matrix, key, stored) for key, stored in vae.items()},
        "image_encoder": _clip_tensors(clip, clip_modules(configs["image_encoder"])),
        "cc_projection": {name: stored.map for name, stored in projection.items()},
    }


class _Part(dict[str, StoredTensor]):
    """One network's tensors without their prefix; a missing one is a KeyError with its whole name."""

    def __init__(self, prefix: str, tensors: Mapping[str, StoredTensor]) -> None:
        super().__init__(tensors)
        self.prefix = prefix

    def __missing__(self, key: str) -> StoredTensor:
        raise KeyError(self.prefix + key)


def _part(tensors: Tensors, prefix: str) -> _Part:
    return _Part(prefix, {key[len(prefix) :]: value for key, value in tensors.items() if key.startswith(prefix)})


def _averages(path: Path, tensors: Tensors, unet: Tensors) -> Tensors:
    """The moving averages in the place of the U-Net's tensors; latent-diffusion stores them without dots."""
    stored = {key: f"{EMA}diffusion_model{key.replace('.', '')}" for key in unet}
    missing = [name for name in stored.values() if name not in tensors]
    if len(missing) == len(stored):
        raise UserError(f"{path}: holds no moving averages ({EMA}...); take the raw weights with weights=raw")
    if missing:
        raise UserError(f"{path}: is no Zero123 checkpoint: it holds no '{missing[0]}' ({len(missing)} are missing)")
    return {key: tensors[name] for key, name in stored.items()}


def _numbers(keys: Iterable[str], pattern: str) -> list[int]:
    """The numbers that stand where `pattern` has its group, sorted."""
    return sorted({int(match[1]) for key in keys if (match := re.match(pattern, key))})


# ---------------------------------------------------------------- the U-Net


def _unet_sizes(unet: _Part) -> dict[str, Any]:
    levels: list[list[int]] = [[]]  # the numbers of each level's residual blocks
    for number in _numbers(unet, r"input_blocks\.(\d+)\.0\.")[1:]:
        if f"input_blocks.{number}.0.op.weight" in unet:
            levels.append([])
        else:
            levels[-1].append(number)
    inputs = unet["input_blocks.0.0.weight"].shape[1]
    base = unet["input_blocks.1.0.out_layers.3.weight"].shape[0]
    channels = [unet[f"input_blocks.{level[0]}.0.out_layers.3.weight"].shape[0] for level in levels if level]
    context = unet["middle_block.1.transformer_blocks.0.attn2.to_k.weight"].shape[1]
    return unet_config(
        channels,
        layers=len(levels[0]),
        attention=[f"input_blocks.{level[0]}.1.norm.weight" in unet for level in levels if level],
        heads=_heads(base),
        context=context,
        latent=inputs // 2,
    )


def _heads(channels: int) -> int:
    """Attention heads leave no trace in the tensors: 8 of them, fewer where each would have under 8 channels."""
    return min(8, channels // 8)


# ---------------------------------------------------------------- the autoencoder


def _vae_sizes(vae: _Part) -> dict[str, Any]:
    levels = max(1, len(_numbers(vae, r"encoder\.down\.(\d+)\.")))
    channels = [vae[f"encoder.down.{level}.block.0.conv2.weight"].shape[0] for level in range(levels)]
    layers = len(_numbers(vae, r"encoder\.down\.0\.block\.(\d+)\."))
    return vae_config(channels, layers, latent=vae["post_quant_conv.weight"].shape[0])


def _matrix(key: str, stored: StoredTensor) -> Tensor:
    """The weights of an attention's 1x1 convolution as a matrix; other tensors as they are."""
    weights = stored.map()
    return weights.flatten(1) if ".attn_1." in key and weights.ndim == 4 else weights


# ---------------------------------------------------------------- CLIP


def _clip_sizes(clip: _Part) -> dict[str, Any]:
    width, _, patch, _ = clip["conv1.weight"].shape
    patches = clip["positional_embedding"].shape[0] - 1  # one position is the class token's
    layers = len(_numbers(clip, r"transformer\.resblocks\.(\d+)\."))
    return clip_config(width, layers, patch, patch * math.isqrt(patches), projection=clip["proj"].shape[1])


def _clip_tensors(clip: _Part, modules: Mapping[str, str]) -> dict[str, Callable[[], Tensor]]:
    """Transformers' names; queries, keys and values are one tensor in OpenAI's, and the projection is transposed."""
    tensors: dict[str, Callable[[], Tensor]] = {}
    for key, stored in clip.items():
        name = renamed(key, modules)
        if key == "proj":
            tensors["visual_projection.weight"] = partial(_transposed, stored)
        elif match := re.fullmatch(r"(.+)\.in_proj_(weight|bias)", name):
            for place, letter in enumerate("qkv"):
                tensors[f"{match[1]}.{letter}_proj.{match[2]}"] = partial(_third, stored, place)
        else:
            tensors[name] = stored.map
    return tensors


def _transposed(stored: StoredTensor) -> Tensor:
    return stored.map().t()


def _third(stored: StoredTensor, place: int) -> Tensor:
    return stored.map().chunk(3)[place]
