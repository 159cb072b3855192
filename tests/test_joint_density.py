"""Several views' densities together: against all combinations by hand, and closed forms."""

import itertools
import math

import pytest
import torch

from lp_framework.models.pose_density import GRID, PoseDensity
from lp_framework.solvers.joint_density import _ascended, _sampled, joint_density

TURN = 2 * math.pi
LONGITUDES = torch.linspace(0, TURN, GRID + 1)[:-1]


def peaks(*of: tuple[float, float], sharp: float = 30.0) -> torch.Tensor:
    """Log-density `[GRID]` with peaks at longitudes (degrees), each of a share."""
    centres, shares = torch.tensor(of).T
    return (
        (shares * torch.exp(sharp * ((LONGITUDES[:, None] - centres.deg2rad()).cos() - 1))).sum(dim=1).add(1e-4).log()
    )


def density(logits: list[torch.Tensor], mean: torch.Tensor | None = None) -> PoseDensity:
    mean = torch.zeros(len(logits), 2) if mean is None else mean
    return PoseDensity(torch.stack(logits), mean, torch.full((len(logits), 2), 0.1), 0.15)


def test_two_views_give_the_mean_of_both_directions():
    forth, back = peaks((100, 0.7), (280, 0.3)), peaks((260, 0.5), (80, 0.5))
    found = joint_density(density([forth, back]), 1, torch.tensor([3]), seed=0)
    mirrored = torch.tensor([back[-each % GRID] for each in range(GRID)])
    wanted = ((forth.log_softmax(0) + mirrored.log_softmax(0)) / 2).log_softmax(0)
    torch.testing.assert_close(found.logits.log_softmax(-1)[0], wanted, rtol=0, atol=1e-4)
    assert found.deviation.flatten().tolist() == pytest.approx([0.1, 0.1])


def test_all_pairs_together_resolve_what_one_pair_cannot():
    """Pairs with the first view prefer half a turn; the other pairs are right, and one near pair is certain."""
    places = [0.0, 120.0, 200.0, 330.0]
    wrong = {(0, 1), (1, 0), (0, 2), (2, 0)}
    logits = []
    for a, b in itertools.permutations(range(4), 2):
        true = places[b] - places[a]
        share = 0.4 if (a, b) in wrong else 0.9
        logits.append(peaks((true, share), (true + 180, 1 - share)))
    alone = density(logits)
    assert alone[0:1].modes(1).rad2deg().item() == pytest.approx(300, abs=1)
    found = joint_density(alone, 1, torch.tensor([5]), seed=0)
    assert found.modes(1).rad2deg().flatten().tolist() == pytest.approx(places[1:], abs=1.3)


@pytest.mark.parametrize("seed", range(3))
def test_the_most_likely_longitudes_are_those_of_all_combinations(seed: int):
    random = torch.Generator().manual_seed(seed)
    logits = []
    for _ in range(6):
        at, share = 360 * torch.rand(3, generator=random), torch.rand(3, generator=random)
        logits.append(peaks(*zip(at.tolist(), share.tolist(), strict=True)))
    table = {pair: each.log_softmax(0) for pair, each in zip(itertools.permutations(range(3), 2), logits, strict=True)}

    def both(a: int, b: int) -> torch.Tensor:
        return (table[a, b] + table[b, a].flip(0).roll(1)) / 2

    turn = (torch.arange(GRID)[None] - torch.arange(GRID)[:, None]) % GRID  # of the second view to the third
    total = both(0, 1)[:, None] + both(0, 2)[None] + both(1, 2)[turn]
    log_prob = torch.zeros(1, 3, 3, GRID)
    for a, b in itertools.permutations(range(3), 2):
        log_prob[0, a, b] = both(a, b)
    climbed = _ascended(log_prob, _sampled(log_prob, torch.tensor([1]), seed=0))[0].tolist()
    assert list(divmod(int(total.argmax()), GRID)) in [places[1:] for places in climbed]


def test_latitudes_and_radii_agree_by_least_squares_and_near_pairs_count_more():
    true = torch.tensor([[0.0, 0.0], [0.3, -0.1], [-0.2, 0.2]])
    pairs = list(itertools.permutations(range(3), 2))
    mean = torch.stack([true[b] - true[a] for a, b in pairs])
    flat = [peaks((0, 1.0))] * 6
    found = joint_density(density(flat, mean), 1, torch.tensor([1]), seed=0)
    torch.testing.assert_close(found.mean, true[1:], rtol=0, atol=1e-5)
    off = mean.clone()
    off[[1, 4]] += torch.tensor([[0.5, 0.0], [-0.5, 0.0]])  # the pair of the first and the last view, both directions
    sure = PoseDensity(torch.stack(flat), off, torch.full((6, 2), 0.01), 0.15)
    sure.deviation[[1, 4]] = 1.0
    assert joint_density(sure, 1, torch.tensor([1]), seed=0).mean[1, 0].item() == pytest.approx(-0.2, abs=1e-3)


def test_a_set_does_not_depend_on_those_beside_it():
    random = torch.Generator().manual_seed(0)
    logits = [peaks((360 * torch.rand((), generator=random).item(), 1.0), (90.0, 0.5)) for _ in range(24)]
    together = joint_density(density(logits), 2, torch.tensor([3, 8]), seed=0)
    alone = joint_density(density(logits[12:]), 1, torch.tensor([8]), seed=0)
    torch.testing.assert_close(together.logits[3:], alone.logits, rtol=0, atol=1e-6)
