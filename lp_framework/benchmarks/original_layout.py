"""Checkpoints in the layout of the published training code, of networks with any weights.

The other way round from `priors.zero123.original`, so that its reading can be measured without the published files.
"""

from __future__ import annotations

import re
from pathlib import Path

import torch
from torch import Tensor

from lp_framework.priors.zero123.networks import Networks
from lp_framework.priors.zero123.original import (
    CLIP_LAYER,
    CLIP_MODULES,
    EMA,
    PROJECTION,
    RESNET,
    UNET,
    UNET_ENDS,
    VAE,
    VISUAL,
)

RESNET_NAMES = {ours: original for original, ours in RESNET.items()}
ENDS = {ours: original for original, ours in UNET_ENDS.items()}


def write_original(networks: Networks, path: Path) -> None:
    """A checkpoint file with the raw weights of the U-Net and, with the same values, its moving averages."""
    torch.save({"state_dict": original_tensors(networks)}, path)


def original_tensors(networks: Networks) -> dict[str, Tensor]:
    """The tensors by the names and in the shapes of the training code."""
    layers, levels = networks.unet.config.layers_per_block, len(networks.vae.config.block_out_channels)
    attended = {level for level, block in enumerate(networks.unet.up_blocks) if hasattr(block, "attentions")}
    unet = {_unet_name(name, layers, attended): tensor for name, tensor in networks.unet.state_dict().items()}
    return {
        **{f"{UNET}{key}": tensor for key, tensor in unet.items()},
        **{f"{EMA}diffusion_model{key.replace('.', '')}": tensor.clone() for key, tensor in unet.items()},
        **{f"{VAE}{key}": tensor for key, tensor in _vae(networks.vae.state_dict(), levels).items()},
        **{f"{VISUAL}{key}": tensor for key, tensor in _clip(networks.image_encoder.state_dict()).items()},
        **{f"{PROJECTION}{name}": tensor for name, tensor in networks.cc_projection.state_dict().items()},
    }


def _unet_name(name: str, layers: int, attended: set[int]) -> str:
    """`attended` are the levels of the way up that have attention, after which their upsampling is numbered."""
    module, _, kind = name.rpartition(".")
    if module in ENDS:
        return f"{ENDS[module]}.{kind}"
    match = re.fullmatch(r"(down_blocks|up_blocks|mid_block)\.(?:(\d+)\.)?(\w+)\.(\d+)\.(.+)", name)
    assert match is not None  # every module of diffusers' U-Net is named so
    block, level, part, number, rest = match[1], int(match[2] or 0), match[3], int(match[4]), match[5]
    if part == "resnets":
        inner, _, kind = rest.rpartition(".")
        rest = f"{RESNET_NAMES.get(inner, inner)}.{kind}"
    if block == "mid_block":
        return f"middle_block.{1 if part == 'attentions' else 2 * number}.{rest}"
    if block == "down_blocks":
        first = 1 + level * (layers + 1)  # the first of all is conv_in
        if part == "downsamplers":
            return f"input_blocks.{first + layers}.0.op.{kind}"
        return f"input_blocks.{first + number}.{int(part == 'attentions')}.{rest}"
    first = level * (layers + 1)
    if part == "upsamplers":
        return f"output_blocks.{first + layers}.{1 + (level in attended)}.conv.{kind}"
    return f"output_blocks.{first + number}.{int(part == 'attentions')}.{rest}"


VAE_NAMES = (  # pattern, replacement
    (r"\.conv_norm_out\.", ".norm_out."),
    (r"\.conv_shortcut\.", ".nin_shortcut."),
    (r"\.mid_block\.resnets\.(\d)\.", lambda match: f".mid.block_{int(match[1]) + 1}."),
    (r"\.mid_block\.attentions\.0\.group_norm\.", ".mid.attn_1.norm."),
    (r"\.mid_block\.attentions\.0\.to_([qkv])\.", r".mid.attn_1.\1."),
    (r"\.mid_block\.attentions\.0\.to_out\.0\.", ".mid.attn_1.proj_out."),
    (r"\.resnets\.", ".block."),
    (r"\.(down|up)samplers\.0\.", r".\1sample."),
    (r"\.down_blocks\.", ".down."),
)


def _vae(tensors: dict[str, Tensor], levels: int) -> dict[str, Tensor]:
    """The decoder's levels are counted from the other end, and attention has 1x1 convolutions."""
    renamed = {}
    for name, tensor in tensors.items():
        for pattern, replacement in VAE_NAMES:
            name = re.sub(pattern, replacement, name)
        name = re.sub(r"\.up_blocks\.(\d+)\.", lambda match: f".up.{levels - 1 - int(match[1])}.", name)
        convolution = ".attn_1." in name and tensor.ndim == 2
        renamed[name] = tensor[:, :, None, None] if convolution else tensor
    return renamed


def _clip(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Queries, keys and values are one tensor, and the last projection is transposed."""
    renamed = {}
    for name, tensor in tensors.items():
        if name == "visual_projection.weight":
            renamed["proj"] = tensor.t()
            continue
        name = name.removeprefix("vision_model.")
        for original, ours in CLIP_MODULES:
            if name.startswith(ours):
                name = original + name[len(ours) :]
        for original, ours in CLIP_LAYER:
            name = name.replace(ours, original)
        if match := re.fullmatch(r"(.+\.attn\.)([qkv])_proj\.(weight|bias)", name):
            stacked = renamed.setdefault(
                f"{match[1]}in_proj_{match[3]}", tensor.new_empty(3, *tensor.shape).flatten(0, 1)
            )
            stacked.chunk(3)["qkv".index(match[2])].copy_(tensor)
        else:
            renamed[name] = tensor
    return renamed
