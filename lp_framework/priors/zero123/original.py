"""Checkpoints of the published training code (latent-diffusion): infer sizes and rename tensors to diffusers' names.

`model.diffusion_model` is the U-Net and `model_ema` its moving averages, `first_stage_model` the autoencoder, and
`cond_stage_model` OpenAI's CLIP, of which Zero123 uses only the image encoder.
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
from lp_framework.priors.zero123.tensor_files import StoredTensor, read_state_dict

Averages = Literal["ema", "raw"]
Tensors = Mapping[str, StoredTensor]

UNET, VAE, CLIP, PROJECTION = "model.diffusion_model.", "first_stage_model.", "cond_stage_model.", "cc_projection."
EMA = "model_ema."
VISUAL = f"{CLIP}model.visual."
# Other allowed contents of a checkpoint: the schedule's tables, CLIP's text half, the autoencoder's training loss.
IGNORED = re.compile(
    r"betas|(sqrt_|log_)?(one_minus_|recip_|recipm1_)?alphas_cumprod(_prev)?|posterior_\w+|logvar|scale_factor|"
    r"lvlb_weights|model_ema\..*|cond_stage_model\.(?!model\.visual\.).*|first_stage_model\.loss\..*"
)
# Each network has a table from the training code's modules to diffusers', which `_renamed` applies; it can be inverted
# to convert back. Modules with the same name in both are omitted.
RESNET = {
    **{"in_layers.0": "norm1", "in_layers.2": "conv1", "emb_layers.1": "time_emb_proj"},
    **{"out_layers.0": "norm2", "out_layers.3": "conv2", "skip_connection": "conv_shortcut"},
}
UNET_ENDS = {
    **{"time_embed.0": "time_embedding.linear_1", "time_embed.2": "time_embedding.linear_2"},
    **{"input_blocks.0.0": "conv_in", "out.0": "conv_norm_out", "out.2": "conv_out"},
}
VAE_MIDDLE = {
    **{"mid.block_1": "mid_block.resnets.0", "mid.block_2": "mid_block.resnets.1"},
    **{f"mid.attn_1.{each}": f"mid_block.attentions.0.to_{each}" for each in "qkv"},
    "mid.attn_1.norm": "mid_block.attentions.0.group_norm",
    "mid.attn_1.proj_out": "mid_block.attentions.0.to_out.0",
}
CLIP_ENDS = {
    **{"class_embedding": "embeddings.class_embedding", "conv1": "embeddings.patch_embedding"},
    "positional_embedding": "embeddings.position_embedding.weight",
    **{"ln_pre": "pre_layrnorm", "ln_post": "post_layernorm"},  # sic
}
CLIP_LAYER = {
    **{"ln_1": "layer_norm1", "attn": "self_attn", "ln_2": "layer_norm2"},
    **{"mlp.c_fc": "mlp.fc1", "mlp.c_proj": "mlp.fc2"},
}


def read_original(path: Path, weights: Averages) -> tuple[Configs, Weights]:
    """Read configs and tensors of the four networks, with the U-Net's moving averages or raw weights; raises
    `UserError` if the file is not a Zero123 checkpoint."""
    tensors = read_state_dict(path)
    for key in tensors:
        if not key.startswith((UNET, VAE, VISUAL, PROJECTION)) and not IGNORED.fullmatch(key):
            raise UserError(f"{path}: is not a Zero123 checkpoint: it holds an unknown tensor '{key}'")
    if weights == "ema" and not any(key.startswith(EMA) for key in tensors):
        raise UserError(f"{path}: holds no moving averages ({EMA}...); use the raw weights with weights=raw")
    try:
        tensors[f"{PROJECTION}weight"]  # missing in other latent-diffusion models
        configs = {"unet": _unet_sizes(tensors), "vae": _vae_sizes(tensors), "image_encoder": _clip_sizes(tensors)}
        unet, vae, clip, projection = (
            {key.removeprefix(prefix): stored for key, stored in tensors.items() if key.startswith(prefix)}
            for prefix in (UNET, VAE, VISUAL, PROJECTION)
        )
        if weights == "ema":  # latent-diffusion stores their names without dots
            unet = {key: tensors[f"{EMA}diffusion_model{key.replace('.', '')}"] for key in unet}
        return configs, {
            "unet": _renamed(unet, unet_modules(configs["unet"])),
            "vae": _renamed(vae, vae_modules(configs["vae"])),
            "image_encoder": _clip_tensors(_renamed(clip, clip_modules(configs["image_encoder"]))),
            "cc_projection": projection,
        }
    except KeyError as error:
        raise UserError(f"{path}: is not a Zero123 checkpoint: it holds no '{error.args[0]}'") from error
    except (IndexError, ValueError) as error:  # tensors with too few or too many dimensions
        raise UserError(f"{path}: is not a Zero123 checkpoint: its tensors have other shapes") from error


def _renamed(tensors: Tensors, modules: Mapping[str, str]) -> dict[str, StoredTensor]:
    """Rename the tensors, replacing the longest module prefix that is in the table."""
    known = "|".join(re.escape(module) for module in sorted(modules, key=len, reverse=True))
    module = re.compile(rf"^({known})(?=\.|$)")
    return {module.sub(lambda found: modules[found[1]], key): stored for key, stored in tensors.items()}


def _numbers(tensors: Tensors, pattern: str) -> list[int]:
    """The sorted numbers matched by the group of `pattern`."""
    return sorted({int(match[1]) for key in tensors if (match := re.match(pattern, key))})


def _unet_sizes(tensors: Tensors) -> dict[str, Any]:
    # Block 0 is the first convolution. Each level's residual blocks follow, with downsampling after all but the last.
    numbers = _numbers(tensors, rf"{UNET}input_blocks\.(\d+)\.0\.")
    layers = next((n - 1 for n in numbers if f"{UNET}input_blocks.{n}.0.op.weight" in tensors), len(numbers) - 1)
    levels = [f"{UNET}input_blocks.{number}" for number in numbers[1 :: layers + 1]]
    channels = [tensors[f"{level}.0.out_layers.3.weight"].shape[0] for level in levels]
    return unet_config(
        channels,
        layers,
        attention=[f"{level}.1.norm.weight" in tensors for level in levels],
        heads=min(8, channels[0] // 8),  # not stored: 8, or fewer if heads would have under 8 channels
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
    """Convert OpenAI's tensors, where queries, keys and values are joint and the projection is transposed."""
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


