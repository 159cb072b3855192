"""The tiny prior: its mathematics, its training, its folder, and what the shipped weights can do."""

from __future__ import annotations

import json
import math
import re

import pytest
import torch
from tiny_runs import Commands, Ran

import lp_framework
from lp_framework.errors import UserError
from lp_framework.models.view_head import SCALE
from lp_framework.priors.ddim import scaled_linear_alphas
from lp_framework.priors.tiny.networks import (
    CONSTANT,
    IMAGE_SIZE,
    Gaussian,
    PrincipalLatents,
    code_dim,
    predicted_noise,
    readout,
    steer,
)
from lp_framework.registry import discover

PRIOR = ("model=prior", "model.latent_dim=6", "model.width=16", "model.layers=1", "model.orders=2")


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


# ---------------------------------------------------------------- latents


def test_latents_are_principal_components():
    pixels = draw(40, 3 * IMAGE_SIZE**2) + 3
    latents = PrincipalLatents(dim=8, scale=0.5).double()
    assert not latents.spread.any()
    latents.fit(pixels)
    assert latents.spread.any()
    values = latents(pixels)
    torch.testing.assert_close(values.mean(dim=0), torch.zeros(8).double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(values.square().mean().sqrt(), torch.tensor(0.5).double(), atol=1e-5, rtol=0)
    covariance = values.T @ values / len(values)
    torch.testing.assert_close(covariance, latents.spread.square().diag(), atol=1e-6, rtol=0)
    assert (latents.spread.diff() <= 0).all()
    gram = latents.basis.T @ latents.basis
    torch.testing.assert_close(gram, gram[0, 0] * torch.eye(8).double(), atol=1e-6, rtol=0)  # orthogonal


def test_fewer_images_than_components_leave_the_rest_at_zero():
    latents = PrincipalLatents(dim=8, scale=1.0)
    latents.fit(draw(4, 3 * IMAGE_SIZE**2).float())
    assert latents.spread[3:].abs().max() == 0 and (latents.basis[:, 3:] == 0).all() and latents.basis.isfinite().all()


# ---------------------------------------------------------------- steering


def test_steering_is_an_action_of_the_poses():
    code, first, second = draw(5, code_dim(3)), draw(5, 3, seed=1), draw(5, 3, seed=2)
    twice = steer(steer(code, first, 3), second, 3)
    torch.testing.assert_close(twice, steer(code, first + second, 3))
    torch.testing.assert_close(steer(code, torch.zeros_like(first), 3), code)
    turn = first + torch.tensor([0.0, 2 * math.pi, 0.0], dtype=torch.float64)
    torch.testing.assert_close(steer(code, turn, 3), steer(code, first, 3))


def test_steering_moves_what_is_read_out_by_the_relative_pose():
    code, pose = draw(7, code_dim(2)), draw(7, 3, seed=1)
    before, after = readout(code, 2), readout(steer(code, pose, 2), 2)
    phase = torch.complex(after[:, 0], after[:, 1]) / torch.complex(before[:, 0], before[:, 1])
    torch.testing.assert_close(phase, torch.polar(torch.ones(7).double(), pose[:, 1]))
    torch.testing.assert_close(after[:, 2:] - before[:, 2:], pose[:, ::2] * torch.tensor(SCALE).double())
    torch.testing.assert_close(steer(code, pose, 2)[:, :CONSTANT], code[:, :CONSTANT])


# ---------------------------------------------------------------- the denoiser


@pytest.mark.parametrize("timestep", [0, 99, 500, 999])
def test_the_predicted_noise_is_the_conditional_expectation(timestep):
    """Against regression on draws: of all linear predictors of the noise from z the closed form has the least error."""
    alpha = scaled_linear_alphas()[timestep].double()
    mean, spread = 0.7, 0.4
    clean, noise = mean + spread * draw(400_000), draw(400_000, seed=1)
    noisy = alpha.sqrt() * clean + (1 - alpha).sqrt() * noise
    inputs = torch.stack([noisy, torch.ones_like(noisy)], dim=1)
    fitted = inputs @ torch.linalg.lstsq(inputs, noise[:, None]).solution
    predicted = predicted_noise(noisy, alpha, Gaussian(torch.tensor(mean), torch.tensor(spread).log()))
    torch.testing.assert_close(predicted, fitted[:, 0], atol=0.02, rtol=0)


# ---------------------------------------------------------------- training and use


@pytest.fixture(scope="module")
def commands(tmp_path_factory) -> Commands:
    return Commands(tmp_path_factory.mktemp("prior"))


@pytest.fixture(scope="module")
def trained(commands) -> Ran:
    """A prior after three epochs on a few views."""
    ran = commands.here("prior", "train", *PRIOR, "data.image_size=64", "model.schedule=constant")
    assert ran.status == 0, ran.err
    return ran


@pytest.fixture
def prior(commands, trained, clean_registry):
    discover([commands.folder / "plugins"])
    return lp_framework.load_prior("tiny", path=str(trained.folder))


def test_training_lowers_the_loss_and_says_what_is_next(trained):
    history = (trained.folder / "metrics.csv").read_text().splitlines()
    column = history[0].split(",").index("val/loss")
    losses = [float(row.split(",")[column]) for row in history[1:] if row.split(",")[column]]
    assert len(losses) == 3 and losses[-1] < losses[0]
    assert f"views prior.path={trained.folder.name}" in trained.out


def test_it_trains_in_mixed_precision(commands):
    ran = commands.here("mixed", "train", *PRIOR, "trainer.precision=bf16-mixed", "trainer.max_epochs=1")
    assert ran.status == 0, ran.err
    assert 0 < ran.json("training.json")["final"]["val/loss"] < 10


def test_a_backbone_may_be_trained_along(commands):
    ran = commands.here("along", "train", *PRIOR, "data.image_size=64", "backbone.frozen=false", "trainer.max_epochs=1")
    assert ran.status == 0, ran.err
    assert any(key.startswith("backbone.net") for key in ran.checkpoint()["state_dict"])


def test_a_resumed_training_ends_where_an_uninterrupted_one_does(commands, trained):
    first = commands.here(
        "first", "train", *PRIOR, "data.image_size=64", "trainer.max_epochs=2", "model.schedule=constant"
    )
    again = commands.here("again", "train", f"resume={first.folder.name}", "trainer.max_epochs=3")
    assert first.status == again.status == 0, again.err
    expected, resumed = trained.checkpoint()["state_dict"], first.checkpoint()["state_dict"]
    assert all(torch.equal(expected[key], resumed[key]) for key in expected)


def test_the_denoising_error_is_differentiable_in_the_pose(prior):
    images = torch.rand(4, 3, 40, 40, generator=torch.Generator().manual_seed(0)) * 2 - 1
    code = prior.encode(images)
    pose = (0.3 * draw(2, 3)).float().requires_grad_()
    noise, timestep = draw(2, *prior.latent_shape).float(), torch.tensor([50, 700])

    def energy(pose: torch.Tensor) -> torch.Tensor:
        return prior.denoising_error(code[:2], code[2:], pose, timestep, noise)

    (gradient,) = torch.autograd.grad(energy(pose).sum(), pose)
    for axis in range(3):
        step = 1e-2 * torch.eye(3)[axis]
        slope = (energy(pose + step) - energy(pose - step)) / 2e-2
        torch.testing.assert_close(slope.detach(), gradient[:, axis], atol=2e-4, rtol=2e-2)
    _, tangent = torch.func.jvp(energy, (pose.detach(),), (torch.ones(2, 3),))
    torch.testing.assert_close(tangent, gradient.sum(dim=1), atol=1e-5, rtol=1e-4)


def test_views_are_reproducible_and_seen_from_the_pose(prior):
    code = prior.encode(torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0)) * 2 - 1)
    pose = torch.tensor([[0.0, 1.0, 0.0], [0.2, 4.0, 0.1]])

    def views(seed: int, **settings: float) -> torch.Tensor:
        return prior.generate(code, pose, steps=10, generator=torch.Generator().manual_seed(seed), **settings)

    first = views(0)
    assert first.shape == (2, 3, IMAGE_SIZE, IMAGE_SIZE) and first.abs().max() <= 1
    assert torch.equal(first, views(0)) and not torch.equal(first, views(1))
    assert not torch.equal(first, views(0, guidance=1.0))
    with pytest.raises(UserError, match="guidance must not be negative"):
        views(0, guidance=-1.0)


