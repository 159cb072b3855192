"""The first stage with known fields: decay, spread, independence of starts, choice of the answer."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from lp_framework.errors import UserError
from lp_framework.geometry import wrap_angle
from lp_framework.models.objectives import PoseKernel
from lp_framework.models.pose_model import FieldValue
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.langevin import Langevin

ALPHA = 0.1


class Exact:
    """s(x) = (truth - x) / sigma^2: the line's score. The first three numbers of an image are its pose."""

    has_energy, has_density, choose_by = False, False, "distance"

    def __init__(self, sigma: float = 1.0) -> None:
        self.sigma = sigma

    def encode(self, images: Tensor) -> Tensor:
        return images.flatten(1)[:, :3]

    def condition(self, reference: Tensor, query: Tensor) -> Tensor:
        return query - reference

    def field(self, condition: Tensor, pose: Tensor) -> FieldValue:
        return FieldValue((condition - pose) / self.sigma**2, None)

    def probability(self, condition: Tensor, pose: Tensor) -> None:
        return None


class ExactEnergy(Exact):
    has_energy = True

    def field(self, condition: Tensor, pose: Tensor) -> FieldValue:
        return FieldValue(condition - pose, 0.5 * (condition - pose).square().sum(-1))


class OnTheCircle(Exact):
    """The score of the wrapped kernel, which is 0 at the truth and at its antipode."""

    def field(self, condition: Tensor, pose: Tensor) -> FieldValue:
        return FieldValue(PoseKernel("periodic", self.sigma).score(pose, condition), None)


class FailsFarAway(Exact):
    """Its field is NaN at latitudes above 5."""

    def field(self, condition: Tensor, pose: Tensor) -> FieldValue:
        score = condition - pose
        return FieldValue(score.masked_fill(pose[..., :1] > 5, torch.nan), None)


class Misled(Exact):
    """Pulls poses with a longitude above 4 to 5, where it is as confident as at the truth."""

    def field(self, condition: Tensor, pose: Tensor) -> FieldValue:
        wrong = torch.tensor([0.0, 5.0, 0.0]).to(pose)
        return FieldValue(torch.where(pose[..., 1:2] > 4, wrong, condition) - pose, None)


def pairs(count: int, dtype: torch.dtype = torch.float32, seed: int = 0) -> tuple[Pairs, Tensor]:
    """Pairs of one image at the origin and a query each, with their true relative poses `[B, 3]`."""
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    low, high = torch.tensor([-0.5, 1.0, -0.5]), torch.tensor([0.5, 3.0, 0.5])
    true = (low + unit * (high - low)).to(dtype)
    images = torch.zeros(count + 1, 3, 1, 1, dtype=dtype)
    images[1:, :, 0, 0] = true
    numbers = torch.arange(count)
    return Pairs(images, torch.zeros(count, dtype=torch.long), numbers + 1, 1000 + numbers), true


def some(whole: Pairs, index: Tensor) -> Pairs:
    return Pairs(whole.images, whole.reference[index], whole.query[index], whole.ids[index])


def random_starts(count: int, starts: int, dtype: torch.dtype = torch.float32) -> Tensor:
    generator = torch.Generator().manual_seed(7)
    return (torch.rand(count, starts, 3, generator=generator, dtype=torch.float64) * 3).to(dtype)


# ---------------------------------------------------------------- the appendix: decay and variance


