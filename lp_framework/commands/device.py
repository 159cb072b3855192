"""The device of a command that has no trainer."""

from __future__ import annotations

import torch

from lp_framework.api import best_device
from lp_framework.errors import UserError


def choose_device(accelerator: str) -> torch.device:
    """The device of `accelerator=auto` (a GPU where there is one), `cpu`, or a GPU by its type, `cuda` or `mps`."""
    best = best_device()
    if accelerator not in ("auto", "cpu", best.type):
        choices = " or ".join(dict.fromkeys(["auto", "cpu", best.type]))
        raise UserError(f"accelerator={accelerator} is not available on this machine; choose {choices}")
    return torch.device("cpu") if accelerator == "cpu" else best
