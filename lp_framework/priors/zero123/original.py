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
        vae_sizes = _vae_sizes(vae)
        configs = {
            "unet": _unet_sizes(unet),
            "vae": vae_sizes,
            "image_encoder": _clip_sizes(clip),
        }
        names = {
            "unet": _unet_names(unet, configs["unet"]["layers_per_block"]),
            "vae": _vae_names(vae, len(vae_sizes["block_out_channels"])),
        }
    except KeyError as error:
        raise UserError(f"{path}: is no Zero123 checkpoint: it holds no '{error.args[0]}'") from error
    except (IndexError, ValueError) as error:  # tensors of too few or too many dimensions
        raise UserError(f"{path}: is no Zero123 checkpoint: its tensors have other shapes") from error
    chosen = unet if weights == "raw" else _averages(path, tensors, unet)
    return configs, {
        "unet": {name: chosen[key].map for key, name in names["unet"].items()},
        "vae": {name: partial(_matrix, vae[key]) if ".attentions." in name and name.endswith("weight") else vae[key].map
                for key, name in names["vae"].items()},
        "image_encoder": _clip_tensors(clip),
        "cc_projection": {name: stored.map for name, stored in projection.items()},
    }  # fmt: skip


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


RESNET = {
    **{"in_layers.0": "norm1", "in_layers.2": "conv1", "emb_layers.1": "time_emb_proj"},
    **{"out_layers.0": "norm2", "out_layers.3": "conv2", "skip_connection": "conv_shortcut"},
}
UNET_ENDS = {
    **{"time_embed.0": "time_embedding.linear_1", "time_embed.2": "time_embedding.linear_2"},
    **{"input_blocks.0.0": "conv_in", "out.0": "conv_norm_out", "out.2": "conv_out"},
}


def _unet_names(keys: Iterable[str], layers: int) -> dict[str, str]:
    """Diffusers' name of each of the U-Net's tensors; an unknown one keeps its own."""
    return {key: _unet_name(key, layers) for key in keys}


def _unet_name(key: str, layers: int) -> str:
    module, _, kind = key.rpartition(".")  # kind: weight or bias
    if module in UNET_ENDS:
        return f"{UNET_ENDS[module]}.{kind}"
    match = re.fullmatch(r"(input_blocks|output_blocks)\.(\d+)\.(\d+)\.(.+)|middle_block\.(\d+)\.(.+)", key)
    if match is None:
        return key
    if match[5] is not None:
        block, place, rest = "mid_block", int(match[5]), match[6]
        inner = "attentions.0" if place == 1 else f"resnets.{place // 2}"
        return f"{block}.{inner}.{rest if place == 1 else _resnet_name(rest)}"
    number, place, rest = int(match[2]), int(match[3]), match[4]
    if match[1] == "input_blocks":  # the first is conv_in; then each level's residual blocks and its downsampling
        level, layer = divmod(number - 1, layers + 1)
        block, sampler = f"down_blocks.{level}", f"downsamplers.0.conv.{kind}"
    else:  # a level has one residual block more, and the upsampling in its last
        level, layer = divmod(number, layers + 1)
        block, sampler = f"up_blocks.{level}", f"upsamplers.0.conv.{kind}"
    if rest in (f"op.{kind}", f"conv.{kind}"):
        return f"{block}.{sampler}"
    return f"{block}.resnets.{layer}.{_resnet_name(rest)}" if place == 0 else f"{block}.attentions.{layer}.{rest}"


def _resnet_name(rest: str) -> str:
    module, _, kind = rest.rpartition(".")
    return f"{RESNET.get(module, module)}.{kind}"


# ---------------------------------------------------------------- the autoencoder


def _vae_sizes(vae: _Part) -> dict[str, Any]:
    levels = max(1, len(_numbers(vae, r"encoder\.down\.(\d+)\.")))
    channels = [vae[f"encoder.down.{level}.block.0.conv2.weight"].shape[0] for level in range(levels)]
    layers = len(_numbers(vae, r"encoder\.down\.0\.block\.(\d+)\."))
    return vae_config(channels, layers, latent=vae["post_quant_conv.weight"].shape[0])


