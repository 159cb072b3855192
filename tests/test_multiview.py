"""Several images at once: the effect of the fit, the joint refinement and each stage alone."""

from __future__ import annotations

import math

import pytest
import torch
from exact_prior import ExactPrior
from solver_problems import ExactModel, FailingPrior, around, exact_pairs, exact_sets
from test_ifusion import WRONG_VALLEY, offsets
from torch import Tensor

from lp_framework.errors import UserError
from lp_framework.geometry import wrap_angle
from lp_framework.models.objectives import PoseKernel
from lp_framework.models.pose_model import FieldValue
from lp_framework.solvers.base import ViewSets
from lp_framework.solvers.multiview import MultiView
from lp_framework.solvers.starts import Random
from lp_framework.solvers.two_stage import TwoStage


class OftenMisled(ExactModel):
    """Is half a turn off for pairs among the first images' latitudes that fall into some bins: about a fifth."""

    def condition(self, reference: Tensor, query: Tensor) -> Tensor:
        misled = (reference[:, :1] * 1000 + query[:, :1] * 1700).long() % 5 == 0
        return super().condition(reference, query) + misled * torch.tensor([0.0, math.pi, 0.0])


class Short(ExactModel):
    """Its field leads to four fifths of the relative pose."""

    def condition(self, reference: Tensor, query: Tensor) -> Tensor:
        return 0.8 * super().condition(reference, query)


class OnTheCircle(ExactModel):
    """The score of the wrapped kernel, which vanishes at the antipode of the truth as well."""

    def field(self, condition: Tensor, pose: Tensor) -> FieldValue:
        return FieldValue(PoseKernel().score(pose, condition), None)


class Blind(ExactModel):
    """Its field is NaN where the reference or the query has the latitude of an unknown image."""

    def __init__(self, unknown: float) -> None:
        self.unknown = unknown

    def condition(self, reference: Tensor, query: Tensor) -> Tensor:
        blind = ((reference - self.unknown).abs()[:, :1] < 1e-6) | ((query - self.unknown).abs()[:, :1] < 1e-6)
        return super().condition(reference, query).masked_fill(blind, torch.nan)


def starts_of(sets: ViewSets, count: int = 2) -> Tensor:
    """Random starts `[S, V - 1, N, 3]`."""
    return Random(count).make(sets.with_first(), 0).unflatten(0, (len(sets), -1))


def distance(poses: Tensor, true: Tensor) -> Tensor:
    """Of poses `[..., 3]`, longitudes on the circle: `[...]`."""
    away = poses - true
    return torch.stack([away[..., 0], wrap_angle(away[..., 1]), away[..., 2]], dim=-1).norm(dim=-1)


@pytest.mark.parametrize("views", [2, 3, 5, 8])
def test_both_stages_find_all_poses_from_random_starts(views):
    sets, true = exact_sets(4, views)
    solution = MultiView(ExactModel(), ExactPrior()).solve_views(sets, starts_of(sets), seed=0)
    assert solution.poses.shape == true.shape
    assert ((solution.poses[..., 1] >= 0) & (solution.poses[..., 1] < 2 * math.pi)).all()
    assert distance(solution.poses, true).max() < 0.05
    assert solution.valid.all()
    assert solution.energies.shape == (4, views, views)
    off_diagonal = ~torch.eye(views, dtype=torch.bool)
    assert solution.energies[:, off_diagonal].max() < 1e-3
    assert solution.energies[:, ~off_diagonal].isnan().all()


def test_the_fit_averages_the_first_stages_noise_over_starts_and_pairs():
    """A single noisy end has a longitude error of 39 degrees; a weighted fit of many, a tenth of it."""
    found = {}
    for views, count in ((2, 1), (2, 8), (8, 1), (8, 8)):
        sets, true = exact_sets(30, views)
        solver = MultiView(ExactModel(), ExactPrior(), second_stage=False)
        found[views, count] = (
            distance(solver.solve_views(sets, starts_of(sets, count), seed=0).poses, true).square().mean().sqrt().item()
        )
    assert found[2, 1] > 0.35
    assert found[2, 1] > 1.5 * found[8, 1] > 1.5 * found[8, 8]
    assert found[2, 1] > 1.5 * found[2, 8] > 1.5 * found[8, 8]
    assert found[8, 8] < 0.06


def test_the_fit_overrules_pairs_where_the_model_is_wrong():
    sets, true = exact_sets(30, 8)
    starts = starts_of(sets)
    solver = MultiView(OftenMisled(), ExactPrior(), gamma=0.0, second_stage=False)
    alone = torch.stack(
        [
            solver.first.solve(sets.pairs([0], [view]), starts[:, view - 1], seed=0).answer()
            for view in range(1, sets.views.shape[1])
        ],
        dim=1,
    )
    wrong = (distance(alone, true) > 1).double().mean()
    assert wrong > 0.1
    together = solver.solve_views(sets, starts, seed=0).poses
    assert (distance(together, true) > 1).double().mean() < 0.1 * wrong


