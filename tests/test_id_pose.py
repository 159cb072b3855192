"""ID-Pose: its candidates, its selections, its refinement of two and of more images."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from exact_prior import ExactPrior
from solver_problems import FailingPrior, around, exact_pairs, exact_sets, some
from test_ifusion import WRONG_VALLEY, offsets

from lp_framework.errors import UserError
from lp_framework.geometry import wrap_angle
from lp_framework.solvers.base import Pairs, ViewSets
from lp_framework.solvers.id_pose import IDPose, triangular_choice
from lp_framework.solvers.pair_energy import PairEnergy

SOFT = {"stiffness": 0.05}  # gradients of a size at which rates of 10 and 1 are stable, as Zero123's are
UNUSED = torch.zeros(1, 1, 3)


def solver(prior=None, **settings) -> IDPose:
    """The published one, but refined by fewer steps."""
    return IDPose(prior or ExactPrior(*WRONG_VALLEY, **SOFT), **{"refinement_steps": 100, **settings})


def unused(pairs: Pairs) -> torch.Tensor:
    return UNUSED.expand(len(pairs), -1, -1)


# ---------------------------------------------------------------- two images


def test_it_finds_the_answer_and_keeps_five_candidates():
    pairs, true = exact_pairs(6)
    solution = solver().solve(pairs, unused(pairs), seed=0)
    assert solution.poses.shape == (6, 5, 3)
    assert offsets(solution.answer()[:, None], true).abs().max() < 1e-3
    assert solution.valid.all()
    assert (solution.energies.diff(dim=1) >= 0).all()
    assert (solution.chosen == 0).all()


def test_given_starts_replace_the_grid_which_ignores_them():
    pairs, true = exact_pairs(4)
    wrong = around(true, math.pi - 0.3, math.pi, math.pi + 0.3, math.pi + 0.1)
    ends = solver(candidates="starts").solve(pairs, wrong, seed=0)
    assert ends.poses.shape == (4, 2, 3)  # the better half
    assert offsets(ends.answer()[:, None], true + torch.tensor([0, math.pi, 0])).abs().max() < 0.01
    first, second = (solver().solve(pairs, starts, seed=0) for starts in (wrong, unused(pairs)))
    assert torch.equal(first.poses, second.poses)


def test_candidates_are_the_published_grid():
    pairs, _ = exact_pairs(2)
    found = solver(exploration_steps=0, kept=100, refinement_steps=0).solve(pairs, unused(pairs), seed=0)
    poses = found.poses[0].rad2deg().round()
    assert poses.shape == (20, 3)  # the better half of 40
    grid = set(itertools.product((-120, -60, 0, 60, 120), range(0, 360, 45)))
    assert {(int(latitude), int(longitude) % 360) for latitude, longitude, _ in poses.tolist()} < grid
    known = solver(latitudes_degrees=[10.0], longitudes=6, exploration_steps=0, kept=100, refinement_steps=0)
    poses = known.solve(pairs, unused(pairs), seed=0).poses.rad2deg().round()
    assert poses.shape == (2, 3, 3)
    assert (poses[..., 0] == 10).all()
    assert {int(each) % 360 for each in poses[..., 1].flatten()} <= set(range(0, 360, 60))


def test_the_better_half_of_the_candidates_is_explored():
    pairs, _ = exact_pairs(3)
    prior = ExactPrior(*WRONG_VALLEY)
    everything = solver(prior, candidates="starts", exploration_steps=0, kept=100, refinement_steps=0)
    generator = torch.Generator().manual_seed(0)
    starts = torch.rand(3, 9, 3, generator=generator) * 3
    found = everything.solve(pairs, starts, seed=0)
    codes = prior.encode(pairs.images)
    for b in range(3):
        truth = codes.latent[pairs.query[b]] - codes.latent[pairs.reference[b]]
        energies = [closed_form(start - truth.flatten()) for start in starts[b]]
        best = sorted(range(9), key=energies.__getitem__)[:4]
        torch.testing.assert_close(found.poses[b], starts[b, best])
        torch.testing.assert_close(found.energies[b], torch.stack([energies[index] for index in best]))


def closed_form(away: torch.Tensor) -> torch.Tensor:
    """The mean over both directions of `ExactPrior(*WRONG_VALLEY)`, symmetric in longitude."""
    depth = (1 - away[1].cos()) * (0.3 + 1 + away[1].cos())
    return 0.5 * (away[0] ** 2 + away[2] ** 2 + depth)


def test_probing_and_steps_meet_the_published_timesteps(monkeypatch):
    met = []
    prior = ExactPrior(**SOFT)
    error = prior.denoising_error
    monkeypatch.setattr(
        prior,
        "denoising_error",
        lambda target, source, pose, timestep, noise: (
            met.append((len(pose), timestep.unique().item())),
            error(target, source, pose, timestep, noise),
        )[1],
    )
    pairs, _ = exact_pairs(1)
    solution = IDPose(prior).solve(pairs, unused(pairs), seed=0)
    probe = [200, 200, 201, 201, 202, 203, 203, 204, 205, 205, 206, 206, 207, 208, 208, 209]
    wanted = [(80, each) for each in probe]  # 8 x 5 candidates in both directions
    wanted += [(20, 200)] * 10  # half of them, one direction per step
    wanted += [(40, each) for each in probe]
    wanted += [(1, 200)] * 600
    assert met == wanted
    assert solution.cost.network_passes == 2 + sum(count for count, _ in wanted)


def test_steps_are_the_gradient_of_one_direction_times_the_rate():
    """Two steps by hand on an energy whose two directions have their minima on either side of the truth."""
    pairs, true = exact_pairs(2, torch.float64)
    prior = ExactPrior([0.4])
    start = around(true, 0.9)
    start[..., ::2] = true[:, None, ::2]
    found = IDPose(
        prior, candidates="starts", exploration_steps=0, refinement_steps=2, refinement_rate=0.5, trajectory=True
    ).solve(pairs, start, seed=0)
    away = (found.trajectory[:, 0, :, 1] - true[:, 1:2]).T
    assert away.shape == (3, 2)
    # Direction 0 is 1/2 (1 - cos(d - 0.4)), direction 1 is 1/2 (1 - cos(-d - 0.4)).
    first = 0.9 - 0.5 * 0.5 * math.sin(0.5)
    second = first - 0.5 * 0.5 * math.sin(first + 0.4)
    torch.testing.assert_close(away[:, 0], torch.tensor([0.9, first, second], dtype=torch.float64))
    # Published: a pose is recorded when the step after its update begins, so the last update never is.
    torch.testing.assert_close(found.poses[0, 0, 1], true[0, 1] + first)


def test_the_answer_is_the_mean_of_the_last_poses():
    pairs, _ = exact_pairs(3)
    prior = ExactPrior(noisy=0.5, **SOFT)
    found = solver(prior, averaged=20, trajectory=True).solve(pairs, unused(pairs), seed=0)
    row = torch.arange(3)
    path = found.trajectory[row, found.chosen]
    assert found.trajectory.shape == (3, 5, 10 + 100, 3)
    torch.testing.assert_close(
        wrap_angle(path[:, -21:-1].mean(dim=1) - found.answer()), torch.zeros(3, 3), atol=1e-5, rtol=0
    )
    others = found.trajectory[:, 1:]
    assert (others[:, :, 9:] == others[:, :, 9:10]).all()  # explored only


def test_any_batching_and_order_gives_the_same_answers():
    pairs, _ = exact_pairs(5)
    whole = solver(ExactPrior(noisy=0.3, **SOFT)).solve(pairs, unused(pairs), seed=0)
    for index in torch.tensor([3, 0, 4, 1, 2]).split([2, 3]):
        part = solver(ExactPrior(noisy=0.3, **SOFT)).solve(some(pairs, index), unused(some(pairs, index)), seed=0)
        torch.testing.assert_close(part.poses, whole.poses[index], rtol=0, atol=1e-5)


def test_candidates_where_the_prior_fails_are_dropped():
    pairs, true = exact_pairs(3)
    starts = around(true, 0.2, 0.3, 0.5, 0.6, 1.0, 1.1)
    starts[1, 0, 0] = 2.0
    found = solver(FailingPrior(1.0), candidates="starts", exploration_rate=0.1, refinement_rate=0.1)
    solution = found.solve(pairs, starts, seed=0)
    assert solution.valid.all()
    assert (solution.poses[1, :, 0].abs() < 1).all()
    starts[2, :, 0] = 2.0
    solution = found.solve(pairs, starts, seed=0)
    assert solution.valid.all(dim=1).tolist() == [True, True, False]
    assert not solution.valid[2].any()
    assert solution.poses.isfinite().all()


# ---------------------------------------------------------------- several images


@pytest.mark.parametrize("views", [2, 3, 5])
def test_sets_of_images_are_solved_together(views):
    sets, true = exact_sets(3, views)
    starts = torch.zeros(3, views - 1, 1, 3)
    solution = solver().solve_views(sets, starts, seed=0)
    away = solution.poses - true
    assert wrap_angle(away).abs().max() < 1e-3
    assert solution.valid.all()
    diagonal = torch.eye(views, dtype=torch.bool)
    assert solution.energies[:, diagonal].isnan().all()
    assert solution.energies[:, ~diagonal].isfinite().all()
    assert torch.equal(solution.energies.nan_to_num(), solution.energies.mT.nan_to_num())


def test_other_images_help_to_choose_between_two_minima():
    """Noise makes the wrong minimum of the first pair deeper; it is inconsistent with the third image."""
    alone = torch.tensor([[[1.0, 0.9], [0.5, 2.0]]])
    between = torch.tensor([[[[0.1, 0.8], [1.5, 1.0]]]])
    assert triangular_choice(alone, between[:, :0], []).tolist() == [[1, 0]]
    # Image 0: candidate 0 gets min(1 + .5 + .1, 3), candidate 1 min(.9 + .5 + 1.5, 2.7).
    assert triangular_choice(alone, between, [(0, 1)]).tolist() == [[0, 0]]


def test_an_image_without_a_good_candidate_does_not_count_against_the_others():
    alone = torch.tensor([[[0.1, 0.2], [9.0, 9.0]]])
    between = torch.tensor([[[[5.0, 5.0], [0.0, 0.0]]]])
    assert triangular_choice(alone, between, [(0, 1)]).tolist() == [[0, 0]]  # 0.3 against 0.6, not 14 against 9


def test_failed_candidates_are_not_chosen():
    alone = torch.tensor([[[torch.nan, 0.9], [0.5, 2.0]]])
    between = torch.full((1, 1, 2, 2), torch.nan)
    assert triangular_choice(alone, between, [(0, 1)]).tolist() == [[1, 0]]
    assert triangular_choice(alone, between[:, :0], []).tolist() == [[1, 0]]


def test_the_choice_is_that_of_loops_over_candidates():
    generator = torch.Generator().manual_seed(0)
    alone, between = torch.rand(4, 4, 3, generator=generator), torch.rand(4, 6, 3, 3, generator=generator)
    duos = list(itertools.combinations(range(4), 2))
    for s in range(4):
        total = torch.zeros(4, 3)
        for number, (i, j) in enumerate(duos):
            for u in range(3):
                joint = min(alone[s, i, u] + alone[s, j, v] + between[s, number, u, v] for v in range(3))
                total[i, u] += min(joint, 3 * alone[s, i, u])
                joint = min(alone[s, i, v] + alone[s, j, u] + between[s, number, v, u] for v in range(3))
                total[j, u] += min(joint, 3 * alone[s, j, u])
        assert triangular_choice(alone, between, duos)[s].tolist() == total.argmin(dim=1).tolist()


def test_the_refinement_cycles_over_ordered_pairs_and_moves_one_image_a_step():
    sets, _ = exact_sets(2, 3)
    prior, met = ExactPrior(**SOFT), []
    error = prior.denoising_error

    def watched(target, source, pose, timestep, noise):
        met.append((len(pose), target.latent.flatten(1), source.latent.flatten(1)))
        return error(target, source, pose, timestep, noise)

    prior.denoising_error = watched
    IDPose(prior, refinement_steps=30).solve_views(sets, torch.zeros(2, 2, 1, 3), seed=0)
    steps = met[-60:]  # 30 for each of two unknown images
    poses = sets.images.flatten(1)[:, :3][sets.views]
    for step, (count, target, source) in enumerate(steps):
        i, j = [(0, 1), (1, 0), (0, 2), (2, 0), (1, 2), (2, 1)][step % 6]
        assert count == 2
        assert torch.equal(source, poses[:, i])
        assert torch.equal(target, poses[:, j])


def test_of_two_unknown_images_either_is_held_at_random():
    identity = IDPose(ExactPrior(), refinement_steps=300)
    duos = [(0, 1), (1, 0), (0, 2), (2, 0), (1, 2), (2, 1)]
    moved = identity._moved(duos, torch.arange(40), seed=0, others=2)
    assert moved.shape == (600, 40, 3)
    assert (moved.sum(dim=2) == 1).all()
    assert not moved[..., 0].any()
    cycle = moved.unflatten(0, (100, 6))
    assert cycle[:, :2, :, 1].all()
    assert cycle[:, 2:4, :, 2].all()
    share = cycle[:, 4:, :, 1].double().mean()
    assert abs(share.item() - 0.5) < 4 * 0.5 / math.sqrt(100 * 2 * 40)


@pytest.mark.parametrize("averaged", [1, 5, 1000])
def test_answers_are_the_means_of_what_the_published_loop_records(averaged):
    sets, true = exact_sets(3, 3)
    solver = IDPose(ExactPrior(noisy=0.5, **SOFT), refinement_steps=20, averaged=averaged)
    answers, _, trajectory = solver.refine(
        PairEnergy(solver.prior, sets.with_first(), 0), sets.views, sets.ids, true + 0.1
    )
    moved = solver._moved([(0, 1), (1, 0), (0, 2), (2, 0), (1, 2), (2, 1)], sets.ids, seed=0, others=2)
    for s in range(3):
        recorded, selected = {1: [], 2: []}, None
        for step in range(len(moved)):  # as `find_optimal_poses` goes: record, select, update
            if selected is not None:
                recorded[selected].append(trajectory[s, step, selected - 1])
            selected = int(moved[step, s].int().argmax())
        for image, poses in recorded.items():
            torch.testing.assert_close(answers[s, image - 1], torch.stack(poses[-averaged:]).mean(dim=0))


def test_sets_do_not_depend_on_their_batch():
    sets, _ = exact_sets(4, 3)
    starts = torch.zeros(4, 2, 1, 3)
    chosen = solver(ExactPrior(noisy=0.3, **SOFT))
    whole = chosen.solve_views(sets, starts, seed=0)
    index = torch.tensor([2, 0])
    part = chosen.solve_views(ViewSets(sets.images, sets.views[index], sets.ids[index]), starts[:2], seed=0)
    torch.testing.assert_close(part.poses, whole.poses[index], rtol=0, atol=1e-5)
    other = chosen.solve_views(sets, starts, seed=1)
    assert not torch.equal(other.poses, whole.poses)


# ---------------------------------------------------------------- settings


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"longitudes": 0}, "solver.longitudes must be at least 1, got 0"),
        ({"latitudes_degrees": []}, r"solver.latitudes_degrees must be one angle or more, got \[\]"),
        ({"timestep": 1.0}, r"solver.timestep must be in \[0, 1\), got 1.0"),
        ({"timestep": 0.9, "timestep_span": 0.2}, "solver.timestep_span must be from 0 to 1 - timestep, got 0.2"),
        ({"probes": 0}, "solver.probes must be at least 1, got 0"),
        ({"exploration_rate": 0.0}, "solver.exploration_rate must be positive, got 0.0"),
        ({"kept": 0}, "solver.kept must be at least 1, got 0"),
        ({"refinement_steps": -1}, "solver.refinement_steps must be at least 0, got -1"),
        ({"averaged": 0}, "solver.averaged must be at least 1, got 0"),
    ],
)
def test_bad_settings_are_named(settings, message):
    with pytest.raises(UserError, match=message):
        IDPose(ExactPrior(), **settings)
