"""Functions of the relative pose: a prior's energies, scores and views, a model's fields, and its kernel's fields."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lp_framework.analysis.landscapes import Arrows, Grid, Landscape, cell_grid
from lp_framework.errors import UserError
from lp_framework.models.objectives import PoseKernel
from lp_framework.models.pose_model import FieldValue, PoseModel
from lp_framework.priors.base import Prior, ViewCode
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.progress import steps_of

GRADIENT_BATCH = 8  # poses per gradient computation


class Draws(NamedTuple):
    """Random draws that a prior's energy averages: `noises` at each of `timesteps`, keyed by `seed`, both directions.

    All poses get the same noises. At most `batch` poses pass through the prior at once, two samples each.
    """

    timesteps: Sequence[int]
    noises: int
    seed: int
    batch: int = 64

    def steps(self) -> list[int]:
        """The timestep of every noise."""
        return [timestep for timestep in self.timesteps for _ in range(self.noises)]

    def in_words(self) -> str:
        """Describe the draws in a sentence.

        >>> Draws([100, 900], 5, seed=0).in_words()
        'Mean over both directions of the pair, timesteps 100, 900 and 5 noises per timestep.'
        """
        each = "one noise" if self.noises == 1 else f"{self.noises} noises"
        steps = ", ".join(map(str, self.timesteps))
        return f"Mean over both directions of the pair, timesteps {steps} and {each} per timestep."


def checked_draws(timesteps: object, noises: object, seed: int, batch: object = 64) -> Draws:
    """Build `Draws` from settings; `UserError` if they are invalid. The prior itself checks the range of timesteps."""
    for key, value in (("noises", noises), ("batch", batch)):
        if not isinstance(value, int) or value < 1:
            raise UserError(f"{key} must be a whole number, at least 1, got {value}")
    steps = list(timesteps) if isinstance(timesteps, Sequence) else []
    if not steps or not all(isinstance(each, int) for each in steps):
        raise UserError(f"timesteps must be a list of one or more whole numbers, got {timesteps}")
    return Draws(steps, noises, seed, batch)  # type: ignore[arg-type]  # both are whole numbers


class ExactModel(nn.Module):
    """Oracle model of P pairs: the kernel's own score around their truths `[P, 3]`, the target of training."""

    def __init__(self, kernel: PoseKernel, truth: Tensor, has_energy: bool = False) -> None:
        super().__init__()
        self.kernel, self.truth, self.has_energy, self.sigma = kernel, truth, has_energy, kernel.sigma
        self.choose_by, self.has_density = PoseModel.choose_by, False

    def encode(self, images: Tensor) -> Tensor:
        """Placeholder features `[I, 1]`."""
        return images.new_zeros(len(images), 1)

    def condition(self, reference: Tensor, query: Tensor) -> Tensor:
        return reference

    def field(self, condition: Tensor, pose: Tensor) -> FieldValue:
        """See `PoseModel`; poses are `[P, ..., 3]`."""
        truth = self.truth.view(-1, *[1] * (pose.ndim - 2), 3).to(pose)
        energy = self.kernel.energy(pose, truth) if self.has_energy else None
        return FieldValue(self.kernel.score(pose, truth), energy)

    def probability(self, condition: Tensor, pose: Tensor) -> None:
        """See `PoseModel`; there is no density."""


def grid_poses(radius: Tensor, latitude: Tensor, longitude: Tensor) -> Tensor:
    """Relative poses `[B, A, O, 3]`, float32, at relative radii `[B]`, on their device."""
    angles = torch.cartesian_prod(latitude.float(), longitude.float()).view(len(latitude), len(longitude), 2)
    angles = angles.to(radius.device).expand(len(radius), -1, -1, -1)
    radii = radius.float()[:, None, None, None].expand(*angles.shape[:3], 1)
    return torch.cat([angles, radii], dim=-1)


@torch.no_grad()
def prior_landscapes(prior: Prior, pairs: Pairs, radius: Tensor, grid: Grid, draws: Draws) -> list[Landscape]:
    """A prior's energy over a grid of latitudes and longitudes for B pairs, each at its relative radius of `[B]`."""
    poses = grid_poses(radius.to(pairs.images.device), *grid)
    energies = pose_energies(prior, pairs, poses.flatten(1, 2), draws).view(poses.shape[:3]).cpu()
    return [Landscape(*grid, *each) for each in zip(radius.tolist(), energies, strict=True)]


