"""Solvers that see two images, predict one relative camera, and need neither starts nor descent."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from lp_framework.clock import now
from lp_framework.errors import UserError, check_settings
from lp_framework.geometry import pose_of_relative_camera
from lp_framework.solvers.base import Cost, Pairs, Solution, Solver, check_starts

Loaded = TypeVar("Loaded")


class RelativeCameraSolver(Solver):
    """One answer a pair (N = 1), **starts are ignored**; a pair without an answer is invalid and its pose NaN.

    The `Solution` has full cameras, whose translations are known up to a factor. Its poses are theirs as
    `pose_of_relative_camera` has them, with the reference `reference_radius` (object sizes) from the object's centre;
    1.4 is where `estimate` puts that of prepared photographs.
    """

    one_answer = True

    def __init__(self, reference_radius: float) -> None:
        check_settings("solver", ("reference_radius", reference_radius, reference_radius > 0, "positive"))
        self.reference_radius = reference_radius

    @abstractmethod
    def predict(self, pairs: Pairs, seed: int) -> tuple[Tensor, Tensor, int]:
        """Relative cameras `[B, 4, 4]` (float64, see `geometry.two_view`; NaN where there is none), energies `[B]`,
        and passes through the network."""

    @torch.no_grad()
    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        check_starts(pairs, starts)
        began = now(starts.device)
        cameras, energies, passes = self.predict(pairs, seed)
        poses = pose_of_relative_camera(cameras, self.reference_radius)
        return Solution(
            poses=poses.to(starts)[:, None],
            energies=energies.to(starts)[:, None],
            valid=cameras.isfinite().all(dim=-1).all(dim=-1).to(starts.device)[:, None],
            chosen=torch.zeros(len(pairs), dtype=torch.int64, device=starts.device),
            cost=Cost(network_passes=passes, seconds=now(starts.device) - began),
            cameras=cameras.to(starts)[:, None],
        )


def with_weights(load: Callable[[str], Loaded], network: str, weights: str) -> Loaded:
    """What `load` makes of the weights of a network (a file, a folder or a hub id); `UserError` where it cannot."""
    if Path(weights).suffix in (".pt", ".pth", ".safetensors") and not Path(weights).is_file():
        raise UserError(f"{weights}: there is no such file with the weights of {network}")
    try:
        return load(weights)
    except Exception as error:  # the hub's package and its HTTP libraries have many of their own
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise UserError(
            f"{weights}: the weights of {network} cannot be had from there ({reason}); "
            "give solver.weights= a local path or an id of the Hugging Face hub"
        ) from error
