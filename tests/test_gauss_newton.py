"""Gauss-Newton on the prior's residuals: its Jacobian, its convergence, its damping, its independence."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch
from exact_prior import ExactPrior
from solver_problems import ExactModel, FailingPrior, around, exact_pairs, some
from test_ifusion import WRONG_VALLEY, offsets
from torch import Tensor
from zero123_checkpoint import write_checkpoint

from lp_framework.errors import UserError
from lp_framework.priors.base import ViewCode
from lp_framework.priors.zero123.prior import Zero123
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.langevin import Langevin
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.two_stage import GaussNewton, TwoStage


class Flat(ExactPrior):
    """Does not depend on the pose."""

    def residual(self, target: ViewCode, source: ViewCode, pose: Tensor, timestep: Tensor, noise: Tensor) -> Tensor:
        return 1.0 + 0.0 * super().residual(target, source, pose, timestep, noise)


def refine(prior: ExactPrior, steps: int, **settings) -> GaussNewton:
    """The second stage alone."""
    return GaussNewton(ExactModel(), prior, iterations=0, refinement_steps=steps, **settings)


def test_convergence_is_quadratic():
    """Each step squares the error, up to what the damping leaves (it falls to a third each time)."""
    pairs, true = exact_pairs(6, torch.float64)
    starts = true[:, None] + torch.tensor([[0.3, 0.8, -0.1], [-0.2, -0.9, 0.1]], dtype=torch.float64)
    errors = [
        offsets(refine(ExactPrior(), steps).solve(pairs, starts, seed=0).poses, true).norm(dim=-1).max().item()
        for steps in range(6)
    ]
    assert errors[0] > 0.8
    assert all(after < 0.1 * before for before, after in pairwise(errors[1:]))
    assert errors[5] < 1e-7


def test_it_needs_far_fewer_passes_than_adam():
    pairs, true = exact_pairs(6)
    starts = around(true, 0.4)
    newton = refine(ExactPrior(), 3).solve(pairs, starts, seed=0)
    adam = TwoStage(ExactModel(), ExactPrior(), iterations=0).solve(pairs, starts, seed=0)
    assert offsets(newton.poses, true).norm(dim=-1).max() < 0.1 * offsets(adam.poses, true).norm(dim=-1).max()
    images, look, step = 12, 3 * 6, 6 * 2 * 4  # images are encoded by both stages; the model looks around its starts
    assert newton.cost.network_passes == 2 * images + look + 4 * step


def test_its_quadratic_model_is_that_of_the_energy(tmp_path):
    """On Zero123's network: gradient as backward mode has it; J^T J as from one direction after another."""
    prior = Zero123(str(write_checkpoint(tmp_path)))
    prior.latent_shape, prior.image_size = (4, 8, 8), 64
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(3, 3, 64, 64, generator=generator) * 2 - 1
    pairs = Pairs(images, torch.tensor([0, 1]), torch.tensor([1, 2]), torch.tensor([4, 5]))
    energy, poses = PairEnergy(prior, pairs, 0), torch.randn(2, 2, 3, generator=generator)
    noise = energy.noise(0, 2)
    solver = GaussNewton(ExactModel(), prior, timesteps=(30, 600))
    found = solver._quadratic(energy, poses, noise)
    variable = poses.clone().requires_grad_()
    expected = energy.mean(variable, (30, 600), noise)
    (gradient,) = torch.autograd.grad(expected.sum(), variable)
    torch.testing.assert_close(found.energy, expected.detach(), rtol=1e-5, atol=0)
    torch.testing.assert_close(2 * found.gradient, gradient, rtol=1e-3, atol=1e-4 * gradient.abs().max().item())
    hessian = torch.zeros(2, 2, 3, 3)
    for number, timestep in enumerate((30, 600)):
        columns = [
            torch.func.jvp(
                lambda x, t=timestep, n=number: energy.residual(x, t, noise[:, n]).flatten(2),
                (poses,),
                (torch.eye(3)[axis].expand_as(poses).contiguous(),),
            )[1]
            for axis in range(3)
        ]
        jacobian = torch.stack(columns, dim=-1)
        hessian += (jacobian.mT @ jacobian) / jacobian.shape[2] / 2
    torch.testing.assert_close(found.hessian, hessian, rtol=1e-3, atol=1e-4 * hessian.abs().max().item())


