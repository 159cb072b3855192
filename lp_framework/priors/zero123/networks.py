"""Zero123's networks: diffusers' U-Net and autoencoder, transformers' CLIP image encoder, and the pose projection."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from textwrap import shorten
from types import ModuleType
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.nn import functional
from torch.nn.attention import SDPBackend, sdpa_kernel

from lp_framework.data.files import expecting
from lp_framework.errors import UserError, optional_import
from lp_framework.priors.zero123.tensor_files import StoredTensor

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
Dtype = Literal["float32", "bfloat16", "float16"]
Attention = Literal["sdpa", "math"]

# With the keys of diffusers' and transformers' config.json.
Configs = Mapping[str, Mapping[str, Any]]
Weights = Mapping[str, Mapping[str, StoredTensor]]

POSE_CHANNELS = 4  # of the conditioning vector T


def unet_config(
    channels: list[int], layers: int, attention: list[bool], heads: int, context: int, latent: int = 4
) -> dict[str, Any]:
    """Config of the U-Net; channels and use of attention are per level, from fine to coarse."""
    return {
        "sample_size": 32,
        "in_channels": 2 * latent,  # the noised target and the source
        "out_channels": latent,
        "block_out_channels": channels,
        "layers_per_block": layers,
        "down_block_types": ["CrossAttnDownBlock2D" if each else "DownBlock2D" for each in attention],
        "up_block_types": ["CrossAttnUpBlock2D" if each else "UpBlock2D" for each in reversed(attention)],
        "attention_head_dim": heads,  # sic: diffusers' name for the number of heads
        "cross_attention_dim": context,
    }


def vae_config(channels: list[int], layers: int, latent: int = 4) -> dict[str, Any]:
    """Config of the autoencoder; channels are per level, from fine to coarse."""
    return {
        "in_channels": 3,
        "out_channels": 3,
        "block_out_channels": channels,
        "layers_per_block": layers,
        "down_block_types": ["DownEncoderBlock2D"] * len(channels),
        "up_block_types": ["UpDecoderBlock2D"] * len(channels),
        "latent_channels": latent,
        "sample_size": 256,
        "scaling_factor": 0.18215,
    }


def clip_config(width: int, layers: int, patch: int, image_size: int, projection: int) -> dict[str, Any]:
    """Config of OpenAI's CLIP vision transformer, with heads of width 64."""
    return {
        "hidden_size": width,
        "intermediate_size": 4 * width,
        "num_hidden_layers": layers,
        "num_attention_heads": width // 64,
        "patch_size": patch,
        "image_size": image_size,
        "projection_dim": projection,
        "hidden_act": "quick_gelu",
        "layer_norm_eps": 1e-5,
    }


PUBLISHED: Configs = {  # the sizes of Zero123 and Zero123-XL: Stable Diffusion 1's, with CLIP ViT-L/14
    "unet": unet_config([320, 640, 1280, 1280], 2, [True, True, True, False], heads=8, context=768),
    "vae": vae_config([128, 256, 512, 512], 2),
    "image_encoder": clip_config(width=1024, layers=24, patch=14, image_size=224, projection=768),
}


def packages() -> list[ModuleType]:
    """Import diffusers and transformers; raises `UserError` naming the one that is not installed."""
    install = "pip install 'lp_framework[zero123]'"
    return [optional_import(name, "Zero123", install) for name in ("diffusers", "transformers")]


class Networks(nn.Module):
    """The four networks with random weights."""

    def __init__(self, configs: Configs) -> None:
        super().__init__()
        diffusers, transformers = packages()
        self.unet = diffusers.UNet2DConditionModel.from_config(dict(configs["unet"]))
        self.vae = diffusers.AutoencoderKL.from_config(dict(configs["vae"]))
        clip = transformers.CLIPVisionConfig.from_dict(dict(configs["image_encoder"]))
        self.image_encoder = transformers.CLIPVisionModelWithProjection(clip)
        embedding = self.image_encoder.config.projection_dim
        self.cc_projection = nn.Linear(embedding + POSE_CHANNELS, self.unet.config.cross_attention_dim)


class SingleToken:
    """Cross-attention over a single token: its weight is always 1, so every position receives its value."""

    def __call__(self, attn: Any, hidden_states: Tensor, encoder_hidden_states: Tensor, **unused: Any) -> Tensor:
        value = attn.to_out[0](attn.to_v(encoder_hidden_states))  # [B, 1, channels]
        return value.expand(-1, hidden_states.shape[1], -1)


class SelfAttention:
    """Self-attention by `scaled_dot_product_attention`, with the math kernel where fused ones are not supported."""

    def __init__(self, kernel: Attention) -> None:
        self.kernel = kernel

    def __call__(self, attn: Any, hidden_states: Tensor, **unused: Any) -> Tensor:
        query, key, value = (
            project(hidden_states).unflatten(-1, (attn.heads, -1)).transpose(1, 2)  # [B, heads, positions, channels]
            for project in (attn.to_q, attn.to_k, attn.to_v)
        )
        plain = self.kernel == "math" or forward_ad._current_level >= 0  # fused kernels have no forward-mode derivative
        with sdpa_kernel(SDPBackend.MATH) if plain else nullcontext():
            mixed = functional.scaled_dot_product_attention(query, key, value)
        return attn.to_out[0](mixed.transpose(1, 2).flatten(2))


def choose_attention(unet: Any, kernel: Attention) -> None:
    """Set the attention processors of a U-Net whose context is a single token."""
    processors = {
        name: SingleToken() if name.endswith("attn2.processor") else SelfAttention(kernel)
        for name in unet.attn_processors
    }
    unet.set_attn_processor(processors)


def assemble(origin: str, configs: Configs, weights: Weights, dtype: Dtype) -> Networks:
    """Build the networks with these weights; raises `UserError` naming `origin` if sizes or tensors do not fit."""
    with expecting(f"{origin}: its sizes are not those of Zero123's networks"), torch.device("meta"):
        networks = Networks(configs)
    embeddings = networks.image_encoder.vision_model.embeddings  # its patch indices are not stored in files
    embeddings.position_ids = torch.arange(embeddings.position_embedding.num_embeddings)[None]
    for part, network in networks.named_children():
        single = part == "cc_projection"  # small, and it processes poses
        _load(f"{origin}, {part}", network, weights[part], torch.float32 if single else DTYPES[dtype])
    return networks


def _load(origin: str, network: nn.Module, weights: Mapping[str, StoredTensor], dtype: torch.dtype) -> None:
    dimensions = {name: tensor.ndim for name, tensor in network.state_dict().items()}
    tensors = {}
    for name, stored in weights.items():
        tensor = stored.map()
        if tensor.ndim == 4 and dimensions.get(name) == 2:  # a 1x1 convolution of the autoencoder's attention
            tensor = tensor.flatten(1)
        # Tensors stored in the wanted dtype stay mapped and shared by processes; otherwise the mapping is released.
        as_wanted = tensor.dtype == dtype and tensor.is_contiguous()
        tensors[name] = tensor if as_wanted else torch.empty(tensor.shape, dtype=dtype).copy_(tensor)
    try:
        network.load_state_dict(tensors, assign=True)
    except RuntimeError as error:
        reasons = shorten(" ".join(str(error).splitlines()[1:]), 200, placeholder=" ...")
        raise UserError(f"{origin}: its tensors are not those of Zero123: {reasons}") from error
