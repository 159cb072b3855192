"""Seconds to load Zero123: the folder that `convert` writes, against a checkpoint of the training code."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch

from lp_framework.benchmarks.contest import Match, Work, compete
from lp_framework.benchmarks.original_layout import write_original
from lp_framework.benchmarks.second_stage import ARCHITECTURES, Architecture
from lp_framework.benchmarks.section import Figure, Section
from lp_framework.priors.zero123.folders import write_folder
from lp_framework.priors.zero123.networks import DTYPES, Dtype, Networks
from lp_framework.priors.zero123.weights import load_networks

CONVERTED, ORIGINAL = "converted folder", "original file"


def measure(
    architecture: Architecture, dtypes: list[Dtype], rounds: int, device: torch.device, place: Path
) -> Iterator[Section]:
    """Loading onto the CPU in each of `dtypes`, in which the folder is kept, too; the original is float32.

    The files, of random weights, lie in a temporary folder in `place`; just written, they come from the system's memory
    rather than from the disk. The original holds the U-Net twice, raw and averaged, as published ones; it lacks their
    optimizer state, which is not read.
    """
    with tempfile.TemporaryDirectory(dir=place) as folder:
        networks = Networks(ARCHITECTURES[architecture])
        original = Path(folder) / "original.ckpt"
        write_original(networks, original)
        sizes: dict[str, Figure] = {}
        matches = []
        for dtype in sorted(dtypes, key=lambda dtype: -DTYPES[dtype].itemsize):  # each is converted from the one before
            converted = Path(folder) / dtype
            write_folder(networks.to(DTYPES[dtype]), converted)
            bytes_of = sum(file.stat().st_size for file in converted.rglob("*")), original.stat().st_size
            sizes[dtype] = Figure(f"{dtype}: GB on disk", *(each / 1e9 for each in bytes_of))
            works = _loading(converted, dtype), _loading(original, dtype)
            matches.append(Match(dtype, f"{dtype}: seconds to load", *works, rate=False))
        del networks
        note = f"Zero123's {architecture} size, random weights; files just written, so from memory rather than disk"
        for section in compete("checkpoint: loading Zero123", (CONVERTED, ORIGINAL), matches, rounds, device, note):
            record = {
                dtype: {"seconds": seconds, "gigabytes": {CONVERTED: sizes[dtype].first, ORIGINAL: sizes[dtype].second}}
                for dtype, seconds in section.record.items()
            }
            yield replace(section, figures=[*sizes.values(), *section.figures], record=record)


def _loading(path: Path, dtype: Dtype) -> Work:
    def work() -> float:
        load_networks(str(path), None, "ema", dtype)
        return 1

    return work
