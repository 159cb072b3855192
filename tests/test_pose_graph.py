"""Absolute poses from relative ones: exact if they agree, and robust to outliers."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from lp_framework.geometry import wrap_angle
from lp_framework.solvers.pose_graph import fit_views

TURN = torch.tensor([0.0, 2 * math.pi, 0.0], dtype=torch.float64)


def uniform(generator: torch.Generator, *shape: int) -> Tensor:
    """Numbers `[*shape, 3]` like relative poses: any longitude, latitude and radius within 0.8."""
    unit = 2 * torch.rand(*shape, 3, generator=generator, dtype=torch.float64) - 1
    return unit * torch.tensor([0.8, math.pi, 0.8], dtype=torch.float64)


def measured_sets(
    sets: int, views: int, noise: float = 0.0, outliers: int = 0, seed: int = 0
) -> tuple[Tensor, Tensor, Tensor]:
    """True poses relative to the first image `[S, V, 3]`, measurements `[S, V, V, 1, 3]`, weights of 1.

    So many unordered pairs of each set have a random relative pose, another in either direction.
    """
    generator = torch.Generator().manual_seed(seed)
    true = uniform(generator, sets, views) / 2
    measured = true[:, None] - true[:, :, None]
    measured += noise * torch.randn(measured.shape, generator=generator, dtype=torch.float64)
    rows, columns = torch.triu_indices(views, views, 1)
    for each in range(sets):
        wrong = torch.randperm(len(rows), generator=generator)[:outliers]
        i, j = rows[wrong], columns[wrong]
        measured[each, i, j], measured[each, j, i] = uniform(generator, outliers), uniform(generator, outliers)
    relative = true - true[:, :1]
    return relative, measured[:, :, :, None], torch.ones(sets, views, views, 1, dtype=torch.float64)


def distance(poses: Tensor, true: Tensor) -> Tensor:
    """Of poses `[..., 3]`, longitudes on the circle: `[...]`."""
    offset = poses - true
    return torch.stack([offset[..., 0], wrap_angle(offset[..., 1]), offset[..., 2]], dim=-1).norm(dim=-1)


@pytest.mark.parametrize("views", range(2, 9))
def test_relative_poses_that_agree_are_returned(views):
    true, measured, weights = measured_sets(20, views)
    poses = fit_views(measured, weights)
    assert poses.shape == true.shape
    assert poses[:, 0].eq(0).all()
    assert ((poses[..., 1] >= 0) & (poses[..., 1] < 2 * math.pi)).all()
    assert distance(poses, true).max() < 1e-9


@pytest.mark.parametrize(("views", "wrong"), [(4, 2), (5, 4), (6, 6), (7, 8), (8, 11)])
def test_two_fifths_of_the_pairs_may_be_wrong(views, wrong):
    """The poses are those of the pairs that are right; beyond two fifths, the result depends on chance."""
    true, measured, weights = measured_sets(100, views, outliers=wrong)
    found = distance(fit_views(measured, weights), true).amax(dim=1) < 0.05
    assert found.double().mean() >= 0.9


def test_with_noise_and_outliers_it_is_about_least_squares_on_the_inliers():
    clean = fit_views(*measured_sets(100, 8, noise=0.05)[1:])
    true, measured, weights = measured_sets(100, 8, noise=0.05, outliers=8)
    poses = fit_views(measured, weights)
    # Each of the other images is tied to the first by 14 measurements and 6 x 7 ways around.
    assert distance(clean, true)[:, 1:].square().mean().sqrt() < 0.05
    assert distance(poses, true)[:, 1:].square().mean().sqrt() < 0.06


def test_more_images_give_a_better_pose_than_the_pair_alone():
    errors = [
        distance(fit_views(measured, weights), true)[:, 1:].square().mean().sqrt().item()
        for true, measured, weights in (measured_sets(200, views, noise=0.05) for views in (2, 4, 8))
    ]
    assert errors[0] > 1.2 * errors[1] > 1.4 * errors[2]


def test_two_images_have_the_mean_of_both_directions():
    _, measured, weights = measured_sets(50, 2, noise=0.03)
    both = torch.stack([measured[:, 0, 1, 0], -measured[:, 1, 0, 0]])
    assert distance(fit_views(measured, weights)[:, 1], both.mean(dim=0)).max() < 1e-6


def test_two_directions_that_contradict_each_other_leave_one_of_them():
    _, measured, weights = measured_sets(1, 2)
    measured[0, 1, 0, 0, 1] += 2.0
    pose = fit_views(measured, weights)[:, 1]
    ends = torch.stack([measured[:, 0, 1, 0], -measured[:, 1, 0, 0]])
    assert distance(pose, ends).min() < 0.02


def test_the_mean_across_the_longitude_0_is_there():
    measured = torch.zeros(1, 2, 2, 1, 3, dtype=torch.float64)
    measured[0, 0, 1, 0, 1], measured[0, 1, 0, 0, 1] = 2 * math.pi - 0.05, -0.07
    pose = fit_views(measured, torch.ones(1, 2, 2, 1))[0, 1]
    assert pose[1].item() == pytest.approx(0.01, abs=1e-9)


@pytest.mark.parametrize("wrong", [0, 4])
def test_the_order_of_the_images_does_not_matter(wrong):
    _, measured, weights = measured_sets(30, 6, noise=0.05, outliers=wrong)
    poses = fit_views(measured, weights)
    order = torch.tensor([0, 4, 2, 5, 1, 3])
    shuffled = fit_views(measured[:, order][:, :, order], weights)
    assert distance(shuffled, poses[:, order]).max() < 1e-6
    other_first = torch.tensor([3, 1, 2, 0, 4, 5])  # another origin, the same poses towards each other
    moved = fit_views(measured[:, other_first][:, :, other_first], weights)
    assert distance(moved - moved[:, 3:4], poses[:, other_first]).max() < 1e-6


def test_a_set_does_not_depend_on_the_others_nor_a_longitude_on_its_turn():
    _, measured, weights = measured_sets(10, 5, noise=0.05, outliers=2)
    poses = fit_views(measured, weights)
    assert distance(fit_views(measured[3:4], weights[3:4]), poses[3:4]).max() < 1e-9
    turns = torch.randint(-3, 4, measured.shape[:-1], generator=torch.Generator().manual_seed(0))
    assert distance(fit_views(measured + turns[..., None] * TURN, weights), poses).max() < 1e-9


def test_only_the_proportion_of_the_weights_counts():
    _, measured, weights = measured_sets(10, 5, noise=0.05, outliers=2)
    assert distance(fit_views(measured, 1e-3 * weights), fit_views(measured, weights)).max() < 1e-9
    measured[:, 1, 2] = 7.0  # what weighs nothing may be anything
    weights[:, 1, 2] = 0
    elsewhere = measured.clone()
    elsewhere[:, 1, 2] = -3.0
    assert torch.equal(fit_views(elsewhere, weights), fit_views(measured, weights))


def test_among_several_measurements_of_a_pair_the_rest_of_the_set_decides():
    """Every pair is measured rightly, and seven of 15 half a turn off as well, with equal weight."""
    true, measured, _ = measured_sets(50, 6, noise=0.02, outliers=0)
    half = measured + TURN / 2
    measured = torch.cat([measured, half], dim=3)
    weights = torch.ones(measured.shape[:-1], dtype=torch.float64)
    rows, columns = torch.triu_indices(6, 6, 1)
    generator = torch.Generator().manual_seed(1)
    for each in range(50):
        right_only = torch.randperm(15, generator=generator)[:8]
        weights[each, rows[right_only], columns[right_only], 1] = 0
        weights[each, columns[right_only], rows[right_only], 1] = 0
    found = distance(fit_views(measured, weights), true).amax(dim=1) < 0.1
    assert found.double().mean() > 0.9


def test_non_finite_measurements_are_ignored():
    true, measured, weights = measured_sets(10, 5)
    measured[:, 0, 1] = torch.nan
    measured[:, 3, 2, 0, 0] = torch.inf
    assert distance(fit_views(measured, weights), true).max() < 1e-9


def test_an_image_without_measurements_does_not_affect_the_others():
    true, measured, weights = measured_sets(10, 5)
    measured[:, 2], measured[:, :, 2] = torch.nan, torch.nan
    poses = fit_views(measured, weights)
    assert poses.isfinite().all()
    others = torch.tensor([0, 1, 3, 4])
    assert distance(poses, true)[:, others].max() < 1e-6
    assert fit_views(torch.full_like(measured, torch.nan), weights).isfinite().all()