@pytest.mark.parametrize("alpha", [0.1, 0.5, 1.0, 1.5])
def test_without_noise_the_error_decays_as_a_power(alpha):
    """|x_t - x_gt| = M |1 - alpha|^t at every step."""
    problem, true = pairs(6, torch.float64)
    starts = random_starts(6, 4, torch.float64)
    solution = Langevin(Exact(), alpha, gamma=0.0, iterations=50, trajectory=True).solve(problem, starts, seed=0)
    assert solution.trajectory.shape == (6, 4, 51, 3)
    assert torch.equal(solution.trajectory[:, :, 0], starts)
    time = torch.arange(51, dtype=torch.float64)
    expected = (starts - true[:, None])[:, :, None] * ((1 - alpha) ** time)[:, None]
    torch.testing.assert_close(solution.trajectory - true[:, None, None], expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("gamma", [(0.0, 0.3, 0.0), (0.05, 0.2, 0.1)])
@pytest.mark.parametrize("iterations", [5, 50])
def test_with_noise_the_mean_decays_and_the_variance_is_the_appendixs(gamma, iterations):
    """E[x_t - x_gt] = (1 - alpha)^t (x_0 - x_gt); Var = gamma^2 / (2 alpha - alpha^2) (1 - (1 - alpha)^(2 t))."""
    count, each = 400, 20
    problem, true = pairs(count, torch.float64)
    offset = torch.tensor([0.3, 1.0, -0.2], dtype=torch.float64)
    starts = (true + offset)[:, None].expand(-1, each, -1).contiguous()
    solver = Langevin(Exact(), ALPHA, gamma, iterations, trajectory=True)
    path = solver.solve(problem, starts, seed=0).trajectory
    end = (path[:, :, -1] - true[:, None]).flatten(0, 1)
    decay = (1 - ALPHA) ** iterations
    variance = torch.tensor(gamma, dtype=torch.float64).square() / (2 * ALPHA - ALPHA**2) * (1 - decay**2)
    error = (variance / len(end)).sqrt()
    assert ((end.mean(dim=0) - decay * offset).abs() <= 4 * error + 1e-12).all()
    # The sample variance of n normal draws has a relative standard error of sqrt(2 / n).
    assert ((end.var(dim=0) - variance).abs() <= 4 * math.sqrt(2 / len(end)) * variance + 1e-12).all()


def test_the_papers_noise_leaves_a_longitude_spread_of_39_degrees():
    problem, true = pairs(2_000)
    solution = Langevin(Exact()).solve(problem, true[:, None] + torch.zeros(1, 4, 3), seed=0)
    offset = (solution.poses - true[:, None]).flatten(0, 1)
    spread = torch.rad2deg(wrap_angle(offset[:, 1])).std().item()
    assert spread == pytest.approx(39.4, abs=1.0)
    assert offset[:, ::2].abs().max() < 1e-5


def test_noises_of_pairs_starts_and_steps_are_uncorrelated():
    problem, true = pairs(300, torch.float64)
    starts = true[:, None].expand(-1, 4, -1).contiguous()
    solver = Langevin(Exact(), ALPHA, (0.3, 0.3, 0.3), 8, trajectory=True)
    path = solver.solve(problem, starts, seed=0).trajectory - true[:, None, None]
    noise = path[:, :, 1:] - (1 - ALPHA) * path[:, :, :-1]
    for rows in (noise.flatten(1).T, noise.transpose(0, 1).flatten(1), noise.movedim(2, 0).flatten(1)):
        correlation = torch.corrcoef(rows) - torch.eye(len(rows), dtype=torch.float64)
        assert correlation.abs().max() < 5 / math.sqrt(rows.shape[1])


# ---------------------------------------------------------------- what a result depends on


def test_any_batching_and_order_gives_the_same_answers_bit_for_bit():
    problem, _ = pairs(7)
    starts, solver = random_starts(7, 5), Langevin(Exact())
    whole = solver.solve(problem, starts, seed=0)
    for split in ([3, 4], [1, 1, 5], [6, 1]):
        parts = torch.randperm(7, generator=torch.Generator().manual_seed(sum(split[:1]))).split(split)
        for index in parts:
            part = solver.solve(some(problem, index), starts[index], seed=0)
            for quantity in ("poses", "energies", "chosen", "valid"):
                assert torch.equal(getattr(part, quantity), getattr(whole, quantity)[index])


def test_starts_do_not_influence_one_another():
    problem, _ = pairs(3)
    starts, solver = random_starts(3, 4), Langevin(Exact())
    whole = solver.solve(problem, starts, seed=0)
    other = starts.clone()
    other[:, 2:] += 1
    assert torch.equal(solver.solve(problem, other, seed=0).poses[:, :2], whole.poses[:, :2])
    assert torch.equal(solver.solve(problem, starts[:, :2], seed=0).poses, whole.poses[:, :2])


def test_the_seed_decides_the_noise():
    problem, _ = pairs(3)
    starts, solver = random_starts(3, 4), Langevin(Exact())
    first, again, other = (solver.solve(problem, starts, seed) for seed in (0, 0, 1))
    assert torch.equal(first.poses, again.poses)
    assert (first.poses != other.poses)[..., 1].all()


def test_image_features_are_computed_once_an_image():
    class Counting(Exact):
        encoded = 0

        def encode(self, images: Tensor) -> Tensor:
            Counting.encoded += len(images)
            return super().encode(images)

    problem, _ = pairs(6)
    solution = Langevin(Counting(), iterations=10).solve(problem, random_starts(6, 4), seed=0)
    assert Counting.encoded == 7
    assert solution.cost.network_passes == 7 + 6 * 4 * (11 + 2)  # two for the slope of the last score
    assert solution.cost.seconds > 0


def test_longitudes_are_reduced_to_one_turn():
    problem, _ = pairs(50)
    problem.images[1:, 1] += torch.linspace(-20, 20, 50)[:, None, None]
    solution = Langevin(Exact(), gamma=0, iterations=200).solve(problem, random_starts(50, 2), seed=0)
    longitude = solution.poses[..., 1]
    assert ((longitude >= 0) & (longitude < 2 * math.pi + 1e-6)).all()
    true = problem.images[1:, 1, 0, 0]
    assert wrap_angle(longitude - true[:, None]).abs().max() < 1e-4


def test_no_iterations_return_the_starts():
    problem, _ = pairs(3)
    starts = random_starts(3, 2)
    assert torch.equal(Langevin(Exact(), iterations=0).solve(problem, starts, seed=0).poses, starts)


# ---------------------------------------------------------------- the choice


def distances(solver: Langevin, problem: Pairs, true: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
    """The distances to the truth of the chosen starts `[B]` and of all `[B, N]`."""
    solution = solver.solve(problem, starts, seed=0)
    offset = solution.poses - true[:, None]
    offset[..., 1] = wrap_angle(offset[..., 1])
    every = offset.norm(dim=-1)
    chosen = every.gather(1, solution.chosen[:, None])[:, 0]
    answer = solution.answer() - true
    answer[:, 1] = wrap_angle(answer[:, 1])
    assert torch.equal(answer.norm(dim=-1), chosen)
    return chosen, every


def test_the_smallest_estimated_distance_chooses_the_nearest_end():
    problem, true = pairs(100)
    solver = Langevin(Exact(), gamma=(0.2, 0.2, 0.2), iterations=20, choose_by="distance")
    chosen, every = distances(solver, problem, true, random_starts(100, 6))
    torch.testing.assert_close(chosen, every.min(dim=1).values)
    assert chosen.mean() < 0.6 * every.mean()


@pytest.mark.parametrize("model", [Exact, OnTheCircle])
@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.0])
def test_the_distance_rises_up_to_the_antipode(model, sigma):
    problem, true = pairs(2, torch.float64)
    away = torch.linspace(0, math.pi, 100, dtype=torch.float64)
    starts = true[:, None].repeat(1, 100, 1)
    starts[..., 1] += away
    distance = Langevin(model(sigma), gamma=0, iterations=0).solve(problem, starts, seed=0).energies
    assert (distance.diff(dim=1) > 0).all()
    torch.testing.assert_close(distance[:, 0], torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-6)
    torch.testing.assert_close(distance[:, -1], torch.full((2,), math.pi, dtype=torch.float64), rtol=0.05, atol=0)


