"""The paper's first stage: Langevin-like descent of a learned score (Eq. 4, Two Stage Optimization)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import permutations
from typing import Any, Literal

import torch
from torch import Tensor

from lp_framework.errors import UserError, at_least, check_settings
from lp_framework.geometry import reduce_longitude, wrap_angle
from lp_framework.keyed_random import keyed_normal
from lp_framework.models.pose_model import PoseModel
from lp_framework.registry import register
from lp_framework.solvers.base import (
    Cost,
    Pairs,
    Solution,
    Solver,
    ViewSets,
    ViewSolution,
    choose,
    of_first_views,
    timed,
)
from lp_framework.solvers.joint_density import joint_density
from lp_framework.solvers.progress import steps_of

SHARP = 0.15  # radians, scene units: smoothing small enough to keep the modes of a density apart


@register("solver", "langevin")
class Langevin(Solver):
    """First stage alone: x <- x + alpha s(x) + gamma z on a score or energy model, for all starts of all pairs.

    `choose_by` selects the answer among the final poses: `distance`, the lowest distance to the truth as estimated from
    the field, which under noise picks the pose that happens to be nearest; `agreement`, the lowest median distance to
    the other final poses; `energy`, the lowest energy of an energy model; by default the model's own choice.

    `sigma` is for models that know their field at every sigma (`matching`): one value, or those of the first and the
    last step with geometric interpolation in between. The step size is then alpha sigma^2 / (the model's sigma)^2, so
    that each step covers the same fraction of the way to a single truth, and the noise is proportional to sigma.
    """

    def __init__(
        self,
        model: PoseModel,
        alpha: float = 0.1,
        gamma: float | Sequence[float] = (0.0, 0.3, 0.0),
        iterations: int = 50,
        choose_by: Literal["distance", "agreement", "energy"] | None = None,
        sigma: float | Sequence[float] | None = None,
        trajectory: bool = False,
    ) -> None:
        limit = 2 * model.sigma**2  # a step leaves a fraction 1 - alpha / sigma^2 of the way to go
        converging = f"between 0 and {limit:g}, twice the model's sigma^2, to converge"
        check_settings("solver", ("alpha", alpha, 0 < alpha < limit, converging))
        at_least(0, "solver", iterations=iterations)
        if choose_by == "energy" and not model.has_energy:
            raise UserError("solver.choose_by=energy needs model=energy; a score model has no energy, use distance")
        self.model = model
        self.alpha, self.gamma = alpha, _triple(gamma)
        self.iterations, self.choose_by, self.trajectory = iterations, choose_by or model.choose_by, trajectory
        self.sigmas = None if sigma is None else _sigma_schedule(sigma, iterations)

    @timed
    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        """See `Solver.solve`. A start is invalid if its final pose is not finite."""
        codes = self.model.encode(pairs.images)
        condition = self.model.condition(codes[pairs.reference], codes[pairs.query])
        return self._descend(condition, pairs, starts, seed)

    @timed
    def solve_views(self, view_sets: ViewSets, starts: Tensor, seed: int) -> ViewSolution:
        """See `Solver.solve_views`. If the model has densities, those of all ordered pairs are combined."""
        if not self.model.has_density:
            return super().solve_views(view_sets, starts, seed)
        codes = self.model.encode(view_sets.images)
        pairs = view_sets.pairs(*zip(*permutations(range(view_sets.views.shape[1]), 2), strict=True))
        condition = self.model.condition(codes[pairs.reference], codes[pairs.query])
        joint = joint_density(condition, len(view_sets), view_sets.ids, seed)
        solution = self._descend(joint, view_sets.with_first(), starts.flatten(0, 1), seed)
        return of_first_views(view_sets, solution)

    def _descend(self, condition: Any, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        condition = condition[:, None]  # [B, 1, ...]
        noise = self._noise(pairs, starts, seed)
        pose, trajectory = starts, [starts]
        ratio = 1.0
        for step in steps_of(self.iterations, "first stage"):
            if self.sigmas is not None:
                condition = self.model.at_sigma(condition, self.sigmas[step])
                ratio = self.sigmas[step] / self.model.sigma
            score = self.model.field(condition, pose).score
            pose = pose + self.alpha * ratio**2 * score + ratio * noise[:, :, step]
            trajectory.append(pose)
        energies = self._energies(condition, pose)
        evaluations = self.iterations + {"distance": 3, "energy": 1, "agreement": 0}[self.choose_by]
        cost = Cost(len(pairs.images) + starts.shape[0] * starts.shape[1] * evaluations)
        path = torch.stack(trajectory, dim=2) if self.trajectory else None
        within = self.model.probability(condition, pose)
        valid, chosen = pose.isfinite().all(dim=-1), choose(energies)
        return Solution(reduce_longitude(pose), energies, valid, chosen, cost, trajectory=path, probability=within)

    def _noise(self, pairs: Pairs, starts: Tensor, seed: int) -> Tensor:
        """The noise gamma z_t of each start and step, `[B, N, iterations, 3]`, keyed by seed, pair and start."""
        count, shape = starts.shape[1], (*starts.shape[:2], self.iterations, 3)
        if not any(self.gamma):
            return starts.new_zeros(shape)
        draws = keyed_normal(seed, pairs.ids[:, None], torch.arange(count), count=3 * self.iterations)
        return (draws.view(shape) * torch.tensor(self.gamma, dtype=draws.dtype)).to(starts)

    def _energies(self, condition: Tensor, ends: Tensor) -> Tensor:
        """The values `[B, N]` whose minimum is the answer; see `choose_by`."""
        if self.choose_by == "distance":
            return self._distance(condition, ends)
        if self.choose_by == "agreement":
            offset = ends[:, :, None] - ends[:, None]
            offset = torch.stack([offset[..., 0], wrap_angle(offset[..., 1]), offset[..., 2]], dim=-1)
            return offset.norm(dim=-1).nanmedian(dim=-1).values  # ignores starts that failed
        energy = self.model.field(condition, ends).energy
        assert energy is not None  # checked by the constructor
        return energy

    def _distance(self, condition: Tensor, pose: Tensor) -> Tensor:
        """Distance `[B, N]` to the truth (radians, scene units) estimated from the field by Tweedie's formulas.

        The mean offset from the truth is -sigma^2 s (first order). Near the antipode s vanishes, but its slope s' along
        the longitude is positive there, and the mean square sigma^4 (s^2 + s') + sigma^2 (second order) still gives the
        distance. Elsewhere the second order would only add the noise of a learned slope."""
        variance = self.model.sigma**2
        step = 0.02 * variance * pose.new_tensor([0.0, 1.0, 0.0])
        score = self.model.field(condition, pose).score
        ahead, behind = (self.model.field(condition, each).score[..., 1] for each in (pose + step, pose - step))
        slope = (ahead - behind) / (2 * step[1])
        beyond = torch.where(slope > 0, variance**2 * slope + variance, 0.0)
        return (variance**2 * score.square().sum(dim=-1) + beyond).sqrt()


def make_first_stage(
    model: PoseModel, alpha: float, gamma: float | Sequence[float], iterations: int, trajectory: bool = False
) -> Langevin:
    """`Langevin`, with little smoothing for models with densities so that their modes stay separate."""
    return Langevin(model, alpha, gamma, iterations, sigma=SHARP if model.has_density else None, trajectory=trajectory)


def _sigma_schedule(sigma: float | Sequence[float], steps: int) -> list[float]:
    """`sigma` at each step."""
    ends = [sigma] * 2 if isinstance(sigma, int | float) else [*sigma]
    fits = len(ends) == 2 and all(0 < each < math.inf for each in ends)
    check_settings("solver", ("sigma", sigma, fits, "one positive number, or two (the first and the last step's)"))
    first, last = ends
    return [first * (last / first) ** (step / max(1, steps - 1)) for step in range(steps)]


def _triple(gamma: float | Sequence[float]) -> list[float]:
    """`gamma` of latitude, longitude and radius, from three numbers or from one for the longitude."""
    triple = [0.0, float(gamma), 0.0] if isinstance(gamma, int | float) else [float(each) for each in gamma]
    fits = len(triple) == 3 and all(0 <= each < math.inf for each in triple)
    wanted = "one number (longitude) or three (latitude, longitude, radius), none negative"
    check_settings("solver", ("gamma", gamma, fits, wanted))
    return triple
