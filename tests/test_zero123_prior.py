"""Zero123 as a prior: its contract, and equal results for all speed settings."""

from __future__ import annotations

import copy

import pytest
import torch
from zero123_checkpoint import write_checkpoint

from lp_framework.analysis.confidence import answers_by_prior, denoising_errors
from lp_framework.errors import UserError
from lp_framework.priors.ddim import ddim_step, ddim_timesteps, scaled_linear_alphas
from lp_framework.priors.zero123.prior import Chunks, Zero123, conditioning_vector
from lp_framework.solvers.base import Pairs

SIDE = 8  # of the latents in tests where any will do: the networks are convolutional


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    return str(write_checkpoint(tmp_path_factory.mktemp("zero123")))


@pytest.fixture(scope="module")
def prior(checkpoint):
    return small(Zero123(checkpoint))


def small(prior: Zero123) -> Zero123:
    """The same prior for latents of 8 x 8, that is images of 64 x 64."""
    prior.latent_shape, prior.image_size = (4, SIDE, SIDE), 8 * SIDE
    return prior


@pytest.fixture(scope="module")
def problem(prior):
    """Arguments of `residual` for five poses between two images."""
    generator = torch.Generator().manual_seed(0)
    code = prior.encode(torch.rand(2, 3, 64, 64, generator=generator) * 2 - 1)
    pose = torch.randn(5, 3, generator=generator)
    timestep = torch.tensor([3, 200, 400, 600, 990])
    return (code[torch.tensor([0, 1, 1, 0, 0])], code[torch.tensor([1, 0, 0, 1, 1])], pose, timestep,
            torch.randn(5, 4, SIDE, SIDE, generator=generator))  # fmt: skip


def energies_and_slopes(prior, target, source, pose, timestep, noise):
    pose = pose.clone().requires_grad_()
    energies = prior.denoising_error(target, source, pose, timestep, noise)
    (energies * torch.arange(1, len(pose) + 1)).sum().backward()
    return energies.detach(), pose.grad


def close(actual, expected, within=1e-5):
    torch.testing.assert_close(actual, expected, rtol=0, atol=within * max(1e-9, expected.abs().max().item()))


# ---------------------------------------------------------------- contract


def test_conditioning_vector():
    pose = torch.tensor([[0.3, 1.2, -0.4], [-0.2, 5.0, 0.1]], dtype=torch.float64)
    expected = [[-0.3, 0.9320390860, 0.3623577545, -0.4], [0.2, -0.9589242747, 0.2836621855, 0.1]]
    torch.testing.assert_close(conditioning_vector(pose), torch.tensor(expected, dtype=torch.float64))


def test_the_energy_is_periodic_in_the_longitude(prior, problem):
    target, source, pose, timestep, noise = problem
    turned = pose + torch.tensor([0, 2 * torch.pi, 0])
    close(prior.residual(target, source, turned, timestep, noise), prior.residual(*problem))


def test_the_energy_is_the_mean_square_of_the_residual(prior, problem):
    energy = prior.denoising_error(*problem)
    close(energy, prior.residual(*problem).square().mean(dim=(1, 2, 3)))
    slopes = energies_and_slopes(prior, *problem)
    close(slopes[0], energy)


def test_the_gradient_is_that_of_the_residual(prior, problem):
    target, source, pose, timestep, noise = problem
    pose = pose.clone().requires_grad_()
    energy = prior.residual(target, source, pose, timestep, noise).square().mean(dim=(1, 2, 3))
    (energy * torch.arange(1, 6)).sum().backward()
    close(energies_and_slopes(prior, *problem)[1], pose.grad, 1e-4)


def test_each_energy_is_its_own(prior, problem):
    whole = prior.denoising_error(*problem)
    for row in range(5):
        (alone,) = prior.denoising_error(*(part[row : row + 1] for part in problem))
        close(alone, whole[row])


def test_forward_mode_agrees_with_backward_mode(prior, problem):
    target, source, pose, timestep, noise = problem
    direction = torch.randn(pose.shape, generator=torch.Generator().manual_seed(1))

    def residual(x):
        return prior.residual(target, source, x, timestep, noise)

    def energy(x):
        return prior.denoising_error(target, source, x, timestep, noise)

    value, tangent = torch.func.jvp(residual, (pose,), (direction,))
    close(value, residual(pose))
    x = pose.clone().requires_grad_()
    weight = torch.randn(value.shape, generator=torch.Generator().manual_seed(2))
    (slope,) = torch.autograd.grad((residual(x) * weight).sum(), x)
    close((tangent * weight).flatten(1).sum(1), (slope * direction).sum(1), 1e-4)
    _, slopes = torch.func.jvp(energy, (pose,), (direction,))
    (gradient,) = torch.autograd.grad(energy(x).sum(), x)
    close(slopes, (gradient * direction).sum(1), 1e-4)
    close(torch.func.grad(lambda each: energy(each).sum())(pose), gradient, 1e-4)


