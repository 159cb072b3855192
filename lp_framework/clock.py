"""Seconds that count what a GPU still has to do."""

from __future__ import annotations

import time

import torch


def now(device: torch.device) -> float:
    """A clock's seconds, once a GPU has done all that it was told."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
