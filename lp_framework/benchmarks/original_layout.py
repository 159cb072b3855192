"""Checkpoints in the layout of the published training code, of networks with any weights.

The other way round from `priors.zero123.original`, so that its reading can be measured without the published files.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lp_framework.priors.zero123 import original
from lp_framework.priors.zero123.networks import Networks
from lp_framework.priors.zero123.original import EMA, PROJECTION, UNET, VAE, VISUAL, renamed


def original_tensors(networks: Networks) -> dict[str, Tensor]:
    """The tensors by the names and in the shapes of the training code, the U-Net's also as its moving averages."""
    unet = _renamed(networks.unet, original.unet_modules(networks.unet.config))
    vae = _renamed(networks.vae, original.vae_modules(networks.vae.config))
    clip = _renamed(networks.image_encoder, original.clip_modules(networks.image_encoder.config.to_dict()))
    for key in [key for key in vae if ".attn_1." in key and vae[key].ndim == 2]:  # matrices as 1 x 1 convolutions
        vae[key] = vae[key][:, :, None, None]
    for key in [key for key in clip if ".q_proj." in key]:  # queries, keys and values as one tensor
        parts = [clip.pop(key.replace(".q_proj.", f".{letter}_proj.")) for letter in "qkv"]
        clip[key.replace(".q_proj.", ".in_proj_")] = torch.cat(parts)
    clip["proj"] = clip.pop("visual_projection.weight").t()
    return {
        **{f"{UNET}{key}": tensor for key, tensor in unet.items()},
        **{f"{EMA}diffusion_model{key.replace('.', '')}": tensor.clone() for key, tensor in unet.items()},
        **{f"{VAE}{key}": tensor for key, tensor in vae.items()},
        **{f"{VISUAL}{key}": tensor for key, tensor in clip.items()},
        **{f"{PROJECTION}{key}": tensor for key, tensor in networks.cc_projection.state_dict().items()},
    }


def _renamed(network: torch.nn.Module, modules: dict[str, str]) -> dict[str, Tensor]:
    back = {ours: original for original, ours in modules.items()}
    return {renamed(name, back): tensor for name, tensor in network.state_dict().items()}
