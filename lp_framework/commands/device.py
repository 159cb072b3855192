"""The device of a command that has no trainer."""

from __future__ import annotations

import torch

from lp_framework.errors import UserError


def choose_device(accelerator: str) -> torch.device:
    """The device of `accelerator=auto`, `cpu` or `cuda`: auto is a GPU where there is one."""
    available = torch.cuda.is_available()
    if accelerator not in ("auto", "cpu", "cuda") or (accelerator == "cuda" and not available):
        raise UserError(f"accelerator={accelerator} cannot be had here; choose auto or cpu")
    return torch.device("cuda" if available and accelerator != "cpu" else "cpu")
