"""Every registered solver satisfies the contract of the interface."""

from __future__ import annotations

import inspect

import pytest
import torch
from baseline_stand_ins import know, packages
from exact_prior import ExactPrior
from solver_problems import ExactModel, around, exact_pairs, exact_sets, some

from lp_framework import registry
from lp_framework.errors import UserError
from lp_framework.solvers.base import Solution, Solver, ViewSets

registry.discover()
SOLVERS = registry.names("solver")
FEW = {"steps": 60, "refinement_steps": 60}  # for time's sake, of the solvers that have such a setting

WITHOUT_NETWORK = ("features",)  # by default


def build(name: str, noisy: float = 0.1, **settings: int) -> Solver:
    """The solver with what it declares or imports: a prior, a model, packages and matches that know the answer."""
    solver = registry.get("solver", name)
    parts = {"prior": ExactPrior([0.0, torch.pi], [0.0, 0.3], stiffness=0.05, noisy=noisy), "model": ExactModel()}
    wanted = {part: parts[part] for part in registry.component_names(solver)}
    few = {setting: count for setting, count in FEW.items() if setting in inspect.signature(solver).parameters}
    with packages():
        return know(registry.build("solver", {"name": name, **few, **settings}, **wanted))


def same(first: Solution, second: Solution, within: float = 0.0) -> bool:
    """Equal, but for the time; `within` allows for arithmetic in another order."""
    near = torch.allclose(first.poses, second.poses, rtol=0, atol=within)
    near &= torch.allclose(first.energies, second.energies, rtol=max(within, 1e-12), atol=within, equal_nan=True)
    return near and torch.equal(first.chosen, second.chosen) and torch.equal(first.valid, second.valid)


@pytest.mark.parametrize("name", SOLVERS)
def test_a_solution_has_its_shapes_and_finite_numbers(name):
    pairs, true = exact_pairs(3)
    starts = around(true, 0.3, -0.4, 1.0, 2.0)
    solution = build(name).solve(pairs, starts, seed=0)
    count = solution.poses.shape[1]
    assert solution.poses.shape == (3, count, 3)
    assert solution.energies.shape == solution.valid.shape == (3, count)
    assert solution.chosen.shape == (3,)
    assert ((solution.chosen >= 0) & (solution.chosen < count)).all()
    assert solution.valid.dtype == torch.bool and solution.valid.all()
    assert solution.poses.isfinite().all() and solution.energies.isfinite().all()
    assert ((solution.poses[..., 1] >= 0) & (solution.poses[..., 1] < 2 * torch.pi)).all()
    assert not solution.poses.requires_grad
    assert (solution.cost.network_passes > 0) == (name not in WITHOUT_NETWORK) and solution.cost.seconds > 0
    assert solution.probability is None  # the model has no density
    assert torch.equal(solution.answer(), solution.poses[torch.arange(3), solution.chosen])


@pytest.mark.parametrize("name", SOLVERS)
def test_the_same_seed_gives_the_same_solution_and_inputs_are_left_alone(name):
    pairs, true = exact_pairs(3)
    starts = around(true, 0.3, -0.4)
    before = starts.clone(), pairs.images.clone()
    first, again = (build(name).solve(pairs, starts, seed=5) for _ in range(2))
    assert same(first, again)
    assert torch.equal(starts, before[0]) and torch.equal(pairs.images, before[1])


@pytest.mark.parametrize("name", SOLVERS)
def test_another_seed_gives_another_solution_where_there_is_anything_random(name):
    pairs, true = exact_pairs(3)
    starts = around(true, 0.3, -0.4)
    solver = build(name)
    random = "prior" in registry.component_names(type(solver)) or any(getattr(solver, "gamma", ()))
    first, other = (solver.solve(pairs, starts, seed=seed) for seed in (0, 1))
    assert torch.equal(first.poses, other.poses) != random


@pytest.mark.parametrize("name", SOLVERS)
def test_a_batch_is_its_pairs_one_by_one_in_any_order(name):
    pairs, true = exact_pairs(4)
    starts, solver = around(true, 0.3, -0.4, 1.5), build(name)
    whole = solver.solve(pairs, starts, seed=0)
    for index in torch.tensor([2, 0, 3, 1]).split([1, 3]):
        part = solver.solve(some(pairs, index), starts[index], seed=0)
        for quantity in ("poses", "energies"):
            torch.testing.assert_close(getattr(part, quantity), getattr(whole, quantity)[index], rtol=1e-4, atol=1e-4)
        assert torch.equal(part.chosen, whole.chosen[index])