def test_an_end_at_the_antipode_is_not_chosen():
    """The score vanishes there, as at the truth."""
    problem, true = pairs(4, torch.float64)
    starts = true[:, None].repeat(1, 3, 1)
    starts[..., 1] += torch.tensor([math.pi, math.pi - 0.01, 2.0])
    solution = Langevin(OnTheCircle(), gamma=0, iterations=5).solve(problem, starts, seed=0)
    assert (solution.chosen == 2).all()


def test_agreement_ignores_a_wrong_minority():
    problem, true = pairs(40)
    starts = random_starts(40, 5)  # longitudes up to 3: to the truth
    starts[::2, :2, 1] = 5.0  # two of five are misled
    starts[1::2, 3:, 1] = 5.0
    solver = Langevin(Misled(), gamma=0, choose_by="agreement")
    chosen, every = distances(solver, problem, true, starts)
    assert every.max() > 1
    assert chosen.max() < 0.05
    assert chosen.mean() < 0.2 * every.mean()
    by_distance, _ = distances(Langevin(Misled(), gamma=0, choose_by="distance"), problem, true, starts)
    assert by_distance.max() > 1  # what is as sure of itself elsewhere, the field cannot tell


def test_agreement_beats_a_random_start_with_noise():
    problem, true = pairs(200)
    solver = Langevin(Exact(), gamma=(0.2, 0.2, 0.2), choose_by="agreement")
    chosen, every = distances(solver, problem, true, random_starts(200, 7))
    assert chosen.mean() < 0.9 * every.mean()


def test_an_energy_model_chooses_the_lowest_energy():
    problem, true = pairs(50)
    solver = Langevin(ExactEnergy(), gamma=(0.2, 0.2, 0.2), choose_by="energy")
    chosen, every = distances(solver, problem, true, random_starts(50, 6))
    torch.testing.assert_close(chosen, every.min(dim=1).values)