def test_a_second_derivative_is_an_error_not_zero(prior, problem):
    target, source, pose, timestep, noise = problem
    pose = pose.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(
        prior.denoising_error(target, source, pose, timestep, noise).sum(), pose, create_graph=True
    )
    with pytest.raises(RuntimeError):
        gradient.sum().backward()


def test_a_prior_is_frozen(prior, problem):
    assert not any(parameter.requires_grad for parameter in prior.parameters())
    prior.train()
    assert not any(module.training for module in prior.modules())
    energies_and_slopes(prior, *problem)
    assert all(parameter.grad is None for parameter in prior.parameters())


def test_a_code_is_indexed_like_a_batch(prior):
    images = torch.rand(3, 3, 64, 64) * 2 - 1
    code = prior.encode(images)
    assert code.latent.shape == (3, 4, SIDE, SIDE) and code.embedding.shape == (3, 1, 768)
    assert len(code) == 3 and len(code[1:]) == 2
    picked = code[torch.tensor([2, 0, 2])]
    assert torch.equal(picked.latent[0], code.latent[2]) and torch.equal(picked.embedding[1], code.embedding[0])
    close(prior.encode(images[1:2]).latent, code.latent[1:2])
    assert prior.encode(torch.rand(1, 3, 90, 120)).latent.shape == (1, 4, SIDE, SIDE)


@pytest.mark.parametrize(
    ("position", "name"), [(0, "target"), (1, "source"), (2, "pose"), (3, "timestep"), (4, "noise")]
)
def test_arguments_that_do_not_fit_are_named(prior, problem, position, name):
    arguments = list(problem)
    arguments[position] = torch.zeros(5, 2) if name == "pose" else arguments[position][:3]
    with pytest.raises(UserError, match=name):
        prior.residual(*arguments)


def test_other_bad_arguments(prior, problem, checkpoint):
    target, source, pose, timestep, noise = problem
    with pytest.raises(UserError, match="integers from 0 to 999"):
        prior.residual(target, source, pose, timestep.float(), noise)
    with pytest.raises(UserError, match="integers from 0 to 999"):
        prior.denoising_error(target, source, pose, timestep + 500, noise)
    with pytest.raises(UserError, match=r"images must be \[B, 3, H, W\]"):
        prior.encode(torch.zeros(3, 64, 64))
    with pytest.raises(UserError, match="max_batch"):
        Zero123(checkpoint, max_batch=0)
    with pytest.raises(UserError, match="steps"):
        prior.generate(source, pose, steps=0)
    with pytest.raises(UserError, match="eta"):
        prior.generate(source, pose, eta=2.0)


# ---------------------------------------------------------------- speed


def test_attention_over_one_token_needs_no_query(prior, problem):
    """The short cut against diffusers' own attention, and that the query does not matter there either."""
    from diffusers.models.attention_processor import AttnProcessor2_0

    plain = copy.deepcopy(prior)
    plain.unet.set_attn_processor(AttnProcessor2_0())
    expected = energies_and_slopes(plain, *problem)
    for actual, wanted in zip(energies_and_slopes(prior, *problem), expected, strict=True):
        close(actual, wanted, 1e-4)
    for name, module in plain.unet.named_modules():
        if name.endswith("attn2"):
            module.to_q.weight.mul_(-3)
    close(plain.residual(*problem), prior.residual(*problem))


@pytest.mark.parametrize("settings", [{"channels_last": True}, {"attention": "math"}, {"max_batch": 2}])
def test_speed_settings_do_not_change_results(prior, problem, checkpoint, settings):
    other = small(Zero123(checkpoint, **settings))
    for actual, wanted in zip(energies_and_slopes(other, *problem), energies_and_slopes(prior, *problem), strict=True):
        close(actual, wanted, 1e-4)
    close(other.residual(*problem), prior.residual(*problem), 1e-4)


@pytest.mark.heavy
@pytest.mark.slow
def test_the_compiled_network_gives_the_same_numbers(prior, problem, checkpoint):
    other = small(Zero123(checkpoint, compile=True))
    for actual, wanted in zip(energies_and_slopes(other, *problem), energies_and_slopes(prior, *problem), strict=True):
        close(actual, wanted, 1e-4)


@pytest.mark.parametrize("dtype", ["bfloat16", "float16"])
def test_half_precision_keeps_energies_and_gradients(prior, problem, checkpoint, dtype):
    other = small(Zero123(checkpoint, dtype=dtype))
    energies, slopes = energies_and_slopes(other, *problem)
    wanted, wanted_slopes = energies_and_slopes(prior, *problem)
    assert energies.dtype == slopes.dtype == torch.float32
    close(energies, wanted, 0.02)
    assert torch.cosine_similarity(slopes.flatten(), wanted_slopes.flatten(), dim=0) > 0.99


