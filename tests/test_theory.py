"""The paper's Theoretical Justification on small closed cases, learned with the objective that training uses.

A case is p(x | y) over a few answers. The learner is a table: one constant of its own for every small cell of noised
poses (and every y), fitted by gradient descent on `ScoreModel.pair_loss`, 1/2 |s - grad log p(noised | true)|^2. The
noised poses come from `NoisedPose`, the targets from `PoseKernel`. Each cell then holds what the objective is minimal
at, to be compared with the closed forms of Proposition 1 and Lemmas 1 and 2 at the cell's mean noised pose.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from lp_framework.models.objectives import NoisedPose, PoseKernel
from lp_framework.models.pose_model import ScoreModel

SIGMA = 0.8
LOW, HIGH = (-1.0, 0.0, -0.8), (1.0, 2 * math.pi, 0.8)
CELLS = 60  # along the longitude, over [0, 2 pi]
DRAWS = 1_500_000


def pair_loss(kernel: PoseKernel, predicted: Tensor, noised: Tensor, true: Tensor) -> Tensor:
    """The score model's own objective, for a network that answers `predicted`."""
    model = SimpleNamespace(kernel=kernel, network=lambda condition, pose: predicted)
    return ScoreModel.pair_loss(model, torch.empty(0), noised, true)  # type: ignore[arg-type]


def learn(noise: str, answers: Tensor, weights: Tensor, target: str = "line") -> tuple[Tensor, Tensor, Tensor]:
    """Learned scores `[C, 3]`, the mean noised poses `[C, 3]` of their cells and the numbers of draws `[C]`."""
    generator = torch.Generator().manual_seed(0)
    true = answers[torch.multinomial(weights, DRAWS, replacement=True, generator=generator)]
    noised = NoisedPose(noise, SIGMA, LOW, HIGH).draw(true, generator)
    inside = (noised[:, 1] >= 0) & (noised[:, 1] < 2 * math.pi)
    true, noised = true[inside].double(), noised[inside].double()
    cell = (noised[:, 1] / (2 * math.pi) * CELLS).long()
    count = torch.bincount(cell, minlength=CELLS).double()

    def cell_mean(values: Tensor) -> Tensor:
        return torch.zeros(CELLS, 3, dtype=torch.float64).index_add_(0, cell, values) / count[:, None]

    kernel = PoseKernel(target, SIGMA)
    table = torch.zeros(CELLS, 3, dtype=torch.float64, requires_grad=True)
    loss = pair_loss(kernel, table[cell], noised, true)
    (gradient,) = torch.autograd.grad(loss.sum(), table)
    # The loss is quadratic with Hessian `count`: one Newton step from anywhere is at the minimum.
    table = table.detach() - gradient / count[:, None]
    again = pair_loss(kernel, table.requires_grad_()[cell], noised, true)
    (gradient,) = torch.autograd.grad(again.mean(), table)
    assert gradient.abs().max() < 1e-9
    return table.detach(), cell_mean(noised), count


def prior_mean(noised: Tensor, answers: Tensor, weights: Tensor, target: str = "line") -> Tensor:
    """Lemma 1: the kernel's scores averaged over p(x | y)."""
    scores = PoseKernel(target, SIGMA).score(noised[:, None], answers.double())
    return (weights.double()[:, None] * scores).sum(dim=1)


def posterior_mean(noised: Tensor, answers: Tensor, weights: Tensor, target: str = "line") -> Tensor:
    """Proposition 1: the same with every answer weighted by p(noised | x) p(x | y).

    The answers of a case differ in longitude alone, so the weights are the same over all of a cell's latitudes and
    radii.
    """
    kernel = PoseKernel(target, SIGMA)
    energies = kernel.energy(noised[:, None], answers.double())
    posterior = torch.softmax(-energies + weights.double().log(), dim=1)
    scores = kernel.score(noised[:, None], answers.double())
    return (posterior[..., None] * scores).sum(dim=1)


def tolerance(count: Tensor) -> Tensor:
    """Six standard errors of a cell, whose targets spread by no more than pi / sigma^2, and a cell's width."""
    return 6 * (math.pi / SIGMA**2) / count.sqrt()[:, None] + 0.04


ONE = torch.tensor([[0.2, 2.0, -0.1]]), torch.tensor([1.0])
TWO = torch.tensor([[0.2, 1.5, -0.1], [0.2, 4.5, -0.1]]), torch.tensor([0.3, 0.7])