def test_the_energy_never_rises():
    pairs, true = exact_pairs(10)
    starts = true[:, None] + torch.linspace(-3, 3, 13)[None, :, None] * torch.tensor([0.3, 1.0, 0.2])
    prior = ExactPrior(*WRONG_VALLEY, noisy=0.3)
    energies = torch.stack([refine(prior, steps).solve(pairs, starts, seed=0).energies for steps in range(8)])
    assert (energies.diff(dim=0) <= 0).all()
    assert (energies[-1] < energies[0]).double().mean() > 0.9


@pytest.mark.parametrize("damping", [1e-4, 1e-2, 1.0, 100.0])
def test_damping_adapts_itself(damping):
    pairs, true = exact_pairs(4)
    solution = refine(ExactPrior(), 15, damping=damping).solve(pairs, around(true, 0.6, -0.6), seed=0)
    assert offsets(solution.poses, true).abs().max() < 0.01


def test_from_inside_its_basin_it_finds_the_minimum_and_from_outside_the_wrong_one():
    pairs, true = exact_pairs(5)
    starts = around(true, -0.7, 0.5, math.pi - 0.5, math.pi + 0.4)
    solution = refine(ExactPrior(*WRONG_VALLEY), 10).solve(pairs, starts, seed=0)
    found = offsets(solution.poses, true)
    assert found[:, :2].abs().max() < 0.01
    assert (found[:, 2:, 1].abs() > 2).all()
    assert (solution.chosen < 2).all()


def test_the_first_stage_leaves_the_wrong_basin():
    pairs, true = exact_pairs(5)
    starts = around(true, math.pi - 0.5, math.pi)
    solution = GaussNewton(ExactModel(), ExactPrior(*WRONG_VALLEY)).solve(pairs, starts, seed=0)
    assert offsets(solution.poses, true).abs().max() < 0.01


def test_without_steps_it_is_the_first_stage():
    pairs, true = exact_pairs(3)
    starts = around(true, 0.5, 2.0)
    alone = Langevin(ExactModel(), gamma=0.3).solve(pairs, starts, seed=4)
    found = GaussNewton(ExactModel(), ExactPrior(), gamma=0.3, refinement_steps=0).solve(pairs, starts, seed=4)
    torch.testing.assert_close(found.poses, alone.poses)


def test_poses_stay_where_the_energy_is_constant():
    pairs, true = exact_pairs(2)
    starts = around(true, 0.5)
    solution = refine(Flat(), 5).solve(pairs, starts, seed=0)
    torch.testing.assert_close(solution.poses, starts)
    assert solution.valid.all()


def test_steps_and_radii_are_bounded():
    pairs, true = exact_pairs(3)
    starts = around(true, 1.5)
    starts[..., 2] = 3.0
    path = refine(ExactPrior(), 6, damping=1e-6, trajectory=True).solve(pairs, starts, seed=0).trajectory
    assert torch.equal(path[:, :, 0], starts)
    assert path[:, :, 1:, 2].abs().max() <= 0.8
    assert path[:, :, 1:].diff(dim=2).norm(dim=-1).max() < 0.5 + 1e-5


def test_the_path_has_both_stages():
    pairs, true = exact_pairs(4)
    starts = around(true, -7.0, 2.0)
    solver = GaussNewton(ExactModel(), ExactPrior(), trajectory=True)
    solution = solver.solve(pairs, starts, seed=0)
    first = Langevin(ExactModel(), gamma=0.0, trajectory=True).solve(pairs, starts, seed=0)
    assert solution.trajectory.shape == (4, 2, 1 + 50 + 4, 3)
    assert torch.equal(solution.trajectory[:, :, :51], first.trajectory)
    assert solution.trajectory.diff(dim=2).abs().max() < 1.0
    turns = (solution.trajectory[:, :, -1, 1] - solution.poses[..., 1]) / (2 * math.pi)
    torch.testing.assert_close(turns, turns.round(), rtol=0, atol=1e-5)


def test_any_batching_and_order_gives_the_same_answers():
    pairs, true = exact_pairs(5)
    starts = around(true, -0.9, 0.4, 2.0)
    solver = refine(ExactPrior(*WRONG_VALLEY, noisy=0.2), 4)
    whole = solver.solve(pairs, starts, seed=0)
    for index in torch.tensor([3, 0, 4, 1, 2]).split([2, 3]):
        part = solver.solve(some(pairs, index), starts[index], seed=0)
        torch.testing.assert_close(part.poses, whole.poses[index], rtol=0, atol=1e-5)
        assert torch.equal(part.chosen, whole.chosen[index])
    torch.testing.assert_close(solver.solve(pairs, starts[:, :2], seed=0).poses, whole.poses[:, :2], rtol=0, atol=1e-5)