def test_chunks_halve_when_memory_runs_out():
    def fits(part: slice) -> slice:
        if part.stop - part.start > 3:
            raise torch.cuda.OutOfMemoryError("out of memory")
        return part

    chunks = Chunks(None)
    parts = chunks.run(fits, 11)
    assert [(part.start, part.stop) for part in parts] == [(0, 2), (2, 4), (4, 6), (6, 8), (8, 10), (10, 11)]
    assert chunks.size == 2

    def never(part: slice) -> slice:
        raise torch.cuda.OutOfMemoryError("out of memory")

    with pytest.raises(torch.cuda.OutOfMemoryError):
        chunks.run(never, 11)


def test_the_gradient_keeps_the_memory_of_one_chunk(prior, problem):
    """A forward pass keeps no activations of the network."""
    target, source, pose, timestep, noise = problem
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda tensor: kept.append(tensor.numel()) or tensor, lambda x: x):
        pose = pose.clone().requires_grad_()
        energies = prior.denoising_error(target, source, pose, timestep, noise)
    kept.clear()
    node = energies.grad_fn
    assert sum(tensor.numel() for tensor in node.saved_tensors) == pose.numel()


# ---------------------------------------------------------------- novel views


def test_generated_views_repeat_with_the_generator(prior, problem):
    _, source, pose, _, _ = problem

    def views(seed, order=(0, 1), **settings):
        generator = torch.Generator().manual_seed(seed)
        return prior.generate(source[torch.tensor(order)], pose[list(order)], 3, generator=generator, **settings)

    first = views(0)
    assert first.shape == (2, 3, 64, 64) and first.abs().max() <= 1
    assert torch.equal(first, views(0)) and not torch.equal(first, views(1))
    close(views(0, order=(2, 1, 0))[1:], first.flip(0), 1e-3)  # whatever is generated beside it
    assert not torch.equal(first, views(0, eta=0.0)) and not torch.equal(first, views(0, guidance=1.0))
    prior.chunks.size = 1
    try:
        close(views(0), first, 1e-3)
    finally:
        prior.chunks.size = None


def test_ddim_with_the_true_noise_finds_the_image():
    """Without fresh noise, and the noise of x_t known, every step stays on the line between image and noise."""
    alphas = scaled_linear_alphas().double()
    generator = torch.Generator().manual_seed(0)
    image, noise = torch.randn(2, 1, 4, 2, 2, dtype=torch.float64, generator=generator)
    timesteps = ddim_timesteps(50)
    assert timesteps[0] == 981 and timesteps[-1] == 1 and len(timesteps) == 50
    latent = alphas[981].sqrt() * image + (1 - alphas[981]).sqrt() * noise
    for step, following in zip(timesteps, [*timesteps[1:], 0], strict=True):
        latent = ddim_step(latent, noise, alphas[step], alphas[following], 0.0, torch.zeros_like(latent))
    torch.testing.assert_close(latent, alphas[0].sqrt() * image + (1 - alphas[0]).sqrt() * noise)


def test_ddim_with_eta_one_has_the_variance_of_the_posterior():
    """Eq. 16 at eta 1 is DDPM's beta-tilde_t; the mean of the step does not depend on the fresh noise."""
    alphas = scaled_linear_alphas().double()
    zero, one = torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    for t in (1, 500, 999):
        step = [ddim_step(zero, zero, alphas[t], alphas[t - 1], 1.0, fresh) for fresh in (zero, one)]
        beta_tilde = (1 - alphas[t - 1]) / (1 - alphas[t]) * (1 - alphas[t] / alphas[t - 1])
        torch.testing.assert_close((step[1] - step[0]).square(), beta_tilde[None])


def test_answers_get_a_verdict_once_the_usual_error_is_given(checkpoint):
    images = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(1)) * 2 - 1
    pairs = Pairs(images, *torch.tensor([[0], [1], [0]]))
    poses = torch.tensor([[0.1, 0.5, 0.0]])
    prior = small(Zero123(checkpoint))
    assert answers_by_prior(prior, pairs, poses) == []
    (error,) = denoising_errors(prior, pairs, poses).tolist()
    for share, verdict in ((0.9, "trust"), (0.4, "doubtful"), (0.3, "do not trust")):
        judged = small(Zero123(checkpoint, usual_error=share * error))
        (answer,) = answers_by_prior(judged, pairs, poses)
        assert (answer.verdict, answer.strangeness) == (verdict, pytest.approx(1 / share, rel=1e-5))
    with pytest.raises(UserError, match=r"prior.usual_error must be positive, got 0"):
        Zero123(checkpoint, usual_error=0.0)
