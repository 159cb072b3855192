"""The exact prior that solvers are tested with has the minima, the period and the derivatives that it claims."""

from __future__ import annotations

import math

import pytest
import torch
from exact_prior import ExactPrior, image_of

from lp_framework.errors import UserError

TRUTH = torch.tensor([0.2, 2.5, -0.1], dtype=torch.float64)  # query minus reference


REFERENCE = torch.tensor([0.1, 5.0, 1.5], dtype=torch.float64)


def energies(prior, pose, noise=None):
    """E `[B]` of poses `[B, 3]`, float64."""
    codes = prior.encode(image_of(torch.stack([REFERENCE, REFERENCE + TRUTH])))
    count = len(pose)
    noise = torch.zeros(count, 3, 1, 1, dtype=torch.float64) if noise is None else noise
    index = torch.zeros(count, dtype=torch.int64)
    return prior.denoising_error(codes[index + 1], codes[index], pose, torch.full((count,), 500), noise)


def along_longitude(prior, count=720):
    longitude = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    pose = TRUTH.repeat(count, 1)
    pose[:, 1] += longitude
    return longitude, energies(prior, pose)


@pytest.mark.parametrize("minima", [1, 2, 3, 4])
def test_it_has_the_requested_minima(minima):
    offsets = [2 * math.pi * k / minima for k in range(minima)]
    longitude, energy = along_longitude(ExactPrior(offsets))
    lowest = (energy < energy.roll(1)) & (energy < energy.roll(-1))
    torch.testing.assert_close(longitude[lowest], torch.tensor(offsets, dtype=torch.float64), rtol=0, atol=1e-6)
    torch.testing.assert_close(energy[lowest], torch.zeros(minima, dtype=torch.float64), rtol=0, atol=1e-12)


def test_the_second_minimum_may_be_shallower():
    longitude, energy = along_longitude(ExactPrior([0.0, math.pi], depths=[0.0, 0.3]))
    lowest = (energy < energy.roll(1)) & (energy < energy.roll(-1))
    assert lowest.sum() == 2 and longitude[energy.argmin()] == 0
    torch.testing.assert_close(energy[360], torch.tensor(0.5 * 2 * 0.3, dtype=torch.float64))


def test_the_closed_form_and_its_period():
    prior = ExactPrior([0.0, 2.0], stiffness=3.0)
    away = torch.tensor([[0.3, 0.7, -0.2]], dtype=torch.float64)
    expected = 1.5 * (0.3**2 + 0.2**2) + 1.5 * (1 - math.cos(0.7)) * (1 - math.cos(0.7 - 2.0))
    turned = away + torch.tensor([0, 2 * math.pi, 0], dtype=torch.float64)
    for each in (away, turned, away - 3 * (turned - away)):
        torch.testing.assert_close(energies(prior, TRUTH + each), torch.tensor([expected], dtype=torch.float64))


@pytest.mark.parametrize("depths", [(0.0, 0.0), (0.0, 0.3)])
def test_its_derivatives(depths):
    prior = ExactPrior([0.0, math.pi], depths)
    pose = (TRUTH + torch.tensor([[0.3, 0.7, -0.2], [0.0, 3.3, 0.1]], dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: energies(prior, x), pose, check_forward_ad=True)
    at_the_truth = TRUTH[None].clone().requires_grad_()
    energies(prior, at_the_truth).sum().backward()
    assert at_the_truth.grad.abs().max() < 1e-9


def test_noise_shifts_the_landscape():
    noise = torch.zeros(1, 3, 1, 1, dtype=torch.float64)
    noise[0, 0] = 2.0
    shifted = TRUTH - torch.tensor([0, 0.5 * 2.0, 0], dtype=torch.float64)
    assert energies(ExactPrior(noisy=0.5), shifted[None], noise).item() == pytest.approx(0, abs=1e-12)


def test_generated_images_are_those_of_the_pose():
    prior = ExactPrior()
    reference, relative = torch.tensor([[0.1, 5.0, 1.5]]), torch.tensor([[0.2, 1.0, 0.3]])
    image = prior.generate(prior.encode(image_of(reference)), relative)
    torch.testing.assert_close(prior.encode(image).latent.flatten(1), reference + relative)


def test_bad_depths():
    with pytest.raises(UserError, match="one depth"):
        ExactPrior([0.0, 1.0], [0.0])
