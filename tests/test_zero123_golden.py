"""Zero123 against the published implementations: every array of data/reference/zero123_tiny/golden.npz.

Source of the numbers: data/reference/README.md (published iFusion and Zero123 code, float32 on a CPU).
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from solver_problems import away
from zero123_checkpoint import golden, write_checkpoint

from lp_framework.geometry import camera_to_world, se3_exp, view_pose
from lp_framework.priors.base import ViewCode
from lp_framework.priors.ddim import ddim_timesteps
from lp_framework.priors.zero123 import prior as zero123
from lp_framework.priors.zero123.prior import SCALE, Zero123

SIGN = torch.tensor([-1.0, 1.0, 1.0])  # iFusion's (theta, azimuth, distance) has theta = -latitude


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return str(write_checkpoint(tmp_path_factory.mktemp("zero123")))


@pytest.fixture(scope="module")
def prior(checkpoint):
    return Zero123(checkpoint)


@pytest.fixture(scope="module")
def arrays():
    return {name: torch.from_numpy(value) for name, value in golden().items()}


@pytest.fixture(scope="module")
def code(prior, arrays) -> ViewCode:
    """Of the reference and the query."""
    return prior.encode(torch.cat([arrays["ref"], arrays["qry"]]))


def both_directions(prior, code, pose, timestep, noise):
    """Denoising errors `[B]` of poses `[B, 3]`, the mean over (query from reference) and (reference from query)."""
    count = len(pose)
    source, target = torch.tensor([0, 1]).repeat(count), torch.tensor([1, 0]).repeat(count)
    poses = torch.stack([pose, -pose], dim=1).flatten(0, 1)
    errors = prior.denoising_error(
        code[target], code[source], poses, timestep.repeat_interleave(2), noise.repeat(count, 1, 1, 1)
    )
    return errors.view(count, 2).mean(dim=1)


def close(actual, expected, within):
    torch.testing.assert_close(actual.double(), expected.double(), rtol=0, atol=within)


def test_schedule(prior, arrays):
    close(prior.alphas_cumprod, arrays["alphas_cumprod"], 1e-7)
    assert ddim_timesteps(5) == arrays["ddim_timesteps"].tolist()


def test_embeddings_and_latents(code, arrays):
    close(code.embedding, arrays["clip_embedding"], 1e-4)
    close(code.latent, arrays["latent_mode"], 1e-4)


def test_context(prior, code, arrays):
    pose = arrays["poses"].float() * SIGN
    for direction, sign in enumerate((1, -1)):  # from the reference; back from the query
        token = prior.token(code[torch.tensor([direction] * 3)].embedding, sign * pose)
        close(token, arrays["context"][:, direction], 1e-4)


def test_predicted_noise(prior, code, arrays):
    pose, noise = arrays["poses"].float() * SIGN, arrays["noise"]
    for direction, sign in enumerate((1, -1)):
        source, target = torch.tensor([direction] * 3), torch.tensor([1 - direction] * 3)
        drawn = noise[[direction] * 3]
        residual = prior.residual(code[target], code[source], sign * pose, arrays["timesteps"], drawn)
        close(residual + drawn, arrays["eps"][:, direction], 1e-4)


def test_loss_and_its_gradient(prior, code, arrays):
    pose = (arrays["poses"].float() * SIGN).requires_grad_()
    loss = both_directions(prior, code, pose, arrays["timesteps"], arrays["noise"])
    close(loss.detach(), arrays["loss"], 1e-4)
    loss.sum().backward()
    largest = arrays["grad"].abs().max().item()
    close(pose.grad * SIGN, arrays["grad"], 1e-3 * largest)


def test_loss_of_the_raw_weights(checkpoint, arrays):
    raw = Zero123(checkpoint, weights="raw")
    code = raw.encode(torch.cat([arrays["ref"], arrays["qry"]]))
    pose = arrays["poses"].float() * SIGN
    close(both_directions(raw, code, pose, arrays["timesteps"], arrays["noise"]), arrays["loss_raw"], 1e-4)


def test_ten_steps_of_ifusions_loop(prior, code, arrays):
    start = camera_to_world(torch.tensor([0.0, torch.pi / 2, 1.0]))
    twist = torch.zeros(6, requires_grad=True)  # translation first
    optimizer = torch.optim.Adam([twist], lr=0.1)
    scheduler = torch.optim.lr_scheduler.ReduceLROnPlateau(optimizer, factor=0.6, patience=10)
    trajectory, losses = [], []

    def pose() -> torch.Tensor:
        latitude, longitude, norm = view_pose(start @ se3_exp(twist)).unbind()
        return torch.stack([latitude, longitude, 0.8 * (norm - 1).sin()])

    for step in range(10):
        x = pose()
        trajectory.append(x.detach() * SIGN)
        timestep = torch.tensor([min(max(round((1 - step / 10) * 1000), 0), 999)])
        loss = both_directions(prior, code, x[None], timestep, arrays["noise"]).sum()
        losses.append(loss.item())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        scheduler.step(sum(losses))
    trajectory.append(pose().detach() * SIGN)
    for turn in (0.0, 2 * torch.pi):  # a published longitude may lie in any turn
        there = arrays["adam_traj"].float() + torch.tensor([0.0, turn, 0.0])
        assert away(torch.stack(trajectory), there).abs().max() < 1e-3
    close(torch.tensor(losses), arrays["adam_loss"], 1e-4)
    close(twist.detach(), arrays["adam_xi"], 1e-3)


def test_decoder(prior, arrays):
    close(prior.decode(arrays["latent_mode"][:1]), arrays["decoded_ref"], 2e-3)


def test_guided_sample(prior, code, arrays, monkeypatch):
    monkeypatch.setattr(zero123, "standard_normal", lambda *_: arrays["noise"][:1])
    decode, decoded = prior.decode, []
    monkeypatch.setattr(prior, "decode", lambda latent: decoded.append(latent) or decode(latent))
    images = prior.generate(code[:1], arrays["poses"][:1].float() * SIGN, steps=5, guidance=3.0, eta=0.0)
    close(decoded[0] * SCALE, arrays["ddim_latent"], 2e-3)
    close(images, arrays["ddim_image"].clamp(-1, 1), 2e-3)
    assert np.isclose(SCALE, 0.18215)