@pytest.mark.parametrize("noise", ["uniform", "gaussian"])
def test_with_a_unique_answer_both_noises_learn_its_score(noise):
    """Lemma 2: (x - noised) / sigma^2 from either, so they are equal."""
    answers, weights = ONE
    learned, noised, count = learn(noise, answers, weights)
    reached = count > 300
    assert reached.sum() > 40
    closed = (answers.double() - noised) / SIGMA**2
    torch.testing.assert_close(learned[reached], closed[reached], rtol=0, atol=1e-6)  # every draw agrees: exact


def test_with_two_answers_the_uniform_noise_learns_the_mean_of_their_scores():
    """Lemma 1: a straight line through the mean of the answers, where there is no answer."""
    answers, weights = TWO
    learned, noised, count = learn("uniform", answers, weights)
    assert count.min() > 10_000
    assert ((learned - prior_mean(noised, answers, weights)).abs() < tolerance(count)).all()
    mean = (weights[:, None] * answers).sum(dim=0).double()
    assert ((learned - (mean - noised) / SIGMA**2).abs() < tolerance(count)).all()
    crossings = (learned[:-1, 1] > 0) & (learned[1:, 1] <= 0)  # stable points of the field
    assert crossings.sum() == 1
    assert abs(noised[:-1][crossings][0, 1] - mean[1]) < 0.15


def test_with_two_answers_the_gaussian_noise_learns_the_posterior_mean():
    """Proposition 1: near either answer the field points to it, so both stay."""
    answers, weights = TWO
    learned, noised, count = learn("gaussian", answers, weights)
    reached = count > 3_000
    assert reached.sum() > 50
    assert ((learned - posterior_mean(noised, answers, weights)).abs() < tolerance(count))[reached].all()
    crossings = (learned[:-1, 1] > 0) & (learned[1:, 1] <= 0)
    found = noised[:-1][crossings & reached[:-1]][:, 1]
    assert len(found) == 2
    assert (found - answers[:, 1].double()).abs().max() < 0.2


def test_with_two_answers_the_two_optima_differ_by_far_more_than_the_tolerance():
    """Lemma 2: in general the two optima are not equal; the two tests above tell them apart."""
    answers, weights = TWO
    learned, noised, count = learn("gaussian", answers, weights)
    near = (noised[:, 1] - answers[0, 1]).abs() < 0.5
    gap = (learned - prior_mean(noised, answers, weights))[:, 1].abs()
    assert (gap > 5 * tolerance(count)[:, 0])[near].all()


def test_with_the_periodic_target_two_opposite_answers_leave_a_field_half_a_turn_apart():
    """Lemma 1 on the circle: two equally likely opposite answers have a mean score of half the period."""
    answers = torch.tensor([[0.0, 1.0, 0.0], [0.0, 1.0 + math.pi, 0.0]])
    weights = torch.tensor([0.5, 0.5])
    learned, noised, count = learn("uniform", answers, weights, "periodic")
    assert ((learned - prior_mean(noised, answers, weights, "periodic")).abs() < tolerance(count)).all()
    shifted = learned[:, 1].roll(-CELLS // 2)
    assert ((learned[:, 1] - shifted).abs() < 2 * tolerance(count)[:, 0]).all()


@pytest.mark.parametrize("noise", ["uniform", "gaussian"])
def test_a_network_conditioned_on_the_pair_learns_one_field_per_pair(noise):
    """The condition y matters: a network linear in the pose with an offset per pair has the unique answers' optimum."""
    generator = torch.Generator().manual_seed(0)
    answers = torch.tensor([[0.2, 2.0, -0.1], [-0.3, 4.0, 0.2]], dtype=torch.float64)
    pair = torch.randint(2, (4_000,), generator=generator)
    true = answers[pair]
    noised = NoisedPose(noise, SIGMA, LOW, HIGH).draw(true.float(), generator).double()
    kernel = PoseKernel("line", SIGMA)
    slope = torch.zeros(3, 3, dtype=torch.float64, requires_grad=True)
    offset = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([slope, offset], max_iter=200, tolerance_grad=1e-10, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = pair_loss(kernel, noised @ slope + offset[pair], noised, true).mean()
        loss.backward()
        return loss

    optimizer.step(closure)
    torch.testing.assert_close(slope.detach(), -torch.eye(3, dtype=torch.float64) / SIGMA**2, rtol=0, atol=1e-4)
    torch.testing.assert_close(offset.detach(), answers / SIGMA**2, rtol=0, atol=1e-3)
