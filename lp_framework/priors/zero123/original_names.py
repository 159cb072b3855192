"""Names of Zero123's tensors: those of the training code (latent-diffusion, OpenAI's CLIP) and diffusers' for them.

Each network has a table from the training code's modules to diffusers', which `renamed` applies; inverted, it leads
back. Modules that have the same name in both are in no table.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

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
    **{
        "mid.attn_1.norm": "mid_block.attentions.0.group_norm",
        "mid.attn_1.proj_out": "mid_block.attentions.0.to_out.0",
    },
}
CLIP_ENDS = {
    "class_embedding": "embeddings.class_embedding",
    "positional_embedding": "embeddings.position_embedding.weight",
    "conv1": "embeddings.patch_embedding",
    "ln_pre": "pre_layrnorm",  # sic
    "ln_post": "post_layernorm",
}
CLIP_LAYER = {
    **{"ln_1": "layer_norm1", "attn": "self_attn", "ln_2": "layer_norm2"},
    **{"mlp.c_fc": "mlp.fc1", "mlp.c_proj": "mlp.fc2"},
}


def unet_modules(config: Mapping[str, Any]) -> dict[str, str]:
    """The U-Net's, whose blocks the training code numbers through all levels.

    A level of the way down has its residual blocks and a downsampling; of the way up one residual block more, and the
    upsampling inside the last one.
    """
    names, layers = dict(UNET_ENDS), config["layers_per_block"]

    def resnet(original: str, ours: str) -> None:
        names.update({f"{original}.{inner}": f"{ours}.{its}" for inner, its in RESNET.items()})

    resnet("middle_block.0", "mid_block.resnets.0")
    names["middle_block.1"] = "mid_block.attentions.0"
    resnet("middle_block.2", "mid_block.resnets.1")
    for level, up in enumerate(config["up_block_types"]):
        down_block, up_block, number = f"down_blocks.{level}", f"up_blocks.{level}", level * (layers + 1)
        for layer in range(layers):
            place = f"input_blocks.{1 + number + layer}"  # the first of all is conv_in
            resnet(f"{place}.0", f"{down_block}.resnets.{layer}")
            names[f"{place}.1"] = f"{down_block}.attentions.{layer}"
        names[f"input_blocks.{1 + number + layers}.0.op"] = f"{down_block}.downsamplers.0.conv"
        for layer in range(layers + 1):
            place = f"output_blocks.{number + layer}"
            resnet(f"{place}.0", f"{up_block}.resnets.{layer}")
            names[f"{place}.1"] = f"{up_block}.attentions.{layer}"
        after = 2 if up.startswith("CrossAttn") else 1  # the residual block, and the attention where there is any
        names[f"output_blocks.{number + layers}.{after}.conv"] = f"{up_block}.upsamplers.0.conv"
    return names


def vae_modules(config: Mapping[str, Any]) -> dict[str, str]:
    """The autoencoder's; the training code counts the decoder's levels from the other end."""
    names: dict[str, str] = {}
    levels, layers = len(config["block_out_channels"]), config["layers_per_block"]
    for side, way, resnets in (("encoder", "down", layers), ("decoder", "up", layers + 1)):
        names[f"{side}.norm_out"] = f"{side}.conv_norm_out"
        names |= {f"{side}.{original}": f"{side}.{ours}" for original, ours in VAE_MIDDLE.items()}
        for level in range(levels):
            original = f"{side}.{way}.{level}"
            ours = f"{side}.{way}_blocks.{level if way == 'down' else levels - 1 - level}"
            names[f"{original}.{way}sample"] = f"{ours}.{way}samplers.0"
            for layer in range(resnets):
                names[f"{original}.block.{layer}"] = f"{ours}.resnets.{layer}"
                names[f"{original}.block.{layer}.nin_shortcut"] = f"{ours}.resnets.{layer}.conv_shortcut"
    return names


def clip_modules(config: Mapping[str, Any]) -> dict[str, str]:
    """Those of CLIP's image encoder; queries, keys and values are one module in OpenAI's, and three in ours."""
    names = {original: f"vision_model.{ours}" for original, ours in CLIP_ENDS.items()}
    for layer in range(config["num_hidden_layers"]):
        original, ours = f"transformer.resblocks.{layer}", f"vision_model.encoder.layers.{layer}"
        names |= {f"{original}.{inner}": f"{ours}.{its}" for inner, its in CLIP_LAYER.items()}
    return names


def renamed(key: str, modules: Mapping[str, str]) -> str:
    """A tensor's name with its module, the longest that is in the table, as the table has it; others stay."""
    parts = key.split(".")
    for end in range(len(parts), 0, -1):
        module = ".".join(parts[:end])
        if module in modules:
            return ".".join([modules[module], *parts[end:]])
    return key