# ---------------------------------------------------------------- folders


def test_a_converted_run_is_the_same_prior(commands, trained, prior):
    converted = commands.here("convert", "convert", f"path={trained.folder}", "output=folder", "dtype=float32")
    assert converted.status == 0 and "prior.path=folder" in converted.out, converted.err
    folder = commands.folder / "folder"
    assert {file.name for file in folder.iterdir()} >= {"model.json", "model.safetensors", "config.yaml", "metrics.csv"}
    again = lp_framework.load_prior("tiny", path=str(folder))
    images = torch.rand(2, 3, 64, 64) * 2 - 1
    assert torch.equal(prior.encode(images).latent, again.encode(images).latent)
    for file, content, message in (
        ("model.json", "{}", "model.json: is not the description of a trained model"),
        ("model.json", None, "model.json: there is no such file"),
        ("model.safetensors", "text", "model.safetensors: is not a readable file of weights"),
    ):
        kept = (folder / file).read_bytes()
        (folder / file).unlink()
        if content is not None:
            (folder / file).write_text(content)
        if file == "model.json" or content is not None:
            with pytest.raises(UserError, match=message):
                lp_framework.load_prior("tiny", path=str(folder))
        (folder / file).write_bytes(kept)
    description = json.loads((folder / "model.json").read_text())
    (folder / "model.json").write_text(json.dumps({**description, "trunk": "other"}))
    with pytest.raises(UserError, match="other weights here than when the model was trained"):
        lp_framework.load_prior("tiny", path=str(folder))


def test_a_pose_model_is_no_prior_and_a_prior_no_pose_model(commands, trained, prior):
    with pytest.raises(UserError, match=re.escape("use it with prior=tiny prior.path=")):
        lp_framework.load_model(trained.folder)
    score = commands.here("score", "train", "trainer.max_epochs=1")
    with pytest.raises(UserError, match=re.escape("use it with checkpoint=")):
        lp_framework.load_prior("tiny", path=str(score.folder))