@torch.no_grad()
def pose_energies(prior: Prior, pairs: Pairs, poses: Tensor, draws: Draws) -> Tensor:
    """A prior's energies `[B, N]` of relative poses `[B, N, 3]`; shows a progress bar inside `shown_progress`."""
    steps, codes = draws.steps(), prior.encode(pairs.images)
    # Each pass takes several pairs, or part of the poses of one pair.
    groups = torch.arange(len(pairs), device=poses.device).split(max(1, draws.batch // poses.shape[1]))
    parts = torch.arange(poses.shape[1], device=poses.device).split(draws.batch)
    tasks = [(group, part) for group in groups for part in parts]
    energies = poses.new_empty(poses.shape[:2])
    for number in steps_of(len(tasks), "landscape"):
        group, part = tasks[number]
        some = Pairs(pairs.images, pairs.reference[group], pairs.query[group], pairs.ids[group])
        energy = PairEnergy(prior, some, draws.seed, codes)
        place = group[:, None], part
        energies[place] = energy.mean(poses[place], steps, energy.noise(0, count=len(steps)))
    return energies


def prior_field(prior: Prior, pairs: Pairs, poses: Tensor, draws: Draws) -> FieldValue:
    """A prior's field at relative poses `[B, N, 3]`: `pose_energies` and their negative gradients."""
    energy, steps = PairEnergy(prior, pairs, draws.seed), draws.steps()
    noise = energy.noise(0, count=len(steps))
    parts = poses.split(max(1, min(draws.batch, GRADIENT_BATCH) // len(pairs)), dim=1)
    scores, energies = [], []
    for number in steps_of(len(parts), "gradients of the landscape"):
        variable = parts[number].detach().clone().requires_grad_()
        gradient = torch.zeros_like(variable)
        total = torch.zeros(variable.shape[:2], device=variable.device)
        for place, timestep in enumerate(steps):  # keeps one graph in memory at a time
            with torch.enable_grad():
                value = energy(variable, timestep, noise[:, place])
                gradient += torch.autograd.grad(value.sum(), variable)[0]
            total += value.detach()
        scores.append(-gradient / len(steps))
        energies.append(total / len(steps))
    return FieldValue(torch.cat(scores, dim=1), torch.cat(energies, dim=1))


@torch.no_grad()
def generated_views(
    prior: Prior, source: ViewCode, poses: Tensor, steps: int, guidance: float, seed: int,
    eta: float = 1.0, batch: int = 16,
) -> NDArray:  # fmt: skip
    """Views `[N, H, W, 3]` in [0, 1] from one image's code at relative poses `[N, 3]`, by DDIM with shared draws."""
    parts = []
    for number in steps_of(math.ceil(len(poses) / batch), "generated views"):
        generator = torch.Generator().manual_seed(seed)  # on the CPU, so that a GPU gets the same draws
        pose = poses[number * batch : (number + 1) * batch].to(source.latent)
        repeated = source[torch.zeros(len(pose), dtype=torch.int64, device=pose.device)]
        parts.append(prior.generate(repeated, pose, steps, guidance, generator, eta).float().cpu())
    return ((torch.cat(parts) + 1) / 2).clamp(0, 1).permute(0, 2, 3, 1).numpy()


@torch.no_grad()
def model_field(
    model: PoseModel | ExactModel, pairs: Pairs, radius: Tensor, grid: Grid, sigma: float | None = None
) -> FieldValue:
    """A model's scores `[B, A, O, 3]` and, for an energy model, energies `[B, A, O]`, at relative radii `[B]`.

    `sigma` defaults to the model's own; another value must be supported by the model.
    """
    features = model.encode(pairs.images)
    condition = model.condition(features[pairs.reference], features[pairs.query])[:, None, None]
    if sigma is not None and isinstance(model, PoseModel):
        condition = model.at_sigma(condition, sigma)
    return model.field(condition, grid_poses(radius.to(pairs.images.device), *grid))


def model_landscapes(
    model: PoseModel | ExactModel, pairs: Pairs, radius: Tensor, grid: Grid, sigma: float | None = None
) -> list[Landscape]:
    """A model's energy (for a score model, the score's length) over a grid for B pairs, at relative radii `[B]`."""
    score, energy = model_field(model, pairs, radius, grid, sigma)
    values = (score.norm(dim=-1) if energy is None else energy).cpu()
    return [Landscape(*grid, *each) for each in zip(radius.tolist(), values, strict=True)]


def model_arrows(model: PoseModel | ExactModel, pairs: Pairs, radius: Tensor, spacing: float) -> list[Arrows]:
    """A model's scores for B pairs on `cell_grid`, at relative radii `[B]`."""
    grid = cell_grid(spacing)
    return arrows(grid, model_field(model, pairs, radius, grid).score)


def arrows(grid: Grid, scores: Tensor) -> list[Arrows]:
    """Convert scores `[B, A, O, 3]` on a grid of latitudes and longitudes to arrays."""
    latitude, longitude = (each.rad2deg().numpy() for each in grid)
    return [Arrows(latitude, longitude, score) for score in scores.detach().cpu().numpy()]


def field_error(model: PoseModel, pairs: Pairs, truth: Tensor, spacing: float) -> float:
    """Relative error of a model's scores at the arrows of B pairs with true relative poses `[B, 3]`.

    The RMS distance to the exact scores divided by the RMS exact score, at the true radii.
    """
    exact, learned = (
        model_field(each, pairs, truth[:, 2], cell_grid(spacing)).score
        for each in (ExactModel(model.kernel, truth), model)
    )
    return float(((learned - exact).square().sum() / exact.square().sum()).sqrt())
