"""Seconds to load Zero123: the folder that `convert` writes, against a checkpoint of the training code."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch

from lp_framework.benchmarks.harness import Section, worth
from lp_framework.benchmarks.original_layout import original_tensors
from lp_framework.benchmarks.zero123 import Architecture, Computing
from lp_framework.priors.zero123.networks import DTYPES, Dtype
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
