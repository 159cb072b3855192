"""iFusion's descent: its twist parameters, the published trajectory, its basins, its independence, its failures."""

from __future__ import annotations

import math

import pytest
import torch
from exact_prior import ExactPrior
from solver_problems import FailingPrior, around, away, exact_pairs, some
from zero123_checkpoint import golden, write_checkpoint

from lp_framework.errors import UserError
from lp_framework.geometry import camera_to_world, se3_exp, wrap_angle
from lp_framework.priors.zero123.prior import Zero123
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.twist import IFusion, SineRadius, TanhRadius, TwistPoses

WRONG_VALLEY = (
    [0.0, math.pi],
    [0.0, 0.3],
)  # a shallower one half a turn away; the crests are 99 degrees from the truth


def offsets(poses: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """Differences `[B, N, 3]` to the truth, longitudes in [-pi, pi)."""
    return away(poses, true[:, None])


# ---------------------------------------------------------------- twists


@pytest.mark.parametrize("radius_map", [SineRadius(), TanhRadius()])
def test_radius_maps_are_inverted_and_rise(radius_map):
    radius = torch.linspace(-0.65, 0.79, 80, dtype=torch.float64)
    norm = radius_map.norm(radius).requires_grad_()
    torch.testing.assert_close(radius_map.radius(norm), radius)
    (slope,) = torch.autograd.grad(radius_map.radius(norm).sum(), norm)
    assert (slope > 0).all()
    assert radius_map.norm(torch.zeros(1)).item() == 1


def test_the_second_stages_radius_map_has_a_positive_slope_and_is_bounded():
    norm = torch.logspace(-3, 3, 200, dtype=torch.float64).requires_grad_()
    radius = TanhRadius().radius(norm)
    torch.testing.assert_close(radius, (norm.square() - 1) / (norm.square() + 1))
    assert (radius.abs() < 1).all()
    (slope,) = torch.autograd.grad(radius.sum(), norm)
    torch.testing.assert_close(norm * slope, 1 - radius.square())  # the slope in log norm
    far = torch.tensor([-7.0, -0.95, 0.95, 1.0, 30.0], dtype=torch.float64)
    found = TanhRadius().radius(TanhRadius().norm(far))
    torch.testing.assert_close(found, torch.tensor([-0.8, -0.8, 0.8, 0.8, 0.8], dtype=torch.float64))


def test_a_zero_twist_is_the_start_at_any_latitude():
    latitude, longitude, radius = torch.meshgrid(
        torch.linspace(-2.5, 2.5, 11, dtype=torch.float64),
        torch.linspace(0.0, 6.2, 9, dtype=torch.float64),
        torch.tensor([-0.6, 0.0, 0.7], dtype=torch.float64),
        indexing="ij",
    )
    starts = torch.stack([latitude, longitude, radius], dim=-1)
    for radius_map in (SineRadius(), TanhRadius()):
        found = TwistPoses(starts, radius_map)(torch.zeros(*starts.shape[:-1], 6, dtype=torch.float64))
        torch.testing.assert_close(found, starts, rtol=0, atol=1e-12)


def test_a_twist_moves_the_camera_by_its_exponential():
    start = torch.tensor([0.3, 2.0, 0.2], dtype=torch.float64)
    twist = torch.tensor([0.2, -0.1, 0.15, 0.3, 0.2, -0.4], dtype=torch.float64)
    norm = SineRadius().norm(start[2])
    camera = camera_to_world(torch.stack([start[0], start[1], norm])) @ se3_exp(twist)
    x, y, z = camera[:3, 3]
    far = camera[:3, 3].norm()
    wanted = torch.stack([(y / far).asin(), torch.atan2(x, z) % (2 * math.pi), 0.8 * (far - 1).sin()])
    torch.testing.assert_close(TwistPoses(start, SineRadius())(twist), wanted)


@pytest.mark.parametrize("radius_map", [SineRadius(), TanhRadius()])
def test_gradients_in_the_twist_are_right_at_zero_and_elsewhere(radius_map):
    starts = torch.tensor([[0.0, 1.0, 0.0], [0.5, 3.0, 0.4], [1.8, 5.0, -0.5]], dtype=torch.float64)
    poses = TwistPoses(starts, radius_map)
    generator = torch.Generator().manual_seed(0)
    for twist in (torch.zeros(3, 6).double(), 0.3 * torch.randn(3, 6, generator=generator, dtype=torch.float64)):
        assert torch.autograd.gradcheck(poses, twist.requires_grad_(), check_forward_ad=True)


# ---------------------------------------------------------------- the published loop


def test_the_published_trajectory(tmp_path, monkeypatch):
    """golden.npz: ten steps of iFusion's loop on averaged weights, one noise, float32 on a CPU."""
    arrays = {name: torch.from_numpy(value) for name, value in golden().items()}
    monkeypatch.setattr(PairEnergy, "noise", lambda self, step, count=1: arrays["noise"][None, None])
    prior = Zero123(str(write_checkpoint(tmp_path)))
    index = torch.tensor([0])
    pairs = Pairs(torch.cat([arrays["ref"], arrays["qry"]]), index, index + 1, index)
    start = torch.tensor([[[0.0, math.pi / 2, 0.0]]])
    solution = IFusion(prior, steps=10, trajectory=True).solve(pairs, start, seed=0)
    wanted = arrays["adam_traj"].float() * torch.tensor([-1.0, 1.0, 1.0])  # iFusion's first angle is minus the latitude
    for turn in (0.0, 2 * math.pi):  # a published longitude may lie in any turn
        there = wanted + torch.tensor([0.0, turn, 0.0])
        assert away(solution.trajectory[0, 0], there).abs().max() < 1e-3
        assert away(solution.poses[0, 0], there[-1]).abs().max() < 1e-3
    assert solution.energies.item() == pytest.approx(arrays["adam_loss"].sum().item(), abs=1e-3)
    assert solution.cost.network_passes == 2 + 10 * 2


@pytest.mark.parametrize(
    ("steps", "first", "last", "wanted"),
    [
        (10, 999, 0, [999, 900, 800, 700, 600, 500, 400, 300, 200, 100]),
        (4, 99, 0, [99, 75, 50, 25]),
        (2, 50, 50, [50, 50]),
    ],
)
def test_timesteps_fall_linearly(monkeypatch, steps, first, last, wanted):
    met = []
    call = PairEnergy.__call__
    monkeypatch.setattr(
        PairEnergy,
        "__call__",
        lambda self, poses, timestep, noise: (met.append(timestep), call(self, poses, timestep, noise))[1],
    )
    pairs, true = exact_pairs(1)
    IFusion(ExactPrior(), steps=steps, first_timestep=first, last_timestep=last).solve(pairs, around(true, 0.1), seed=0)
    assert met == wanted


def test_a_rate_that_falls_by_plateau_ends_closer():
    """The accumulated loss does not fall, so the plateau's factor sets how fast the rate goes down."""
    pairs, true = exact_pairs(6)
    far = {}
    for factor in (0.6, 1.0):
        solution = IFusion(ExactPrior(noisy=0.2), factor=factor).solve(pairs, around(true, 0.5), seed=0)
        far[factor] = offsets(solution.poses, true)[..., 1].square().mean()
    assert far[0.6] < 0.5 * far[1.0]


# ---------------------------------------------------------------- where it ends


def test_from_inside_its_basin_it_finds_the_minimum_and_from_outside_the_wrong_one():
    pairs, true = exact_pairs(8)
    starts = around(true, -0.7, 0.0, 0.7, math.pi - 0.7, math.pi, math.pi + 0.7)
    solution = IFusion(ExactPrior(*WRONG_VALLEY)).solve(pairs, starts, seed=0)
    found = offsets(solution.poses, true)
    assert found[:, :3].abs().max() < 0.03
    assert offsets(solution.poses, true + torch.tensor([0, math.pi, 0]))[:, 3:].abs().max() < 0.03
    assert (solution.chosen < 3).all()
    assert solution.valid.all()


@pytest.mark.parametrize("choose_by", ["accumulated", "rescored"])
def test_the_published_ring_leads_to_the_answer(choose_by):
    pairs, true = exact_pairs(8)
    prior = ExactPrior(*WRONG_VALLEY)
    solution = IFusion(prior, choose_by=choose_by).solve(pairs, Ring().make(pairs, seed=0), seed=0)
    assert offsets(solution.answer()[:, None], true).abs().max() < 0.05


def test_both_directions_agree():
    """Reference and query swapped, the pose is the negative; the noise of the directions is swapped here too."""
    pairs, true = exact_pairs(5, torch.float64)
    swapped = Pairs(pairs.images, pairs.query, pairs.reference, pairs.ids)
    solver = IFusion(ExactPrior())
    there = solver.solve(pairs, around(true, 0.5), seed=0)
    back = solver.solve(swapped, around(-true, -0.5), seed=0)
    assert offsets(there.poses, -back.poses[:, 0]).abs().max() < 0.02


# ---------------------------------------------------------------- what a result depends on


def test_any_batching_and_order_gives_the_same_answers():
    pairs, true = exact_pairs(5)
    starts = around(true, -0.9, 0.4, 2.0)
    solver = IFusion(ExactPrior(*WRONG_VALLEY, noisy=0.2), steps=40)
    whole = solver.solve(pairs, starts, seed=0)
    for split in ([2, 3], [1, 1, 3], [4, 1]):
        for index in torch.randperm(5, generator=torch.Generator().manual_seed(split[0])).split(split):
            part = solver.solve(some(pairs, index), starts[index], seed=0)
            torch.testing.assert_close(part.poses, whole.poses[index], rtol=0, atol=1e-6)
            torch.testing.assert_close(part.energies, whole.energies[index], rtol=1e-6, atol=1e-6)
            assert torch.equal(part.chosen, whole.chosen[index])


def test_starts_are_independent_and_share_the_noise():
    pairs, true = exact_pairs(3)
    starts = around(true, -0.9, 0.4, 2.0, 0.4)
    solver = IFusion(ExactPrior(noisy=0.3), steps=40)
    whole = solver.solve(pairs, starts, seed=0)
    assert torch.equal(whole.poses[:, 1], whole.poses[:, 3])
    for index in ([0], [2, 1], [3, 0, 1]):
        part = solver.solve(pairs, starts[:, index], seed=0)
        torch.testing.assert_close(part.poses, whole.poses[:, index], rtol=0, atol=1e-6)


@pytest.mark.parametrize("fresh_noise", [True, False])
def test_results_depend_on_the_seed_alone(fresh_noise):
    pairs, true = exact_pairs(3)
    solver = IFusion(ExactPrior(noisy=0.3), steps=10, fresh_noise=fresh_noise)
    first, again, other = (solver.solve(pairs, around(true, 0.5), seed=seed) for seed in (0, 0, 1))
    assert torch.equal(first.poses, again.poses)
    assert not torch.equal(first.poses, other.poses)


def test_without_fresh_noise_the_landscape_is_fixed():
    """Noise moves the exact prior's minimum: fixed noise gives a fixed end, off the truth."""
    pairs, true = exact_pairs(4)
    solver = IFusion(ExactPrior(noisy=0.2), fresh_noise=False)
    solution = solver.solve(pairs, around(true, 0.3, -0.3), seed=0)
    noise = PairEnergy(ExactPrior(), pairs, seed=0).noise(0)[:, 0].flatten(2)[..., 0]  # [B, 2]
    # Direction 0 is lowest at d = -0.2 noise_0, direction 1 (whose d is the negative) at d = 0.2 noise_1.
    expected = 0.5 * (-0.2 * noise[:, 0] + 0.2 * noise[:, 1])
    found = offsets(solution.poses, true)[..., 1]
    assert (found - expected[:, None]).abs().max() < 0.02


def test_trajectories_go_from_start_to_end_without_jumps():
    pairs, true = exact_pairs(4)
    starts = around(true, -1.0, 1.0)
    starts[..., 1] -= true[:, None, 1]  # around 0, over which they cross
    solution = IFusion(ExactPrior(), steps=30, trajectory=True).solve(pairs, starts, seed=0)
    assert solution.trajectory.shape == (4, 2, 31, 3)
    torch.testing.assert_close(
        offsets(solution.trajectory[:, :, 0].flatten(0, 1)[:, None], starts.flatten(0, 1)),
        torch.zeros(8, 1, 3),
        rtol=0,
        atol=1e-6,
    )
    assert solution.trajectory.diff(dim=2).abs().max() < 0.5
    away = solution.trajectory[:, :, -1] - solution.poses
    torch.testing.assert_close(wrap_angle(away[..., 1]), torch.zeros(4, 2), rtol=0, atol=1e-5)
    assert IFusion(ExactPrior(), steps=1).solve(pairs, starts, seed=0).trajectory is None


def test_network_passes():
    pairs, true = exact_pairs(3)
    starts = around(true, 0.1, 0.2)
    assert IFusion(ExactPrior(), steps=7).solve(pairs, starts, seed=0).cost.network_passes == 6 + 7 * 3 * 2 * 2
    rescored = IFusion(ExactPrior(), steps=7, choose_by="rescored", rescoring=5).solve(pairs, starts, seed=0)
    assert rescored.cost.network_passes == 6 + (7 + 5) * 3 * 2 * 2


def test_it_descends_in_inference_mode():
    """As under `Trainer.test`."""
    solver = IFusion(ExactPrior(), steps=20)
    with torch.inference_mode():
        pairs, true = exact_pairs(2)
        inside = solver.solve(pairs, around(true, 0.5), seed=0)
    pairs, true = exact_pairs(2)
    assert torch.equal(inside.poses, solver.solve(pairs, around(true, 0.5), seed=0).poses)


# ---------------------------------------------------------------- choice


def test_rescoring_compares_final_poses_and_not_trajectories():
    """A long trajectory to the right minimum has a larger sum of losses than a start at a wrong minimum."""
    pairs, true = exact_pairs(6)
    starts = around(true, 1.4, math.pi)
    starts[:, 1, ::2] = true[:, ::2]
    prior = ExactPrior([0.0, math.pi], [0.0, 0.02])
    chosen = {
        by: IFusion(prior, choose_by=by).solve(pairs, starts, seed=0).chosen for by in ("accumulated", "rescored")
    }
    assert (chosen["accumulated"] == 1).all()
    assert (chosen["rescored"] == 0).all()


def test_the_rescored_energy_is_the_mean_error_of_the_end(monkeypatch):
    pairs, true = exact_pairs(2, torch.float64)
    prior = ExactPrior(noisy=0.3)
    solution = IFusion(prior, steps=5, choose_by="rescored", rescoring=4).solve(pairs, around(true, 0.5, 1.0), seed=0)
    energy = PairEnergy(prior, pairs, seed=0)
    noise = energy.noise(5, count=4)
    each = [energy(solution.poses, 0, noise[:, number]) for number in range(4)]
    torch.testing.assert_close(solution.energies, torch.stack(each).mean(dim=0))


# ---------------------------------------------------------------- failures and settings


@pytest.mark.parametrize("what", ["energy", "gradient"])
def test_a_start_where_the_prior_fails_stops_alone_and_is_reported(what):
    pairs, true = exact_pairs(3)
    starts = around(true, 0.3, 0.6, -0.5)
    solver = IFusion(FailingPrior(1.0, what), steps=30)
    healthy = solver.solve(pairs, starts, seed=0)
    assert healthy.valid.all()
    starts[1, 2, 0] = 1.2
    solution = solver.solve(pairs, starts, seed=0)
    sound = torch.ones(3, 3, dtype=torch.bool)
    sound[1, 2] = False
    assert torch.equal(solution.valid, sound)
    assert torch.equal(solution.poses[sound], healthy.poses[sound])
    assert torch.equal(solution.energies[sound], healthy.energies[sound])
    assert solution.energies[1, 2].isnan()
    torch.testing.assert_close(solution.poses[1, 2], starts[1, 2])
    assert solution.chosen[1] != 2


def test_a_start_that_fails_later_keeps_its_last_valid_pose():
    pairs, true = exact_pairs(4)
    limit = 0.6 * true[:, 0].abs().min().item()
    solution = IFusion(FailingPrior(limit), steps=60, learning_rate=0.01, trajectory=True).solve(
        pairs, around(true, 0.2), seed=0
    )
    assert not solution.valid.any()
    assert (solution.poses[..., 0].abs() <= limit).all()
    assert (solution.poses[..., 0].abs() > 0.5 * limit).all()
    assert torch.equal(solution.poses[..., 0], solution.trajectory[:, :, -1, 0])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"steps": 0}, "solver.steps must be at least 1, got 0"),
        ({"learning_rate": 0.0}, "solver.learning_rate must be positive, got 0.0"),
        ({"factor": 1.5}, "solver.factor must be above 0 and at most 1, got 1.5"),
        ({"patience": -1}, "solver.patience must be at least 0, got -1"),
        ({"rescoring": 0}, "solver.rescoring must be at least 1, got 0"),
        ({"first_timestep": 1000}, "solver.first_timestep must be below the prior's 1000 timesteps, got 1000"),
        ({"first_timestep": 10, "last_timestep": 11}, "solver.last_timestep must be from 0 to first_timestep, got 11"),
        ({"last_timestep": -1}, "solver.last_timestep must be from 0 to first_timestep, got -1"),
    ],
)
def test_bad_settings_are_named(settings, message):
    with pytest.raises(UserError, match=message):
        IFusion(ExactPrior(), **settings)


@pytest.mark.parametrize("radius", [-0.68, 0.8])
def test_starts_beyond_the_reach_of_its_radius_are_refused(radius):
    pairs, true = exact_pairs(1)
    starts = around(true, 0.0)
    starts[..., 2] = radius
    with pytest.raises(UserError, match=r"this solver takes starts with relative radii between -0\.67 and 0\.8"):
        IFusion(ExactPrior()).solve(pairs, starts, seed=0)
