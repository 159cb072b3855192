"""Seconds to load Zero123: the folder that `convert` writes, against a checkpoint of the training code."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from lp_framework.benchmarks.harness import Section, worth
from lp_framework.benchmarks.zero123 import Architecture, Computing
from lp_framework.priors.zero123.networks import DTYPES, Dtype, Networks
from lp_framework.priors.zero123.original import (
    EMA,
    PROJECTION,
    UNET,
    VAE,
    VISUAL,
    clip_modules,
    renamed,
    unet_modules,
    vae_modules,
)
from lp_framework.priors.zero123.weights import load_networks, write_folder

CONTENDERS = "checkpoint: loading Zero123", ("converted folder", "original file")


def measure(section: Section, architecture: Architecture, dtypes: Sequence[Dtype], rounds: int, place: Path) -> None:
    """Loading onto the CPU in each of `dtypes`, in which the folder is kept, too; the original is float32.

    The files, of random weights, lie in a temporary folder in `place`; just written, they come from the system's memory
    rather than from the disk. The original holds the U-Net twice, raw and averaged, as published ones; it lacks their
    optimizer state, which is not read.
    """
    section.note = f"Zero123's {architecture} size, random weights; files just written, so from memory rather than disk"
    with tempfile.TemporaryDirectory(dir=place) as folder:
        networks = Computing(architecture).networks(torch.device("cpu"))
        original = Path(folder) / "original.ckpt"
        torch.save({"state_dict": original_tensors(networks)}, original)
        works = {}
        for dtype in sorted(dtypes, key=lambda dtype: -DTYPES[dtype].itemsize):  # each is converted from the one before
            converted = Path(folder) / dtype
            write_folder(networks.to(DTYPES[dtype]), converted)
            size = sum(file.stat().st_size for file in converted.rglob("*"))
            section.add(f"{dtype}: GB on disk", size / 1e9, original.stat().st_size / 1e9)
            first, second = (
                worth(1, partial(load_networks, str(file), None, "ema", dtype)) for file in (converted, original)
            )
            works[f"{dtype}: seconds to load"] = first, second
        del networks
        section.race(works, rounds)


def original_tensors(networks: Networks) -> dict[str, Tensor]:
    """The tensors by the names and in the shapes of the training code, the U-Net's also as its moving averages.

    The other way round from `priors.zero123.original`, so that its reading can be measured without the published files.
    """
    unet = _renamed(networks.unet, unet_modules(networks.unet.config))
    vae = _renamed(networks.vae, vae_modules(networks.vae.config))
    clip = _renamed(networks.image_encoder, clip_modules(networks.image_encoder.config.to_dict()))
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
