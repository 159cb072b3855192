"""The synthetic Zero123 checkpoint of data/reference (its README describes how the weights are drawn)."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch

REFERENCE = Path(__file__).parent / "data" / "reference" / "zero123_tiny"


def manifest() -> dict[str, Any]:
    return json.loads((REFERENCE / "manifest.json").read_text())


def golden() -> dict[str, np.ndarray]:
    with np.load(REFERENCE / "golden.npz") as arrays:
        return dict(arrays)


def draw(seed: int, key: str, shape: list[int]) -> torch.Tensor:
    state = np.random.RandomState(zlib.crc32(f"{seed}/{key}".encode()))
    values = np.asarray(state.standard_normal(shape), dtype=np.float32)
    if values.ndim >= 2 and not key.endswith(("positional_embedding", "class_embedding")):
        values = values / np.sqrt(shape[0] if key.endswith("visual.proj") else np.prod(shape[1:]))
    else:
        values = 1 + 0.1 * values if key.endswith("weight") else 0.02 * values
    return torch.from_numpy(np.asarray(values, dtype=np.float32))


def state_dict() -> dict[str, torch.Tensor]:
    """Raw weights and moving averages, without the tables of the schedule."""
    description = manifest()
    seed, tensors = description["seed"], {}
    for key, shape, *source in description["keys"]:
        if shape == [1000]:
            continue
        tensors[key] = draw(seed + 1, source[0], shape) if source else draw(seed, key, shape)
    return tensors


def write_checkpoint(folder: Path) -> Path:
    """The checkpoint as a file; of published ones it has the entries, not the 15 GB of optimizer state."""
    file = folder / "synthetic.ckpt"
    torch.save({"epoch": 1, "global_step": 105000, "state_dict": state_dict(), "optimizer_states": []}, file)
    return file