def unet_modules(config: Mapping[str, Any]) -> dict[str, str]:
    """Table of the U-Net. The training code numbers its blocks across levels: going down, each level's residual blocks
    and a downsampling; going up, one more residual block, with the upsampling inside the last one."""
    names, layers = dict(UNET_ENDS), config["layers_per_block"]

    def resnet(original: str, renamed: str) -> None:
        names.update({f"{original}.{old}": f"{renamed}.{new}" for old, new in RESNET.items()})

    resnet("middle_block.0", "mid_block.resnets.0")
    names["middle_block.1"] = "mid_block.attentions.0"
    resnet("middle_block.2", "mid_block.resnets.1")
    for level, up in enumerate(config["up_block_types"]):
        number = level * (layers + 1)
        # The first of all input blocks is conv_in.
        for blocks, first, path, count in (("input", number + 1, "down", layers), ("output", number, "up", layers + 1)):
            for layer in range(count):
                resnet(f"{blocks}_blocks.{first + layer}.0", f"{path}_blocks.{level}.resnets.{layer}")
                names[f"{blocks}_blocks.{first + layer}.1"] = f"{path}_blocks.{level}.attentions.{layer}"
        names[f"input_blocks.{number + 1 + layers}.0.op"] = f"down_blocks.{level}.downsamplers.0.conv"
        after = 2 if up.startswith("CrossAttn") else 1  # after the residual block and, if present, attention
        names[f"output_blocks.{number + layers}.{after}.conv"] = f"up_blocks.{level}.upsamplers.0.conv"
    return names


def vae_modules(config: Mapping[str, Any]) -> dict[str, str]:
    """Table of the autoencoder; the training code counts the decoder's levels in reverse."""
    names: dict[str, str] = {}
    levels, layers = len(config["block_out_channels"]), config["layers_per_block"]
    for side, path, resnets in (("encoder", "down", layers), ("decoder", "up", layers + 1)):
        names[f"{side}.norm_out"] = f"{side}.conv_norm_out"
        names |= {f"{side}.{old}": f"{side}.{new}" for old, new in VAE_MIDDLE.items()}
        for level in range(levels):
            original = f"{side}.{path}.{level}"
            renamed = f"{side}.{path}_blocks.{level if path == 'down' else levels - 1 - level}"
            names[f"{original}.{path}sample"] = f"{renamed}.{path}samplers.0"
            for layer in range(resnets):
                names[f"{original}.block.{layer}"] = f"{renamed}.resnets.{layer}"
                names[f"{original}.block.{layer}.nin_shortcut"] = f"{renamed}.resnets.{layer}.conv_shortcut"
    return names


def clip_modules(config: Mapping[str, Any]) -> dict[str, str]:
    """Table of CLIP's image encoder; queries, keys and values are one module in OpenAI's code, three here."""
    names = {old: f"vision_model.{new}" for old, new in CLIP_ENDS.items()}
    for layer in range(config["num_hidden_layers"]):
        original, renamed = f"transformer.resblocks.{layer}", f"vision_model.encoder.layers.{layer}"
        names |= {f"{original}.{old}": f"{renamed}.{new}" for old, new in CLIP_LAYER.items()}
    return names
