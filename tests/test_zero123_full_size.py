"""The published architecture with random weights (3.4 GB for the U-Net alone)."""

from __future__ import annotations

import os

import pytest
import torch

from lp_framework.priors.base import ViewCode
from lp_framework.priors.zero123.networks import PUBLISHED, Networks
from lp_framework.priors.zero123.prior import Zero123Prior

PARAMETERS = {  # Stable Diffusion 1's, 4 more input channels; its autoencoder; ViT-L/14; 772 x 768 and a bias
    **{"unet": 859_520_964 + 4 * 320 * 9, "vae": 83_653_863, "image_encoder": 303_966_208, "cc_projection": 593_664}
}


def test_parameter_counts():
    with torch.device("meta"):
        networks = Networks(PUBLISHED)
    counts = {name: sum(each.numel() for each in part.parameters()) for name, part in networks.named_children()}
    assert counts == PARAMETERS


@pytest.mark.heavy
@pytest.mark.slow
def test_the_full_size_runs_with_its_gradient():
    if os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") < 9e9:
        pytest.skip("needs 9 GB of free memory")
    torch.manual_seed(0)
    prior = Zero123Prior(Networks(PUBLISHED))
    assert (prior.image_size, prior.latent_shape, prior.num_timesteps) == (256, (4, 32, 32), 1000)
    code = prior.encode(torch.rand(2, 3, 256, 256) * 2 - 1)
    assert isinstance(code, ViewCode) and code.embedding.shape == (2, 1, 768)
    pose = torch.tensor([[0.2, 1.0, 0.1]], requires_grad=True)
    energy = prior.denoising_error(code[:1], code[1:], pose, torch.tensor([500]), torch.randn(1, 4, 32, 32))
    energy.sum().backward()
    assert energy.isfinite().all() and pose.grad.isfinite().all() and pose.grad.abs().max() > 0
