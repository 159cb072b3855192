"""The perturbation kernel, its two targets, and how the noised pose is drawn."""

from __future__ import annotations

import math

import pytest
import torch
from scipy import stats

from lp_framework import registry
from lp_framework.errors import UserError
from lp_framework.models.objectives import TURN, NoisedPose, PoseKernel
from lp_framework.models.pose_model import HIGH, LOW

SIGMAS = [0.2, 0.5, 1.0, 2.5]


def poses(count: int, seed: int = 0) -> torch.Tensor:
    """Relative poses, float64, longitudes over three turns."""
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return (unit - 0.5) * torch.tensor([2.0, 3 * TURN, 1.6], dtype=torch.float64)


@pytest.mark.parametrize("target", ["line", "periodic"])
@pytest.mark.parametrize("sigma", SIGMAS)
def test_score_is_minus_the_gradient_of_the_energy(target, sigma):
    kernel = PoseKernel(target, sigma)
    noised, true = poses(200).requires_grad_(), poses(200, seed=1)
    (gradient,) = torch.autograd.grad(kernel.energy(noised, true).sum(), noised)
    torch.testing.assert_close(kernel.score(noised, true), -gradient, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("sigma", SIGMAS)
def test_line_is_the_closed_form_of_the_paper(sigma):
    kernel, noised, true = PoseKernel("line", sigma), poses(50), poses(50, seed=1)
    torch.testing.assert_close(kernel.score(noised, true), (true - noised) / sigma**2)
    torch.testing.assert_close(kernel.energy(noised, true), (noised - true).square().sum(-1) / (2 * sigma**2))


@pytest.mark.parametrize("sigma", SIGMAS)
def test_periodic_is_the_sum_over_all_images_of_the_truth(sigma):
    noised, true = poses(100), poses(100, seed=1)
    offset = noised - true
    images = offset[:, 1:2] + TURN * torch.arange(-60, 61, dtype=torch.float64)
    density = torch.exp(-images.square() / (2 * sigma**2))
    kernel = PoseKernel("periodic", sigma)
    plane = offset[:, ::2].square().sum(-1) / (2 * sigma**2)
    torch.testing.assert_close(kernel.energy(noised, true), plane - density.sum(-1).log(), rtol=1e-9, atol=1e-9)
    longitude = -(density * images).sum(-1) / density.sum(-1) / sigma**2
    score = kernel.score(noised, true)
    torch.testing.assert_close(score[:, 1], longitude, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(score[:, ::2], -offset[:, ::2] / sigma**2)


@pytest.mark.parametrize("turns", [(1, 0), (0, 1), (-3, 2)])
def test_periodic_repeats_every_turn_in_both_arguments(turns):
    kernel, noised, true = PoseKernel("periodic"), poses(100), poses(100, seed=1)
    longitude = torch.tensor([0.0, TURN, 0.0], dtype=torch.float64)
    moved = [pose + turn * longitude for pose, turn in zip((noised, true), turns, strict=True)]
    for quantity in (kernel.energy, kernel.score):
        torch.testing.assert_close(quantity(*moved), quantity(noised, true), rtol=1e-9, atol=1e-9)
    line = PoseKernel("line")
    assert (line.score(*moved) - line.score(noised, true)).abs().max() > 6


@pytest.mark.parametrize("sigma", [0.5, 1.0])
def test_periodic_is_smooth_through_the_antipode_where_its_score_vanishes(sigma):
    kernel = PoseKernel("periodic", sigma)
    around = torch.linspace(math.pi - 1e-3, math.pi + 1e-3, 2001, dtype=torch.float64)
    noised = torch.stack([torch.zeros_like(around), around, torch.zeros_like(around)], -1)
    score = kernel.score(noised, torch.zeros(3, dtype=torch.float64))[:, 1]
    # A step is 1e-6 rad, and the slope at the antipode is (pi / sigma^2)^2 - 1 / sigma^2: no jump of 2 pi / sigma^2.
    slope = (math.pi / sigma**2) ** 2 - 1 / sigma**2
    torch.testing.assert_close(score.diff() / 1e-6, torch.full((2000,), slope, dtype=torch.float64), rtol=1e-2, atol=0)
    assert score[1000].abs() < 1e-9
    torch.testing.assert_close(score, -score.flip(0), rtol=0, atol=1e-9)


def test_periodic_equals_line_where_one_image_dominates():
    true = poses(100, seed=1)
    noised = true + (poses(100) * 0.1)  # longitudes less than one radian away, at sigma 0.2
    assert (noised - true)[:, 1].abs().max() < 1
    line, periodic = PoseKernel("line", 0.2), PoseKernel("periodic", 0.2)
    torch.testing.assert_close(periodic.score(noised, true), line.score(noised, true))
    torch.testing.assert_close(periodic.energy(noised, true), line.energy(noised, true))


def test_kernel_keeps_batch_shapes_and_dtype():
    kernel = PoseKernel("periodic")
    noised, true = torch.zeros(4, 1, 3), torch.zeros(5, 3)
    assert kernel.score(noised, true).shape == (4, 5, 3)
    assert kernel.energy(noised, true).shape == (4, 5)
    assert kernel.score(noised, true).dtype == torch.float32


def test_uniform_noise_fills_the_box_evenly_whatever_the_truth():
    noise = NoisedPose("uniform", 1.0, LOW, HIGH)
    true = torch.full((20_000, 3), 0.7)
    drawn = noise.draw(true, torch.Generator().manual_seed(1))
    for axis, (low, high) in enumerate(zip(LOW, HIGH, strict=True)):
        values = drawn[:, axis].numpy()
        assert stats.kstest(values, stats.uniform(low, high - low).cdf).pvalue > 1e-3
    correlation = torch.corrcoef(drawn.T) - torch.eye(3)
    assert correlation.abs().max() < 0.03


@pytest.mark.parametrize("sigma", [0.5, 1.0])
def test_gaussian_noise_lies_around_the_truth(sigma):
    noise = NoisedPose("gaussian", sigma, LOW, HIGH)
    true = poses(20_000).float()
    offset = noise.draw(true, torch.Generator().manual_seed(0)) - true
    for axis in range(3):
        assert stats.kstest(offset[:, axis].numpy(), stats.norm(0, sigma).cdf).pvalue > 1e-3
    assert (torch.corrcoef(offset.T) - torch.eye(3)).abs().max() < 0.03


@pytest.mark.parametrize("noise", ["uniform", "gaussian"])
def test_noise_depends_on_the_generator_alone(noise):
    noised_pose, true = NoisedPose(noise, 1.0, LOW, HIGH), torch.zeros(10, 3)
    first, again, other = (noised_pose.draw(true, torch.Generator().manual_seed(seed)) for seed in (3, 3, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def score(**settings):
    return registry.build("model", {"name": "score", **settings}, backbone=torch.nn.Identity())


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: score(target="perodic"), "target=perodic .* did you mean 'periodic'"),
        (lambda: PoseKernel("line", 0.0), "sigma must be above 0, got 0.0"),
        (lambda: PoseKernel("line", math.nan), "sigma must be above 0, got nan"),
        (lambda: score(noise="gauss"), "noise=gauss .* did you mean 'gaussian'"),
        (lambda: NoisedPose("uniform", 1.0, LOW[:2], HIGH), "three numbers each"),
        (lambda: NoisedPose("uniform", 1.0, LOW, LOW), "every low below its high"),
    ],
)
def test_bad_settings_are_named(build, message):
    with pytest.raises(UserError, match=message):
        build()
