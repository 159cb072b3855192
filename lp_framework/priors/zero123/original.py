"""Checkpoints of the published training code (latent-diffusion): sizes from the tensors, tensors by diffusers' names.

Its layout: `model.diffusion_model` is the U-Net and `model_ema` the moving averages of it, `first_stage_model` the
autoencoder, `cond_stage_model` OpenAI's CLIP (of which Zero123 uses the image half), `cc_projection` the projection of
embedding and pose.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

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
    if weights == "ema" and not any(key.startswith(EMA) for key in tensors):
        raise UserError(f"{path}: holds no moving averages ({EMA}...); take the raw weights with weights=raw")
    try:
        tensors[f"{PROJECTION}weight"]  # what other models of latent-diffusion lack
        configs = {"unet": _unet_sizes(tensors), "vae": _vae_sizes(tensors), "image_encoder": _clip_sizes(tensors)}
        unet, vae, clip, projection = (
            {key.removeprefix(prefix): stored for key, stored in tensors.items() if key.startswith(prefix)}
            for prefix in (UNET, VAE, VISUAL, PROJECTION)
        )
        if weights == "ema":  # latent-diffusion stores them without dots
            unet = {key: tensors[f"{EMA}diffusion_model{key.replace('.', '')}"] for key in unet}
        return configs, {
            "unet": _renamed(unet, unet_modules(configs["unet"])),
            "vae": _renamed(vae, vae_modules(configs["vae"])),
            "image_encoder": _clip_tensors(_renamed(clip, clip_modules(configs["image_encoder"]))),
            "cc_projection": projection,
        }
    except KeyError as error:
        raise UserError(f"{path}: is no Zero123 checkpoint: it holds no '{error.args[0]}'") from error
    except (IndexError, ValueError) as error:  # tensors of too few or too many dimensions
        raise UserError(f"{path}: is no Zero123 checkpoint: its tensors have other shapes") from error


def _renamed(tensors: Tensors, modules: Mapping[str, str]) -> dict[str, StoredTensor]:
    return {renamed(key, modules): stored for key, stored in tensors.items()}


def _numbers(tensors: Tensors, pattern: str) -> list[int]:
    """The numbers that stand where `pattern` has its group, sorted."""
    return sorted({int(match[1]) for key in tensors if (match := re.match(pattern, key))})


def _unet_sizes(tensors: Tensors) -> dict[str, Any]:
    # Block 0 is the first convolution; a level's residual blocks follow, and a downsampling after all but the last.
    numbers = _numbers(tensors, rf"{UNET}input_blocks\.(\d+)\.0\.")
    layers = next((n - 1 for n in numbers if f"{UNET}input_blocks.{n}.0.op.weight" in tensors), len(numbers) - 1)
    levels = [f"{UNET}input_blocks.{number}" for number in numbers[1 :: layers + 1]]
    channels = [tensors[f"{level}.0.out_layers.3.weight"].shape[0] for level in levels]
    return unet_config(
        channels,
        layers,
        attention=[f"{level}.1.norm.weight" in tensors for level in levels],
        heads=min(8, channels[0] // 8),  # they leave no trace: 8, fewer where each would have under 8 channels
        context=tensors[f"{UNET}middle_block.1.transformer_blocks.0.attn2.to_k.weight"].shape[1],
        latent=tensors[f"{UNET}input_blocks.0.0.weight"].shape[1] // 2,
    )


def _vae_sizes(tensors: Tensors) -> dict[str, Any]:
    levels = _numbers(tensors, rf"{VAE}encoder\.down\.(\d+)\.")
    channels = [tensors[f"{VAE}encoder.down.{level}.block.0.conv2.weight"].shape[0] for level in levels]
    layers = len(_numbers(tensors, rf"{VAE}encoder\.down\.0\.block\.(\d+)\."))
    return vae_config(channels, layers, latent=tensors[f"{VAE}post_quant_conv.weight"].shape[0])


def _clip_sizes(tensors: Tensors) -> dict[str, Any]:
    width, _, patch, _ = tensors[f"{VISUAL}conv1.weight"].shape
    patches = tensors[f"{VISUAL}positional_embedding"].shape[0] - 1  # one position is the class token's
    layers = len(_numbers(tensors, rf"{VISUAL}transformer\.resblocks\.(\d+)\."))
    return clip_config(width, layers, patch, patch * math.isqrt(patches), tensors[f"{VISUAL}proj"].shape[1])


def _clip_tensors(clip: Tensors) -> dict[str, StoredTensor]:
    """Queries, keys and values are one tensor in OpenAI's, and the projection is transposed."""
    tensors: dict[str, StoredTensor] = {}
    for name, stored in clip.items():
        if name == "proj":
            transposed = replace(stored, shape=stored.shape[::-1], stride=stored.stride[::-1])
            tensors["visual_projection.weight"] = transposed
        elif match := re.fullmatch(r"(.+)\.in_proj_(weight|bias)", name):
            rows, *others = stored.shape
            for place, letter in enumerate("qkv"):
                offset = stored.offset + place * (rows // 3) * stored.stride[0] * stored.dtype.itemsize
                third = replace(stored, offset=offset, shape=(rows // 3, *others))
                tensors[f"{match[1]}.{letter}_proj.{match[2]}"] = third
        else:
            tensors[name] = stored
    return tensors
