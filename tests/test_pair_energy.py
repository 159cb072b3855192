"""The energy of a pair: the mean of both directions, its noise keyed, its images encoded once."""

from __future__ import annotations

import pytest
import torch
from exact_prior import ExactPrior
from solver_problems import exact_pairs, some

from lp_framework.errors import UserError
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.pair_energy import PairEnergy


def poses(batch: int, starts: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    return torch.randn(batch, starts, 3, generator=generator, dtype=torch.float64)


def uneven() -> ExactPrior:
    """A prior whose two directions differ: its minima are not symmetric about the truth."""
    return ExactPrior([0.0, 2.0], [0.0, 0.3], noisy=0.3)


def test_the_energy_is_the_mean_of_both_directions():
    pairs, _ = exact_pairs(3, torch.float64)
    prior, x = uneven(), poses(3, 4)
    energy = PairEnergy(prior, pairs, seed=0)
    noise = energy.noise(5)[:, 0].double()
    codes, found = prior.encode(pairs.images), energy(x, 100, noise)
    for b in range(3):
        query, reference = codes[pairs.query[b : b + 1]], codes[pairs.reference[b : b + 1]]
        for n in range(4):
            timestep = torch.tensor([100])
            there = prior.denoising_error(query, reference, x[b, n : n + 1], timestep, noise[b, :1])
            back = prior.denoising_error(reference, query, -x[b, n : n + 1], timestep, noise[b, 1:])
            assert there != back
            torch.testing.assert_close(found[b, n], (there + back)[0] / 2)


def test_both_directions_agree():
    """Swapping the images and negating the pose swaps the directions and leaves the energy."""
    pairs, _ = exact_pairs(3, torch.float64)
    swapped = Pairs(pairs.images, pairs.query, pairs.reference, pairs.ids)
    x = poses(3, 4)
    forward, backward = (PairEnergy(uneven(), each, seed=0) for each in (pairs, swapped))
    noise = forward.noise(0)[:, 0].double()
    torch.testing.assert_close(forward(x, 10, noise), backward(-x, 10, noise.flip(1)))


def test_the_energy_is_the_mean_square_of_the_residual_and_both_are_differentiable():
    pairs, _ = exact_pairs(2, torch.float64)
    energy = PairEnergy(uneven(), pairs, seed=0)
    noise, x = energy.noise(0)[:, 0].double(), poses(2, 3).requires_grad_()
    residual = energy.residual(x, 10, noise)
    assert residual.shape == (2, 3, 2, 3)
    torch.testing.assert_close(residual.square().mean(dim=(2, 3)), energy(x, 10, noise))
    for function in (energy, energy.residual):
        assert torch.autograd.gradcheck(lambda x, f=function: f(x, 10, noise), x, check_forward_ad=True)


def test_the_mean_over_timesteps_pairs_each_with_its_noise():
    pairs, _ = exact_pairs(2, torch.float64)
    energy, x = PairEnergy(uneven(), pairs, seed=0), poses(2, 3)
    noise = energy.noise(0, count=3).double()
    each = torch.stack([energy(x, timestep, noise[:, number]) for number, timestep in enumerate((5, 6, 7))])
    torch.testing.assert_close(energy.mean(x, (5, 6, 7), noise), each.mean(dim=0))


def test_noise_is_standard_normal_and_another_for_every_key():
    pairs, _ = exact_pairs(40)
    energy = PairEnergy(ExactPrior(), pairs, seed=0)
    noise = torch.cat([energy.noise(step, count=5).flatten(1) for step in range(60)], dim=1)
    assert noise.dtype == torch.float32
    assert noise.flatten().unique().numel() > 0.99 * noise.numel()
    assert noise.mean().abs() < 5 / noise.numel() ** 0.5
    assert (noise.var() - 1).abs() < 5 * (2 / noise.numel()) ** 0.5
    other = PairEnergy(ExactPrior(), pairs, seed=1)
    assert not torch.isin(other.noise(0), noise).any()


def test_noise_depends_on_the_pair_and_not_on_its_place_in_a_batch():
    pairs, _ = exact_pairs(5)
    order = torch.tensor([3, 0, 4])
    whole, part = (PairEnergy(ExactPrior(), each, seed=0) for each in (pairs, some(pairs, order)))
    assert torch.equal(part.noise(7, count=2), whole.noise(7, count=2)[order])
    assert torch.equal(whole.noise(7, count=2), whole.noise(7, count=6)[:, :2])


def test_noise_does_not_synchronize_with_the_device():
    """On a GPU, this would synchronize at every step."""
    pairs, _ = exact_pairs(2)
    energy = PairEnergy(ExactPrior(), pairs, seed=3)
    here = energy.noise(7, count=2)
    tensors = (each for each in vars(pairs).values() if each is not None)
    energy.pairs = Pairs(*(each.to("meta") for each in tensors))  # where a value that is read is an error
    there = energy.noise(7, count=2)
    assert there.device == torch.device("meta") and there.shape == here.shape and there.dtype == torch.float32


def test_images_are_encoded_once_and_passes_are_counted(monkeypatch):
    pairs, _ = exact_pairs(3)
    prior, encoded = ExactPrior(), []
    encode = prior.encode
    monkeypatch.setattr(prior, "encode", lambda images: (encoded.append(len(images)), encode(images))[1])
    energy = PairEnergy(prior, pairs, seed=0)
    assert energy.passes == 6
    noise = energy.noise(0)[:, 0]
    energy(torch.zeros(3, 5, 3), 0, noise)
    energy.residual(torch.zeros(3, 2, 3), 0, noise)
    assert energy.passes == 6 + 2 * 3 * 5 + 2 * 3 * 2
    assert encoded == [6]
    assert PairEnergy(prior, pairs, 0, energy.codes).passes == 0
    assert encoded == [6]


def test_images_made_in_inference_mode_still_allow_gradients():
    with torch.inference_mode():
        pairs, _ = exact_pairs(2)
        energy = PairEnergy(ExactPrior(), pairs, seed=0)
    x = torch.zeros(2, 1, 3, requires_grad=True)
    energy(x, 0, energy.noise(0)[:, 0]).sum().backward()
    assert x.grad.abs().sum() > 0


@pytest.mark.parametrize("timestep", [-1, 1000])
def test_invalid_timesteps(timestep):
    pairs, _ = exact_pairs(1)
    energy = PairEnergy(ExactPrior(), pairs, seed=0)
    with pytest.raises(UserError, match=f"this prior has timesteps 0 to 999, got {timestep}"):
        energy(torch.zeros(1, 1, 3), timestep, energy.noise(0)[:, 0])
