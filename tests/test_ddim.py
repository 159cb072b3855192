"""DDIM against closed forms: data of a single image, and Gaussian data."""

from __future__ import annotations

import pytest
import torch

from lp_framework.errors import UserError
from lp_framework.priors.ddim import ddim_sample, ddim_step, ddim_timesteps, guided, scaled_linear_alphas

ALPHAS = scaled_linear_alphas().double()


@pytest.mark.parametrize("eta", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("steps", [7, 50, 1000])
def test_where_the_data_is_one_image_every_path_leads_to_it(steps, eta):
    image = torch.tensor([[0.3, -1.2, 0.7]], dtype=torch.float64)

    def noise_in(latent, timestep):
        return (latent - ALPHAS[timestep].sqrt() * image) / (1 - ALPHAS[timestep]).sqrt()

    start = torch.randn(1, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    found = ddim_sample(noise_in, start, ALPHAS, steps, eta, torch.Generator().manual_seed(1))
    # The last timestep's own noise, of alpha_0, is left: sigma is 0.03.
    assert (found - image).abs().max() < 4 * (1 - ALPHAS[0]).sqrt()


@pytest.mark.parametrize("eta", [0.0, 1.0])
def test_gaussian_data_keeps_its_spread(eta):
    """The predictor that is right for data of N(2, 0.5^2); both the ODE and the SDE end in that distribution."""
    mean, spread = 2.0, 0.5

    def noise_in(latent, timestep):
        alpha = ALPHAS[timestep]
        return (1 - alpha).sqrt() * (latent - alpha.sqrt() * mean) / (alpha * spread**2 + 1 - alpha)

    first = ALPHAS[ddim_timesteps(200)[0]]  # where the data is not quite standard normal noise yet
    draw = torch.randn(1, 20_000, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    start = first.sqrt() * mean + (first * spread**2 + 1 - first).sqrt() * draw
    found = ddim_sample(noise_in, start, ALPHAS, 200, eta, torch.Generator().manual_seed(1))
    assert found.mean().item() == pytest.approx(mean, abs=0.02)
    assert found.std().item() == pytest.approx(spread, abs=0.02)


def test_a_step_with_all_its_noise_fresh_is_ancestral_sampling():
    """Eq. 12 with eta 1 is the posterior of Ho et al. 2020 (Eq. 6 and 7), at any two timesteps."""
    alpha, following = ALPHAS[600], ALPHAS[580]
    latent, noise = torch.tensor([0.4], dtype=torch.float64), torch.tensor([-0.9], dtype=torch.float64)
    image = (latent - (1 - alpha).sqrt() * noise) / alpha.sqrt()
    ratio = alpha / following
    mean = (following.sqrt() * (1 - ratio) * image + ratio.sqrt() * (1 - following) * latent) / (1 - alpha)
    variance = (1 - following) / (1 - alpha) * (1 - ratio)
    for fresh in (-1.0, 0.0, 2.0):
        step = ddim_step(latent, noise, alpha, following, 1.0, torch.tensor([fresh], dtype=torch.float64))
        torch.testing.assert_close(step, mean + variance.sqrt() * fresh)


def test_the_same_generator_gives_the_same_latents():
    once, again = (
        ddim_sample(
            lambda latent, _: latent, torch.ones(2, 3), ALPHAS.float(), 5, 1.0, torch.Generator().manual_seed(4)
        )
        for _ in range(2)
    )
    assert torch.equal(once, again)


def test_guidance_extrapolates_from_unconditional_to_conditional():
    free, conditional = torch.tensor([1.0, 2.0]), torch.tensor([2.0, 0.0])
    assert torch.equal(guided(free, conditional, 0.0), free)
    assert torch.equal(guided(free, conditional, 1.0), conditional)
    assert torch.equal(guided(free, conditional, 3.0), torch.tensor([4.0, -4.0]))


def test_invalid_settings():
    for steps in (0, -1, 1001):
        with pytest.raises(UserError, match=f"steps must lie between 1 and 1000, got {steps}"):
            ddim_timesteps(steps)
    assert ddim_timesteps(1000)[0] == 999 and len(ddim_timesteps(1000)) == 1000
    for eta in (-0.1, 1.1):
        with pytest.raises(UserError, match=rf"eta must lie in \[0, 1\], got {eta}"):
            ddim_sample(lambda latent, _: latent, torch.ones(1), ALPHAS, 5, eta, None)
