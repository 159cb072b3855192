"""Batched descent against PyTorch's optimizers, one start at a time; and failing starts."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from lp_framework.solvers.descent import Adam, GradientDescent, Plateau, descend, unwrapped

BATCH, STARTS, STEPS = 2, 3, 150
SCALES = torch.linspace(0.3, 3.0, BATCH * STARTS * 4, dtype=torch.float64).view(BATCH, STARTS, 4)
LEVELS = torch.tensor([[0.0, 0.4, 2.0], [1.0, 0.7, -0.5]], dtype=torch.float64)  # subtracted: some sums fall for long


def parameters() -> Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(BATCH, STARTS, 4, generator=generator, dtype=torch.float64)


def energy(poses: Tensor, step: int, scales: Tensor = SCALES, levels: Tensor = LEVELS) -> Tensor:
    """A bowl with ripples that drift, different for every start."""
    return (scales * poses.square() + 0.3 * (3 * poses + 0.1 * step).sin()).sum(dim=-1) - levels


def same(poses: Tensor) -> Tensor:
    return poses


@pytest.mark.parametrize(("kind", "rate"), [("adam", 0.1), ("sgd", 0.05)])
def test_a_batch_is_pytorchs_optimizer_and_schedule_on_each_start_alone(kind, rate):
    begin = parameters()
    optimizer = Adam(begin, rate) if kind == "adam" else GradientDescent(begin, rate)
    found = descend(energy, same, begin, STEPS, optimizer, Plateau(optimizer, 0.6, 4))
    rates = []
    for b in range(BATCH):
        for n in range(STARTS):
            single = begin[b, n].clone().requires_grad_()
            reference = torch.optim.Adam([single], lr=rate) if kind == "adam" else torch.optim.SGD([single], lr=rate)
            schedule = torch.optim.lr_scheduler.ReduceLROnPlateau(reference, factor=0.6, patience=4)
            path, total = [single.detach().clone()], 0.0
            for step in range(STEPS):
                reference.zero_grad()
                loss = energy(single, step, SCALES[b, n], LEVELS[b, n])
                loss.backward()
                reference.step()
                total += loss.item()
                schedule.step(total)
                path.append(single.detach().clone())
            rates.append(reference.param_groups[0]["lr"])
            torch.testing.assert_close(found.trajectory[b, n], torch.stack(path), rtol=0, atol=1e-6)
            assert found.total[b, n].item() == pytest.approx(total, abs=1e-6)
    torch.testing.assert_close(optimizer.rate.flatten(), torch.tensor(rates, dtype=torch.float64))
    drops = (torch.tensor(rates) / rate).log() / torch.tensor(0.6).log()
    assert drops.max() > 5.5  # the schedule was put to the test,
    assert drops.min() < drops.max() - 2  # and differs from start to start
    assert found.valid.all()


@pytest.mark.parametrize("patience", [0, 3])
def test_the_plateau_is_pytorchs_on_any_values(patience):
    """Values that fall by more and by less than the threshold, rise, turn negative, and repeat."""
    generator = torch.Generator().manual_seed(patience)
    moves = torch.randn(200, 40, generator=generator, dtype=torch.float64)
    moves = moves * torch.tensor([1.0, 1e-3, 1e-4, 0.0], dtype=torch.float64)[torch.arange(40) % 4]
    values = 1 + moves.cumsum(dim=0)
    optimizer = GradientDescent(torch.zeros(1, 40, 1, dtype=torch.float64), 1.0)
    plateau, rates = Plateau(optimizer, 0.9, patience), []
    for row in values:
        plateau.step(row[None])
        rates.append(optimizer.rate[0])
    for column in range(40):
        reference = torch.optim.SGD([torch.zeros(1)], lr=1.0)
        schedule = torch.optim.lr_scheduler.ReduceLROnPlateau(reference, factor=0.9, patience=patience)
        for step, value in enumerate(values[:, column]):
            schedule.step(value.item())
            wanted = reference.param_groups[0]["lr"]
            if wanted > 1e-6:  # PyTorch stops at changes of 1e-8
                assert rates[step][column].item() == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize("steps", [0, 1, 10])
def test_the_path_runs_from_the_start_to_the_end(steps):
    begin = parameters()
    found = descend(energy, same, begin, steps, GradientDescent(begin, 0.05))
    assert found.trajectory.shape == (BATCH, STARTS, steps + 1, 4)
    assert torch.equal(found.trajectory[:, :, 0], begin)
    met = sum((energy(found.trajectory[:, :, step], step) for step in range(steps)), torch.zeros(BATCH, STARTS))
    torch.testing.assert_close(found.total, met.double())


class Fails:
    """Energy (or only gradient) of one start is not finite from one step on."""

    def __init__(self, what: str, since: int) -> None:
        self.what, self.since = what, since

    def __call__(self, poses: Tensor, step: int) -> Tensor:
        energies = energy(poses, step)
        if step < self.since:
            return energies
        place = torch.zeros(BATCH, STARTS, dtype=torch.bool)
        place[1, 1] = True
        if self.what == "gradient":
            zero = (poses - poses.detach()).sum(dim=-1)
            return energies + zero.masked_fill(~place, 1.0).sqrt().masked_fill(~place, 0.0)
        return energies.masked_fill(place, torch.nan if self.what == "nan" else torch.inf)


@pytest.mark.parametrize("what", ["nan", "inf", "gradient"])
@pytest.mark.parametrize("since", [0, 4])
def test_a_failing_start_stops_at_its_last_valid_pose_without_affecting_others(what, since):
    begin = parameters()

    def run(landscape):
        optimizer = Adam(begin, 0.1)
        return descend(landscape, same, begin, 20, optimizer, Plateau(optimizer, 0.6, 4))

    healthy, found = run(energy), run(Fails(what, since))
    others = torch.ones(BATCH, STARTS, dtype=torch.bool)
    others[1, 1] = False
    assert torch.equal(found.valid, others)
    assert torch.equal(found.trajectory[others], healthy.trajectory[others])
    assert torch.equal(found.total[others], healthy.total[others])
    last = max(0, since - 1)  # the last pose whose energy was finite
    assert torch.equal(found.trajectory[1, 1, :since], healthy.trajectory[1, 1, :since])
    assert (found.trajectory[1, 1, last:] == healthy.trajectory[1, 1, last]).all()
    assert found.trajectory.isfinite().all()


def test_a_pose_that_is_not_finite_after_the_last_step_is_not_kept():
    begin = torch.full((1, 2, 1), 0.5, dtype=torch.float64)
    begin[0, 1] = 1.5

    def breaks(values: Tensor) -> Tensor:
        return values.masked_fill((values < 1.2) & (values > 0.9), torch.nan)

    found = descend(lambda poses, _: 0.5 * poses.square().sum(dim=-1), breaks, begin, 1, GradientDescent(begin, 0.25))
    assert found.valid.tolist() == [[True, False]]
    assert found.trajectory[0, :, -1, 0].tolist() == [0.375, 1.5]


def test_longitudes_are_continuous_beyond_a_full_turn():
    true = torch.tensor([6.0, 6.2, 6.5, 6.1, 3.3, 0.3, -2.7])
    path = torch.stack([torch.zeros(7), true % (2 * torch.pi), torch.ones(7)], dim=-1)[None, None]
    found = unwrapped(path)
    torch.testing.assert_close(found[0, 0, :, 1], true)
    assert torch.equal(found[..., ::2], path[..., ::2])
