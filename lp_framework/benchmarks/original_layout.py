"""Checkpoints in the layout of the published training code, of networks with any weights.

The other way round from `priors.zero123.original`, so that its reading can be measured without the published files.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from lp_framework.priors.zero123.networks import Networks
from lp_framework.priors.zero123.original import EMA, PROJECTION, UNET, VAE, VISUAL
from lp_framework.priors.zero123.original_names import clip_modules, renamed, unet_modules, vae_modules


def write_original(networks: Networks, path: Path) -> None:
    """A checkpoint file with the raw weights of the U-Net and, with the same values, its moving averages."""
    torch.save({"state_dict": original_tensors(networks)}, path)


def original_tensors(networks: Networks) -> dict[str, Tensor]:
    """The tensors by the names and in the shapes of the training code."""
    unet = _renamed(networks.unet, unet_modules(networks.unet.config))
    vae = _renamed(networks.vae, vae_modules(networks.vae.config))
    clip = _renamed(networks.image_encoder, clip_modules(networks.image_encoder.config.to_dict()))
    return {
        **{f"{UNET}{key}": tensor for key, tensor in unet.items()},
        **{f"{EMA}diffusion_model{key.replace('.', '')}": tensor.clone() for key, tensor in unet.items()},
        **{f"{VAE}{key}": _convolution(key, tensor) for key, tensor in vae.items()},
        **{f"{VISUAL}{key}": tensor for key, tensor in _stacked(clip).items()},
        **{f"{PROJECTION}{key}": tensor for key, tensor in networks.cc_projection.state_dict().items()},
    }


def _renamed(network: torch.nn.Module, modules: dict[str, str]) -> dict[str, Tensor]:
    back = {ours: original for original, ours in modules.items()}
    return {renamed(name, back): tensor for name, tensor in network.state_dict().items()}


def _convolution(key: str, tensor: Tensor) -> Tensor:
    """The matrices of the autoencoder's attention as 1x1 convolutions."""
    return tensor[:, :, None, None] if ".attn_1." in key and tensor.ndim == 2 else tensor


def _stacked(clip: dict[str, Tensor]) -> dict[str, Tensor]:
    """Queries, keys and values as one tensor, and the last projection transposed."""
    clip["proj"] = clip.pop("visual_projection.weight").t()
    for key in [key for key in clip if ".q_proj." in key]:
        parts = [clip.pop(key.replace(".q_proj.", f".{letter}_proj.")) for letter in "qkv"]
        clip[key.replace(".q_proj.", ".in_proj_")] = torch.cat(parts)
    return clip