def test_ends_at_the_antipode_have_almost_no_weight():
    """Most of the starts stay where the score vanishes although the truth is half a turn away."""
    sets, true = exact_sets(6, 4)
    starts = true[:, :, None].repeat(1, 1, 3, 1)
    starts[:, :, :2, 1] += math.pi
    starts[:, :, 2, 1] += 1.5
    starts[..., ::2] = 0
    solver = MultiView(OnTheCircle(), ExactPrior(), gamma=0.0, iterations=20, second_stage=False)
    _, weights, _ = solver.measure(sets, starts, seed=0)
    weights = weights[:, 0, 1:]
    assert (weights[..., :2] < 0.1 * weights[..., 2:]).all()
    assert distance(solver.solve_views(sets, starts, seed=0).poses, true).max() < 0.5


def test_the_second_stage_corrects_what_the_first_cannot_see():
    """Relative poses that are all too short agree with one another."""
    sets, true = exact_sets(10, 4)
    starts = starts_of(sets)
    fit, both = (
        MultiView(Short(), ExactPrior(), gamma=0.0, second_stage=second).solve_views(sets, starts, seed=0).poses
        for second in (False, True)
    )
    assert distance(fit, true).median() > 0.2
    assert distance(both, true).max() < 0.05


def test_without_the_first_stage_more_images_are_lost_more_often():
    """Each image ends in the basin of its start; with more images, all are right less often."""
    shares = []
    for views in (2, 5):
        sets, true = exact_sets(40, views)
        solver = MultiView(ExactModel(), ExactPrior(*WRONG_VALLEY), first_stage=False)
        solution = solver.solve_views(sets, starts_of(sets, 1), seed=0)
        shares.append((distance(solution.poses, true) < 0.2).all(dim=1).double().mean().item())
        with_first = MultiView(ExactModel(), ExactPrior(*WRONG_VALLEY), gamma=0.0)
        found = with_first.solve_views(sets, starts_of(sets, 1), seed=0).poses
        assert (distance(found, true) < 0.2).all()
    assert 0.3 < shares[0] < 0.9
    assert shares[1] < 0.6 * shares[0]


def test_without_the_first_stage_the_answer_has_the_lowest_energy():
    sets, true = exact_sets(5, 3)
    prior = ExactPrior(*WRONG_VALLEY)
    solver = MultiView(ExactModel(), prior, first_stage=False)
    starts = true[:, :, None].repeat(1, 1, 3, 1)
    starts[..., ::2] = 0
    starts[:, :, 0, 1] += math.pi - 0.2  # all images in the shallow valley
    starts[:, 1, 2, 1] += math.pi + 0.2  # one of them
    solution = solver.solve_views(sets, starts, seed=0)
    assert distance(solution.poses, true).max() < 0.05
    alone = [solver.solve_views(sets, starts[:, :, [number]], seed=0) for number in range(3)]
    torch.testing.assert_close(alone[1].poses, solution.poses, rtol=0, atol=1e-5)
    for number in (0, 2):
        assert (alone[number].energies.nansum((1, 2)) > solution.energies.nansum((1, 2)) + 0.1).all()


def test_pairs_are_sets_of_two():
    pairs, true = exact_pairs(4)
    starts = around(true, -0.7, 0.5, math.pi)
    solver = MultiView(ExactModel(), ExactPrior(), gamma=0.0)
    solution = solver.solve(pairs, starts, seed=0)
    assert solution.poses.shape == (4, 1, 3)
    assert offsets(solution.poses, true).abs().max() < 0.05
    sets = ViewSets(pairs.images, torch.stack([pairs.reference, pairs.query], dim=1), pairs.ids)
    jointly = solver.solve_views(sets, starts[:, None], seed=0)
    assert torch.equal(jointly.poses, solution.poses)
    torch.testing.assert_close(solution.energies[:, 0], jointly.energies.nanmean(dim=(1, 2)))
    # Without the first stage every start has an end of its own, as in a descent of the prior alone.
    every = MultiView(ExactModel(), ExactPrior(*WRONG_VALLEY), first_stage=False).solve(pairs, starts, seed=0)
    assert every.poses.shape == starts.shape
    assert offsets(every.poses, true)[:, :2].abs().max() < 0.05
    assert offsets(every.poses, true)[:, 2, 1].abs().min() > 2
    assert (every.chosen < 2).all()