VAE_MODULES = (  # pattern, replacement
    (r"\.norm_out\.", ".conv_norm_out."),
    (r"\.nin_shortcut\.", ".conv_shortcut."),
    (r"\.mid\.block_(\d)\.", lambda match: f".mid_block.resnets.{int(match[1]) - 1}."),
    (r"\.mid\.attn_1\.norm\.", ".mid_block.attentions.0.group_norm."),
    (r"\.mid\.attn_1\.([qkv])\.", r".mid_block.attentions.0.to_\1."),
    (r"\.mid\.attn_1\.proj_out\.", ".mid_block.attentions.0.to_out.0."),
    (r"\.down\.(\d+)\.block\.", r".down_blocks.\1.resnets."),
    (r"\.down\.(\d+)\.downsample\.", r".down_blocks.\1.downsamplers.0."),
)


def _vae_names(keys: Iterable[str], levels: int) -> dict[str, str]:
    """Diffusers' name of each of the autoencoder's tensors; the decoder's levels are counted from the other end."""
    names = {}
    for key in keys:
        name = key
        for pattern, replacement in VAE_MODULES:
            name = re.sub(pattern, replacement, name)
        if match := re.fullmatch(r"decoder\.up\.(\d+)\.(block|upsample)\.(.+)", name):
            inner = "resnets" if match[2] == "block" else "upsamplers.0"
            name = f"decoder.up_blocks.{levels - 1 - int(match[1])}.{inner}.{match[3]}"
        names[key] = name
    return names


def _matrix(stored: StoredTensor) -> Tensor:
    """The weights of an attention's 1x1 convolution as a matrix; those of its norm as they are."""
    weights = stored.map()
    return weights.flatten(1) if weights.ndim == 4 else weights


# ---------------------------------------------------------------- CLIP


def _clip_sizes(clip: _Part) -> dict[str, Any]:
    width, _, patch, _ = clip["conv1.weight"].shape
    patches = clip["positional_embedding"].shape[0] - 1  # one position is the class token's
    layers = len(_numbers(clip, r"transformer\.resblocks\.(\d+)\."))
    return clip_config(width, layers, patch, patch * math.isqrt(patches), projection=clip["proj"].shape[1])


CLIP_MODULES = (  # prefix, replacement
    ("class_embedding", "embeddings.class_embedding"),
    ("positional_embedding", "embeddings.position_embedding.weight"),
    ("conv1.", "embeddings.patch_embedding."),
    ("ln_pre.", "pre_layrnorm."),  # sic
    ("ln_post.", "post_layernorm."),
    ("transformer.resblocks.", "encoder.layers."),
)
CLIP_LAYER = (
    *((".ln_1.", ".layer_norm1."), (".ln_2.", ".layer_norm2."), (".attn.", ".self_attn.")),
    *((".mlp.c_fc.", ".mlp.fc1."), (".mlp.c_proj.", ".mlp.fc2.")),
)


def _clip_tensors(clip: _Part) -> dict[str, Callable[[], Tensor]]:
    """Transformers' names; queries, keys and values are one tensor in OpenAI's, and the projection is transposed."""
    tensors: dict[str, Callable[[], Tensor]] = {}
    for key, stored in clip.items():
        name = key
        for prefix, replacement in CLIP_MODULES:
            if name.startswith(prefix):
                name = replacement + name[len(prefix) :]
        for inner, replacement in CLIP_LAYER:
            name = name.replace(inner, replacement)
        if key == "proj":
            tensors["visual_projection.weight"] = partial(_transposed, stored)
        elif match := re.fullmatch(r"(.+)\.in_proj_(weight|bias)", name):
            for place, letter in enumerate("qkv"):
                tensors[f"vision_model.{match[1]}.{letter}_proj.{match[2]}"] = partial(_third, stored, place)
        else:
            tensors[f"vision_model.{name}"] = stored.map
    return tensors


def _transposed(stored: StoredTensor) -> Tensor:
    return stored.map().t()


def _third(stored: StoredTensor, place: int) -> Tensor:
    return stored.map().chunk(3)[place]