@pytest.mark.parametrize("name", SOLVERS)
def test_it_solves_in_inference_mode(name):
    """As under `Trainer.test`, which makes its tensors there."""
    with torch.inference_mode():
        pairs, true = exact_pairs(2)
        inside = build(name).solve(pairs, around(true, 0.3, -0.4), seed=0)
    pairs, true = exact_pairs(2)
    assert same(inside, build(name).solve(pairs, around(true, 0.3, -0.4), seed=0), within=1e-6)


@pytest.mark.parametrize("name", SOLVERS)
def test_near_the_truth_it_stays_there(name):
    """Its answer, for the median pair: within what the noises of the first stage and of the prior leave."""
    pairs, true = exact_pairs(9)
    solution = build(name, noisy=0.0).solve(pairs, around(true, 0.2, -0.2, 0.1), seed=0)
    away = solution.answer() - true
    away[:, 1] = torch.remainder(away[:, 1] + torch.pi, 2 * torch.pi) - torch.pi
    assert away.abs().max(dim=1).values.median() < 0.5


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("views", [2, 3])
def test_sets_of_images(name, views):
    sets, _ = exact_sets(2, views)
    generator = torch.Generator().manual_seed(0)
    starts = torch.rand(2, views - 1, 3, 3, generator=generator) * torch.tensor([0.3, 6.0, 0.0])
    solution = build(name).solve_views(sets, starts, seed=0)
    assert solution.poses.shape == (2, views - 1, 3)
    assert solution.energies.shape == (2, views, views)
    assert solution.valid.shape == (2,)
    assert solution.valid.all() and solution.poses.isfinite().all()
    assert solution.energies[:, 0, 1:].isfinite().all()
    assert solution.energies.diagonal(dim1=1, dim2=2).isnan().all()
    assert (solution.cost.network_passes > 0) == (name not in WITHOUT_NETWORK)
    again = build(name).solve_views(sets, starts, seed=0)
    assert torch.equal(solution.poses, again.poses)
    last = ViewSets(sets.images, sets.views[1:], sets.ids[1:])
    torch.testing.assert_close(
        build(name).solve_views(last, starts[1:], seed=0).poses, solution.poses[1:], rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("shape", [(3, 3), (2, 4, 3), (3, 4, 2), (3, 0, 3)])
def test_starts_of_a_wrong_shape_are_refused(name, shape):
    pairs, _ = exact_pairs(3)
    with pytest.raises(UserError, match=r"starts must be \[B, N, 3\] with B = 3, got"):
        build(name).solve(pairs, torch.zeros(shape), seed=0)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("shape", [(2, 2, 3), (2, 3, 4, 3), (2, 2, 0, 3)])
def test_view_starts_of_a_wrong_shape_are_refused(name, shape):
    sets, _ = exact_sets(2, 3)
    with pytest.raises(UserError, match=r"starts must be \[S, V - 1, N, 3\] with S = 2 and V - 1 = 2, got"):
        build(name).solve_views(sets, torch.zeros(shape), seed=0)


@pytest.mark.parametrize("views", [(3,), (2, 1)])
def test_sets_of_wrong_shapes_are_refused(views):
    with pytest.raises(UserError, match=r"views must be \[S, V\] with V >= 2 and ids \[S\], got"):
        ViewSets(torch.zeros(3, 3, 8, 8), torch.zeros(views, dtype=torch.long), torch.zeros(2, dtype=torch.long))


def test_pairs_of_sets_are_keyed_by_set_and_places():
    sets, _ = exact_sets(3, 4)
    pairs = sets.pairs([0, 2, 1], [1, 3, 0])
    assert pairs.reference.tolist() == [0, 2, 1, 4, 6, 5, 8, 10, 9]
    assert pairs.query.tolist() == [1, 3, 0, 5, 7, 4, 9, 11, 8]
    assert pairs.ids.unique().numel() == 9
    alone = ViewSets(sets.images, sets.views[2:], sets.ids[2:]).pairs([1], [0])
    assert alone.ids[0] == pairs.ids[8]