def test_the_seed_decides_the_noise():
    pairs, true = exact_pairs(3)
    first, again, other = (
        refine(ExactPrior(noisy=0.3), 4).solve(pairs, around(true, 0.4), seed).poses for seed in (0, 0, 1)
    )
    assert torch.equal(first, again)
    assert (first[..., 1] != other[..., 1]).all()


def test_several_timesteps_average_their_noises():
    pairs, true = exact_pairs(60)
    starts = around(true, 0.3)
    spread = [
        offsets(refine(ExactPrior(noisy=0.3), 6, timesteps=timesteps).solve(pairs, starts, seed=0).poses, true)
        .square()
        .mean()
        .sqrt()
        for timesteps in ([500], [500] * 9)
    ]
    assert spread[1] < 0.5 * spread[0]


@pytest.mark.parametrize("what", ["energy", "gradient"])
def test_a_start_where_the_prior_fails_stops_alone_and_is_reported(what):
    pairs, true = exact_pairs(3)
    starts = around(true, 0.3, 0.6, -0.5)
    solver = refine(FailingPrior(1.0, what), 4)
    healthy = solver.solve(pairs, starts, seed=0)
    assert healthy.valid.all()
    starts[1, 2, 0] = 6.0
    solution = solver.solve(pairs, starts, seed=0)
    sound = torch.ones(3, 3, dtype=torch.bool)
    sound[1, 2] = False
    assert torch.equal(solution.valid, sound)
    assert torch.equal(solution.poses[sound], healthy.poses[sound])
    assert torch.equal(solution.poses[1, 2], starts[1, 2])
    assert solution.chosen[1] != 2


def test_the_second_stage_alone_starts_where_the_first_ends():
    pairs, true = exact_pairs(3)
    starts = around(true, 0.5, -0.5)
    both = GaussNewton(ExactModel(), ExactPrior(noisy=0.1), refinement_steps=2)
    second = both.refine(pairs, both.first.solve(pairs, starts, seed=0).poses, seed=0)
    whole = both.solve(pairs, starts, seed=0)
    assert torch.equal(second.poses, whole.poses) and torch.equal(second.energies, whole.energies)
    assert (
        second.cost.network_passes == whole.cost.network_passes - both.first.solve(pairs, starts, 0).cost.network_passes
    )


def test_it_works_in_inference_mode():
    with torch.inference_mode():
        pairs, true = exact_pairs(3)
        solution = GaussNewton(ExactModel(), ExactPrior()).solve(pairs, around(true, 0.5), seed=0)
    assert offsets(solution.poses, true).abs().max() < 0.01


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"refinement_steps": -1}, r"solver\.refinement_steps must be at least 0, got -1"),
        ({"timesteps": []}, r"solver\.timesteps must be one or more of 0 to 999, got \[\]"),
        ({"timesteps": [20, 1000]}, r"solver\.timesteps must be one or more of 0 to 999, got \[20, 1000\]"),
        ({"damping": 0.0}, r"solver\.damping must be positive, got 0\.0"),
    ],
)
def test_bad_settings_are_named(settings, message):
    with pytest.raises(UserError, match=message):
        GaussNewton(ExactModel(), ExactPrior(), **settings)


def test_no_step_synchronizes_or_mixes_devices(monkeypatch):
    """On the meta device, where a value that is asked for and a tensor from elsewhere are errors."""
    meta = torch.device("meta")
    pairs, true = exact_pairs(2)
    there = Pairs(*(each.to(meta) for each in (pairs.images, pairs.reference, pairs.query, pairs.ids)))
    monkeypatch.setattr("lp_framework.solvers.base.check_starts", lambda pairs, starts: None)  # looks at values
    solution = GaussNewton(ExactModel(), ExactPrior().to(meta)).refine(there, around(true, 0.3).to(meta), seed=0)
    assert solution.poses.device == meta and solution.poses.shape == (2, 1, 3)
    with pytest.raises(RuntimeError, match="device"):
        GaussNewton(ExactModel(), ExactPrior().to(meta)).refine(there, around(true, 0.3), seed=0)