def test_a_score_model_has_no_energy_to_choose_by():
    with pytest.raises(UserError, match="choose_by=energy needs model=energy; a score model has no energy"):
        Langevin(Exact(), choose_by="energy")


@pytest.mark.parametrize("choose_by", ["distance", "agreement"])
@pytest.mark.parametrize("place", [0, 2, 3])
def test_a_start_where_the_model_fails_stops_alone_and_is_not_chosen(choose_by, place):
    problem, _ = pairs(3)
    starts = random_starts(3, 4)
    solver = Langevin(FailsFarAway(), choose_by=choose_by)
    healthy = solver.solve(problem, starts, seed=0)
    assert healthy.valid.all()
    broken = starts.clone()
    broken[1, place, 0] = 6.0
    solution = solver.solve(problem, broken, seed=0)
    expected = torch.ones(3, 4, dtype=torch.bool)
    expected[1, place] = False
    assert torch.equal(solution.valid, expected)
    assert torch.equal(solution.poses[expected], healthy.poses[expected])
    assert solution.energies[expected].isfinite().all()
    assert solution.chosen[1] != place
    assert torch.equal(solution.chosen[::2], healthy.chosen[::2])


def test_where_every_start_fails_none_is_valid_and_an_answer_still_comes():
    problem, _ = pairs(2)
    solution = Langevin(FailsFarAway()).solve(problem, random_starts(2, 3) + 10, seed=0)
    assert not solution.valid.any()
    assert solution.answer().shape == (2, 3)


# ---------------------------------------------------------------- settings and input


@pytest.mark.parametrize("gamma", [0.3, (0.0, 0.3, 0.0), [0, 0.3, 0]])
def test_one_gamma_is_the_longitudes(gamma):
    assert Langevin(Exact(), gamma=gamma).gamma == [0.0, 0.3, 0.0]


@pytest.mark.parametrize("gamma", [-0.1, (0.1, 0.2), (0.1, 0.2, -0.3), math.nan, math.inf, (1, 2, 3, 4)])
def test_bad_gammas_are_named(gamma):
    with pytest.raises(UserError, match=r"solver\.gamma must be one number .* or three .* none negative, got"):
        Langevin(Exact(), gamma=gamma)


@pytest.mark.parametrize(("sigma", "alpha"), [(1, 0.0), (1, -0.1), (1, 2.0), (1, math.nan), (0.5, 0.5), (2.0, 8.0)])
def test_an_alpha_that_does_not_converge_is_refused(sigma, alpha):
    with pytest.raises(UserError, match=rf"solver\.alpha must be between 0 and {2 * sigma**2:g}, twice"):
        Langevin(Exact(sigma), alpha=alpha)


@pytest.mark.parametrize(("sigma", "alpha"), [(0.5, 0.49), (2.0, 7.9)])
def test_an_alpha_below_twice_the_square_of_sigma_converges(sigma, alpha):
    problem, true = pairs(3, torch.float64)
    found = Langevin(Exact(sigma), alpha, gamma=0.0, iterations=1000).solve(problem, random_starts(3, 2), seed=0)
    assert wrap_angle(found.poses - true[:, None]).abs().max() < 1e-3


def test_negative_iterations_are_refused():
    with pytest.raises(UserError, match=r"solver\.iterations must be at least 0, got -1"):
        Langevin(Exact(), iterations=-1)


@pytest.mark.parametrize("shape", [(3, 3), (2, 4, 3), (3, 4, 2), (3, 0, 3)])
def test_starts_of_a_wrong_shape_are_refused(shape):
    problem, _ = pairs(3)
    with pytest.raises(UserError, match=r"starts must be \[B, N, 3\] with B = 3, got"):
        Langevin(Exact()).solve(problem, torch.zeros(shape), seed=0)


def test_starts_that_are_not_numbers_are_refused():
    problem, _ = pairs(3)
    with pytest.raises(UserError, match="starts must be finite"):
        Langevin(Exact()).solve(problem, torch.full((3, 1, 3), torch.nan), seed=0)


def test_pairs_of_wrong_shapes_are_refused():
    images, index = torch.zeros(2, 3, 4, 4), torch.zeros(2, dtype=torch.long)
    with pytest.raises(UserError, match=r"images must be \[I, 3, H, W\], got \[2, 4, 4\]"):
        Pairs(images[:, 0], index, index, index)
    with pytest.raises(UserError, match=r"reference, query and ids must be \[B\] each, got"):
        Pairs(images, index, index[:1], index)
