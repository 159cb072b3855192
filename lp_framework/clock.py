"""Wall-clock time that includes pending GPU work."""

from __future__ import annotations

import time

import torch


def now(device: torch.device) -> float:
    """Wall-clock seconds, after synchronizing with the GPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
