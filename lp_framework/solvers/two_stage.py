"""The paper's method, a learned score followed by the prior's energy; and our variant, with Gauss-Newton."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lp_framework.errors import at_least, check_settings
from lp_framework.geometry import reduce_longitude
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.registry import register
from lp_framework.solvers.base import Cost, Pairs, Solution, Solver, choose, timed
from lp_framework.solvers.langevin import make_first_stage
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.progress import steps_of
from lp_framework.solvers.twist import ChooseBy, TanhRadius, TwistDescent

LONGEST_STEP = 0.5  # radians and scene units; longer steps may end where the prior hardly depends on the pose


@register("solver", "two_stage")
class TwoStage(Solver):
    """The paper's method: `langevin` on a score or energy model, then iFusion's descent on the prior from there.

    Defaults are the paper's (appendix, Two Stage Optimization). The second stage has the settings of `ifusion`, but
    uses `TanhRadius` because the first may end at any radius. With no refinement steps, only the first stage runs.
    """

    def __init__(
        self,
        model: PoseModel,
        prior: Prior,
        alpha: float = 0.1,
        gamma: float | Sequence[float] = (0.0, 0.3, 0.0),
        iterations: int = 50,
        refinement_steps: int = 50,
        learning_rate: float = 0.1,
        factor: float = 0.7,
        patience: int = 10,
        first_timestep: int = 99,
        last_timestep: int = 0,
        choose_by: ChooseBy = "accumulated",
        rescoring: int = 16,
        trajectory: bool = False,
    ) -> None:
        at_least(0, "solver", refinement_steps=refinement_steps)
        self.model, self.prior = model, prior
        self.first = make_first_stage(model, alpha, gamma, iterations, trajectory)
        schedule = (refinement_steps, learning_rate, factor, patience, first_timestep, last_timestep)
        self.second = TwistDescent(prior, *schedule, choose_by, rescoring, trajectory=trajectory)

    @timed
    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        """See `Solver.solve`. A start is invalid if the model or the prior failed."""
        first = self.first.solve(pairs, starts, seed)
        if self.second.steps == 0:
            return first
        return chained(first, lambda ends: self.second.solve(pairs, ends, seed))


def chained(first: Solution, second: Callable[[Tensor], Solution]) -> Solution:
    """Run `second` from the final poses of `first` `[B, N, 3]`; trajectory and cost cover both stages.

    A start is invalid if either stage failed; if the first did, it keeps the first stage's pose.
    """
    # Starts that failed are replaced by the origin, to keep the batch's shape.
    after = second(first.poses.masked_fill(~first.valid[..., None], 0.0))
    energies = after.energies.masked_fill(~first.valid, torch.nan)
    poses = torch.where(first.valid[..., None], after.poses, first.poses)
    cost = Cost(first.cost.network_passes + after.cost.network_passes)
    path = _joined(first.trajectory, after.trajectory)
    return Solution(poses, energies, first.valid & after.valid, choose(energies), cost, trajectory=path)


def _joined(first: Tensor | None, second: Tensor | None) -> Tensor | None:
    """Concatenate the trajectories, with longitudes continuous across the two; the shared pose appears once."""
    if first is None or second is None:
        return None
    after = second[:, :, 1:]
    turns = ((first[:, :, -1:, 1] - second[:, :, :1, 1]) / (2 * math.pi)).round()
    after = torch.stack([after[..., 0], after[..., 1] + 2 * math.pi * turns, after[..., 2]], dim=-1)
    return torch.cat([first, after], dim=2)  # `turns` is NaN where the first stage failed


class Quadratic(NamedTuple):
    """The Gauss-Newton model of the energy at poses `[B, N, 3]`: E(x + d) = E + 2 g.d + d.H d."""

    energy: Tensor  # [B, N]
    gradient: Tensor  # J^T r, half the energy's gradient, [B, N, 3]
    hessian: Tensor  # J^T J, [B, N, 3, 3]


@register("solver", "gauss_newton")
class GaussNewton(Solver):
    """Ours: first stage `langevin`, then Levenberg-Marquardt on the prior's residuals, all starts at once.

    A pair's energy is the mean square of the residuals in both directions, with one noise per entry of `timesteps`,
    drawn once so that every step minimizes the same function. The Jacobian uses forward-mode AD (eight passes per
    timestep), which the prior must support under `torch.func.vmap`. Each start has its own damping (Nielsen 1999).

    Steps are at most 0.5 long, and radii stay within the range of views. The quadratic model needs a start near the
    minimum, so `gamma` defaults to 0; with the paper's 0.3, distant starts need about ten more steps.
    """

    def __init__(
        self,
        model: PoseModel,
        prior: Prior,
        alpha: float = 0.1,
        gamma: float | Sequence[float] = 0.0,
        iterations: int = 50,
        refinement_steps: int = 4,
        timesteps: Sequence[int] = (500,),
        damping: float = 1e-2,
        trajectory: bool = False,
    ) -> None:
        known = bool(timesteps) and all(0 <= each < prior.num_timesteps for each in timesteps)
        at_least(0, "solver", refinement_steps=refinement_steps)
        check_settings(
            "solver",
            ("timesteps", list(timesteps), known, f"one or more of 0 to {prior.num_timesteps - 1}"),
            ("damping", damping, 0 < damping < math.inf, "positive"),
        )
        self.first = make_first_stage(model, alpha, gamma, iterations, trajectory)
        self.model, self.prior = model, prior
        self.steps, self.timesteps, self.damping = refinement_steps, list(timesteps), damping
        self.trajectory = trajectory

    @timed
    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        """See `Solver.solve`. Energies are those minimized; a start is invalid if the model or the prior failed."""
        first = self.first.solve(pairs, starts, seed)
        return chained(first, lambda ends: self.refine(pairs, ends, seed))

    @timed
    @torch.inference_mode(False)
    @torch.no_grad()
    def refine(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        """The second stage alone, from starts `[B, N, 3]`."""
        energy = PairEnergy(self.prior, pairs, seed)
        noise = energy.noise(0, len(self.timesteps))
        pose = _clamped(starts.clone())
        trajectory = [pose]
        here = self._quadratic(energy, pose, noise)
        damping = self.damping * here.hessian.diagonal(dim1=-2, dim2=-1).amax(dim=-1)  # [B, N]
        growth = torch.full_like(damping, 2.0)
        identity = torch.eye(3, dtype=pose.dtype, device=pose.device)
        for _ in steps_of(self.steps, "minimizing the energy"):
            damped = here.hessian + damping[..., None, None] * identity
            solved, _ = torch.linalg.solve_ex(damped, here.gradient)
            length = torch.linalg.vector_norm(solved, dim=-1, keepdim=True)
            proposal = _clamped(pose - solved * (LONGEST_STEP / length.clamp(min=LONGEST_STEP)))
            step = proposal - pose
            there = self._quadratic(energy, proposal, noise)
            curved = (here.hessian * step[..., None] * step[..., None, :]).sum(dim=(-2, -1))
            expected = -2 * (here.gradient * step).sum(dim=-1) - curved
            ratio = (here.energy - there.energy) / expected
            better = (there.energy < here.energy) & (expected > 0) & there.gradient.isfinite().all(dim=-1)
            damping = damping * torch.where(better, (1 - (2 * ratio - 1) ** 3).clamp(min=1 / 3), growth)
            growth = torch.where(better, 2.0, 2 * growth)
            pose = torch.where(better[..., None], proposal, pose)
            here = Quadratic(
                torch.where(better, there.energy, here.energy),
                torch.where(better[..., None], there.gradient, here.gradient),
                torch.where(better[..., None, None], there.hessian, here.hessian),
            )
            trajectory.append(pose)
        valid = here.energy.isfinite() & here.gradient.isfinite().all(dim=-1)
        energies = here.energy.masked_fill(~valid, torch.nan)
        path = torch.stack(trajectory, dim=2) if self.trajectory else None
        return Solution(reduce_longitude(pose), energies, valid, choose(energies), Cost(energy.passes), trajectory=path)

    def _quadratic(self, energy: PairEnergy, pose: Tensor, noise: Tensor) -> Quadratic:
        """Energy, gradient and Hessian at poses `[B, N, 3]`; noise `[B, timesteps, 2, *latent_shape]`."""
        parts = []
        for number, timestep in enumerate(self.timesteps):

            def residual(step: Tensor, timestep: int = timestep, number: int = number) -> tuple[Tensor, Tensor]:
                value = energy.residual(pose + step, timestep, noise[:, number]).flatten(2)
                return value, value

            before = energy.passes
            jacobian, value = torch.func.jacfwd(residual, has_aux=True)(pose.new_zeros(3))  # [B, N, M, 3], [B, N, M]
            energy.passes += 3 * (energy.passes - before)  # for the derivatives
            gradient = (jacobian * value[..., None]).mean(dim=-2)
            hessian = (jacobian[..., None] * jacobian[..., None, :]).mean(dim=-3)
            parts.append(Quadratic(value.square().mean(dim=-1), gradient, hessian))
        return Quadratic(*(torch.stack(part).mean(dim=0) for part in zip(*parts, strict=True)))


def _clamped(poses: Tensor) -> Tensor:
    """Clamp the relative radii of poses `[..., 3]` to the range of views."""
    return torch.cat([poses[..., :2], poses[..., 2:].clamp(-TanhRadius.LIMIT, TanhRadius.LIMIT)], dim=-1)
