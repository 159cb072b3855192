"""Gradient descent from many starts at once, each with an optimizer and a schedule of its own.

All state is tensors on the poses' device, a row a start, and no step waits for a value from there: a batch is exactly
its starts one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from lp_framework.geometry import wrap_angle
from lp_framework.solvers.progress import steps_of


class GradientDescent:
    """Steps of `rate` `[B, N]` times the gradient, for parameters `[B, N, D]`."""

    def __init__(self, parameters: Tensor, learning_rate: float) -> None:
        self.rate = parameters.new_full(parameters.shape[:-1], learning_rate)

    def step(self, gradient: Tensor) -> Tensor:
        """What to add to the parameters, `[B, N, D]`."""
        return -self.rate[..., None] * gradient


class Adam(GradientDescent):
    """Adam (Kingma and Ba 2015), with its usual constants."""

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
    """`torch.optim.lr_scheduler.ReduceLROnPlateau` (its defaults but for factor and patience) for each start.

    A rate is multiplied by `factor` once more than `patience` values in a row have not come below the least so far by
    a ten-thousandth of it.
    """

    THRESHOLD = 1e-4

    def __init__(self, optimizer: GradientDescent, factor: float, patience: int) -> None:
        self.optimizer, self.factor, self.patience = optimizer, factor, patience
        self.best = torch.full_like(optimizer.rate, torch.inf)
        self.bad = torch.zeros_like(optimizer.rate, dtype=torch.int64)

    def step(self, values: Tensor) -> None:
        """Takes note of the values `[B, N]` and changes the optimizer's rates."""
        better = values < self.best * (1 - self.THRESHOLD)
        self.best = torch.where(better, values, self.best)
        self.bad = torch.where(better, 0, self.bad + 1)
        late = self.bad > self.patience
        self.optimizer.rate = torch.where(late, self.factor * self.optimizer.rate, self.optimizer.rate)
        self.bad = self.bad.masked_fill(late, 0)


Energy = Callable[[Tensor, int], Tensor]  # of poses [B, N, P] at a step, [B, N]


class Descended(NamedTuple):
    """`trajectory` `[B, N, steps + 1, P]` from the starts to the ends; `total` `[B, N]`, the sum of the energies met;
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
) -> Descended:
    """Lower `energy(pose_of(parameters), step)` by so many steps from parameters `[B, N, D]`.

    The plateau is fed with the sum of the energies so far, as iFusion does. A start whose energy or gradient is not
    finite stops at the last pose where they were, and is no longer valid.
    """
    valid = torch.ones_like(optimizer.rate, dtype=torch.bool)
    total = torch.zeros_like(optimizer.rate)
    sound, place = parameters, pose_of(parameters)  # the last of each start where energy and gradient were finite
    trajectory = []
    for step in steps_of(steps, "descending the prior"):
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
    return Descended(torch.stack(trajectory, dim=2), total, valid & finite)


def unwrapped(trajectory: Tensor) -> Tensor:
    """The trajectory `[B, N, steps + 1, 3]` with longitudes that go on from step to step, by less than half a turn."""
    latitude, longitude, radius = trajectory.unbind(-1)
    turns = wrap_angle(longitude.diff(dim=-1)).cumsum(dim=-1)
    longitude = torch.cat([longitude[..., :1], longitude[..., :1] + turns], dim=-1)
    return torch.stack([latitude, longitude, radius], dim=-1)
