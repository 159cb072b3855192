"""The density of the relative pose in closed form, against numerical integrals, and its smoothing against finite
differences."""

import math

import pytest
import torch

from lp_framework.geometry import camera_to_world, rotation_error
from lp_framework.models.pose_density import GRID, PoseDensity, from_bins

TURN = 2 * math.pi


def some_density(sigma: float = 1.0, pairs: int = 3, seed: int = 0) -> PoseDensity:
    """Densities with several modes, float64."""
    random = torch.Generator().manual_seed(seed)
    logits = 2.0 * torch.randn(pairs, 36, generator=random)
    mean = 0.3 * torch.randn(pairs, 2, generator=random, dtype=torch.float64)
    return PoseDensity(from_bins(logits).double(), mean, torch.full((pairs, 2), 0.2, dtype=torch.float64), sigma)


def some_poses(count: int = 5) -> torch.Tensor:
    random = torch.Generator().manual_seed(1)
    return torch.rand(3, count, 3, generator=random, dtype=torch.float64) * torch.tensor([1.0, TURN, 1.0])


def test_log_density_integrates_to_one_and_meets_the_grid():
    density = some_density()
    longitudes = torch.linspace(0, TURN, 1441, dtype=torch.float64)[:-1]
    values = torch.stack([density.log_prob(each.expand(3)) for each in longitudes], dim=1)
    torch.testing.assert_close(values.exp().mean(dim=1) * TURN, torch.ones(3, dtype=torch.float64), rtol=2e-3, atol=0)
    on_grid = values[:, :: 1440 // GRID]
    expected = density.logits.log_softmax(dim=1) - math.log(TURN / GRID)
    torch.testing.assert_close(on_grid, expected, rtol=1e-6, atol=1e-6)


def test_from_bins_interpolates_the_bins():
    bins = torch.randn(4, 36, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(from_bins(bins)[:, :: GRID // 36], bins, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("sigma", [1.0, 0.3, 0.1])
def test_smoothed_energy_is_that_of_the_convolved_density(sigma: float):
    """Against the convolution as a sum over the grid with a wrapped Gaussian."""
    density, poses = some_density(sigma), some_poses()
    grid = torch.arange(GRID, dtype=torch.float64) * TURN / GRID
    turns = torch.arange(-4, 5, dtype=torch.float64) * TURN
    offset = poses[..., 1, None, None] - grid[:, None] - turns
    kernel = torch.exp(-0.5 * (offset / sigma) ** 2).sum(dim=-1) / (sigma * math.sqrt(TURN))
    longitude = (density.probabilities[:, None] * kernel).sum(dim=-1)
    variance = density.deviation[:, None] ** 2 + sigma**2
    rest = torch.distributions.Normal(density.mean[:, None], variance.sqrt()).log_prob(poses[..., ::2]).sum(dim=-1)
    _, energy = density[:, None].smoothed(poses)
    torch.testing.assert_close(energy, -longitude.log() - rest, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("sigma", [1.0, 0.2])
def test_score_is_minus_the_gradient_of_the_energy(sigma: float):
    density, poses = some_density(sigma)[:, None], some_poses().requires_grad_()
    score, energy = density.smoothed(poses)
    (gradient,) = torch.autograd.grad(energy.sum(), poses)
    torch.testing.assert_close(score, -gradient, rtol=1e-6, atol=1e-8)


def test_energy_is_periodic_in_the_longitude():
    density, poses = some_density(0.5)[:, None], some_poses()
    around = poses + torch.tensor([0.0, TURN, 0.0], dtype=torch.float64)
    for here, there in zip(density.smoothed(poses), density.smoothed(around), strict=True):
        torch.testing.assert_close(here, there, rtol=1e-9, atol=1e-9)


def test_modes_of_a_mixture_are_its_components_in_order_of_weight():
    """Two von Mises peaks, at 40 and 220 degrees, and no third."""
    grid = torch.arange(GRID, dtype=torch.float64) * TURN / GRID
    centres = torch.tensor([math.radians(40), math.radians(220)], dtype=torch.float64)
    mixture = (torch.tensor([0.3, 0.7]) * torch.exp(20 * (grid[:, None] - centres).cos())).sum(dim=1)
    density = PoseDensity(mixture.log()[None], torch.zeros(1, 2), torch.ones(1, 2))
    found = torch.rad2deg(density.modes(3))[0]
    torch.testing.assert_close(found, torch.tensor([220.0, 40.0, 220.0]).double(), rtol=0, atol=0.1)


def drawn_poses(density: PoseDensity, count: int) -> torch.Tensor:
    """Poses `[P, count, 3]` of the density, longitudes spread over the grid's steps, radius 1."""
    random = torch.Generator().manual_seed(4)
    places = density.probabilities.multinomial(count, replacement=True, generator=random)
    between = torch.rand(places.shape, generator=random, dtype=torch.float64) - 0.5
    longitude = (places + between) * TURN / GRID
    normal = torch.randn(places.shape, generator=random, dtype=torch.float64)
    latitude = density.mean[:, :1] + density.deviation[:, :1] * normal
    return torch.stack([latitude, longitude, torch.ones_like(latitude)], dim=-1)


@pytest.mark.parametrize("latitude", [-0.5, 0.0, 0.7])
@pytest.mark.parametrize("degrees", [10.0, 30.0, 90.0])
def test_probability_is_the_share_of_draws_whose_rotation_is_near(degrees: float, latitude: float):
    """Whatever the latitude of the reference."""
    density = some_density()
    modes = torch.stack([density.mean[:, 0], density.modes(1)[:, 0], density.mean[:, 1]], dim=-1)[:, None]
    poses = torch.cat([modes, some_poses(3) * torch.tensor([0.5, 1.0, 1.0])], dim=1)
    predicted = density[:, None].probability(poses, degrees)
    reference = torch.tensor([latitude, 1.0, 1.5], dtype=torch.float64)
    draws = camera_to_world(reference + drawn_poses(density, 40_000))
    error = rotation_error(draws[:, None], camera_to_world(reference + poses)[:, :, None])
    near = (error <= degrees).double().mean(dim=-1)
    torch.testing.assert_close(predicted, near, rtol=0, atol=0.012)
    assert predicted.shape == (3, 4) and (predicted.max() > 0.3 or degrees < 30)


def test_probability_within_any_rotation_is_one():
    density = some_density()
    torch.testing.assert_close(density[:, None].probability(some_poses(2), 180.0), torch.ones(3, 2).double())
