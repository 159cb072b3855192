"""Gradient descent from many starts at once, each with its own optimizer state and learning rate schedule.

All state is kept in tensors on the poses' device, one row per start, and no step synchronizes with the device. Solving
a batch gives exactly the results of solving its starts one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from lp_framework.geometry import wrap_angle
from lp_framework.solvers.progress import steps_of


class GradientDescent:
    """Plain gradient descent with learning rates `rate` `[B, N]` for parameters `[B, N, D]`."""

    def __init__(self, parameters: Tensor, learning_rate: float) -> None:
        self.rate = parameters.new_full(parameters.shape[:-1], learning_rate)

    def step(self, gradient: Tensor) -> Tensor:
        """The update to add to the parameters, `[B, N, D]`."""
        return -self.rate[..., None] * gradient


class Adam(GradientDescent):
    """Adam (Kingma and Ba 2015) with the usual constants."""

    BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8

    def __init__(self, parameters: Tensor, learning_rate: float) -> None:
        super().__init__(parameters, learning_rate)
        self.mean, self.square, self.steps = torch.zeros_like(parameters), torch.zeros_like(parameters), 0

    def step(self, gradient: Tensor) -> Tensor:
        self.steps += 1
        self.mean = self.BETA_1 * self.mean + (1 - self.BETA_1) * gradient
        self.square = self.BETA_2 * self.square + (1 - self.BETA_2) * gradient.square()
        mean = self.mean / (1 - self.BETA_1**self.steps)
        spread = (self.square / (1 - self.BETA_2**self.steps)).sqrt()
        return super().step(mean / (spread + self.EPSILON))


class Plateau:
    """`torch.optim.lr_scheduler.ReduceLROnPlateau` for each start, with defaults except for `factor` and `patience`.

    A rate is multiplied by `factor` after more than `patience` values in a row that do not improve on the minimum so
    far by at least a relative 1e-4.
    """

    THRESHOLD = 1e-4

    def __init__(self, optimizer: GradientDescent, factor: float, patience: int) -> None:
        self.optimizer, self.factor, self.patience = optimizer, factor, patience
        self.best = torch.full_like(optimizer.rate, torch.inf)
        self.bad = torch.zeros_like(optimizer.rate, dtype=torch.int64)

    def step(self, values: Tensor) -> None:
        """Record the values `[B, N]` and update the optimizer's learning rates."""
        better = values < self.best * (1 - self.THRESHOLD)
        self.best = torch.where(better, values, self.best)
        self.bad = torch.where(better, 0, self.bad + 1)
        late = self.bad > self.patience
        self.optimizer.rate = torch.where(late, self.factor * self.optimizer.rate, self.optimizer.rate)
        self.bad = self.bad.masked_fill(late, 0)


Energy = Callable[[Tensor, int], Tensor]  # (poses [B, N, P], step) -> energies [B, N]


class Descent(NamedTuple):
    """`trajectory` `[B, N, steps + 1, P]` from start to final pose; `total` `[B, N]`, the sum of the energies along it;
    `valid` `[B, N]`."""

    trajectory: Tensor
    total: Tensor
    valid: Tensor


def descend(
    energy: Energy,
    pose_of: Callable[[Tensor], Tensor],
    parameters: Tensor,
    steps: int,
    optimizer: GradientDescent,
    plateau: Plateau | None = None,
) -> Descent:
    """Minimize `energy(pose_of(parameters), step)` for `steps` steps from parameters `[B, N, D]`.

    The plateau schedule gets the sum of the energies so far, as in iFusion. A start whose energy or gradient becomes
    non-finite stops at its last finite pose and is marked invalid.
    """
    valid = torch.ones_like(optimizer.rate, dtype=torch.bool)
    total = torch.zeros_like(optimizer.rate)
    sound, place = parameters, pose_of(parameters)  # the last ones with a finite energy and gradient, per start
    trajectory = []
    for step in steps_of(steps, "minimizing the energy"):
        variable = parameters.detach().clone().requires_grad_()
        with torch.enable_grad():
            pose = pose_of(variable)
            energies = energy(pose, step)
            (gradient,) = torch.autograd.grad(energies.sum(), variable)
        valid = valid & energies.isfinite() & gradient.isfinite().all(dim=-1)
        alive = valid[..., None]
        sound, place = torch.where(alive, parameters, sound), torch.where(alive, pose.detach(), place)
        trajectory.append(place)
        parameters = torch.where(alive, parameters + optimizer.step(gradient.masked_fill(~alive, 0.0)), sound)
        total = total + energies.detach().masked_fill(~valid, 0.0)
        if plateau is not None:
            plateau.step(total)
    pose = pose_of(parameters)
    finite = pose.isfinite().all(dim=-1)
    trajectory.append(torch.where(finite[..., None], pose, place))
    return Descent(torch.stack(trajectory, dim=2), total, valid & finite)


def unwrapped(trajectory: Tensor) -> Tensor:
    """Unwrap the longitudes of a trajectory `[B, N, steps + 1, 3]`, so that each step is less than half a turn."""
    latitude, longitude, radius = trajectory.unbind(-1)
    turns = wrap_angle(longitude.diff(dim=-1)).cumsum(dim=-1)
    longitude = torch.cat([longitude[..., :1], longitude[..., :1] + turns], dim=-1)
    return torch.stack([latitude, longitude, radius], dim=-1)