def test_its_second_stage_for_a_pair_is_that_of_two_stage():
    """The prior draws nothing here, so the keys of the noise do not matter."""
    pairs, true = exact_pairs(4)
    starts = around(true, 0.4)
    joint = MultiView(ExactModel(), ExactPrior(), first_stage=False).solve(pairs, starts, seed=0)
    alone = TwoStage(ExactModel(), ExactPrior(), iterations=0).solve(pairs, starts, seed=0)
    torch.testing.assert_close(joint.poses, alone.poses, rtol=0, atol=1e-5)


def test_any_batching_and_order_gives_the_same_answers():
    sets, _ = exact_sets(5, 4)
    starts = starts_of(sets)
    for settings in ({}, {"first_stage": False}, {"second_stage": False}):
        solver = MultiView(ExactModel(), ExactPrior(*WRONG_VALLEY, noisy=0.2), **settings)
        whole = solver.solve_views(sets, starts, seed=0)
        for index in torch.tensor([3, 0, 4, 1, 2]).split([2, 3]):
            part = solver.solve_views(ViewSets(sets.images, sets.views[index], sets.ids[index]), starts[index], seed=0)
            assert distance(part.poses, whole.poses[index]).max() < 1e-4


def test_the_seed_decides():
    sets, _ = exact_sets(3, 3)
    solver = MultiView(ExactModel(), ExactPrior(noisy=0.2))
    first, again, other = (solver.solve_views(sets, starts_of(sets), seed).poses for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert (first != other).any(dim=-1).all()


def test_network_passes():
    sets, _ = exact_sets(2, 4)
    images, first, second = 8, 2 * 12 * 3 * (51 + 2), 2 * 12 * (50 + 16)
    cost = MultiView(ExactModel(), ExactPrior()).solve_views(sets, starts_of(sets, 3), seed=0).cost
    assert cost.network_passes == images + first + images + second
    assert cost.seconds > 0
    cost = MultiView(ExactModel(), ExactPrior(), first_stage=False).solve_views(sets, starts_of(sets, 3), seed=0).cost
    assert cost.network_passes == images + 3 * second


def test_an_image_where_the_model_fails_is_reported_and_the_others_are_solved():
    sets, true = exact_sets(3, 4)
    unknown = sets.images.flatten(1)[sets.views[1, 2], 0].item()
    solution = MultiView(Blind(unknown), ExactPrior(), gamma=0.0).solve_views(sets, starts_of(sets), seed=0)
    assert solution.valid.tolist() == [True, False, True]
    assert distance(solution.poses, true)[[0, 2]].max() < 0.05
    fit = MultiView(Blind(unknown), ExactPrior(), gamma=0.0, second_stage=False)
    assert distance(fit.solve_views(sets, starts_of(sets), seed=0).poses, true)[1, [0, 2]].max() < 0.05


def test_a_set_where_the_prior_fails_is_reported_alone():
    sets, true = exact_sets(3, 3)
    starts = true[:, :, None].repeat(1, 1, 2, 1)
    starts[..., 1] += 0.2
    healthy = MultiView(ExactModel(), FailingPrior(1.2), first_stage=False).solve_views(sets, starts, seed=0)
    assert healthy.valid.all()
    starts[1, 1, :, 0] = 1.5
    solution = MultiView(ExactModel(), FailingPrior(1.2), first_stage=False).solve_views(sets, starts, seed=0)
    assert solution.valid.tolist() == [True, False, True]
    assert torch.equal(solution.poses[[0, 2]], healthy.poses[[0, 2]])
    starts[1, :, 1] = true[1]  # the other start of the set is sound
    solution = MultiView(ExactModel(), FailingPrior(1.2), first_stage=False).solve_views(sets, starts, seed=0)
    assert solution.valid.all()
    assert distance(solution.poses, true).max() < 0.05


def test_it_works_in_inference_mode():
    with torch.inference_mode():
        sets, true = exact_sets(2, 3)
        solution = MultiView(ExactModel(), ExactPrior()).solve_views(sets, starts_of(sets), seed=0)
    assert distance(solution.poses, true).max() < 0.05


def test_bad_settings_are_named():
    with pytest.raises(UserError, match=r"first_stage and solver\.second_stage cannot both be false"):
        MultiView(ExactModel(), ExactPrior(), first_stage=False, second_stage=False)
    with pytest.raises(UserError, match=r"solver\.refinement_steps must be at least 1, got 0"):
        MultiView(ExactModel(), ExactPrior(), refinement_steps=0)
    sets, _ = exact_sets(2, 3)
    with pytest.raises(UserError, match=r"starts must be \[S, V - 1, N, 3\] with S = 2 and V - 1 = 2"):
        MultiView(ExactModel(), ExactPrior()).solve_views(sets, torch.zeros(2, 3, 1, 3), seed=0)
