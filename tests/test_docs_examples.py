"""The examples in docs/examples, which are plugins, work as their pages say."""

from __future__ import annotations

import math
import re
import shlex
from pathlib import Path

import pytest
import torch
from exact_prior import ExactPrior
from solver_problems import around, away, exact_pairs, some
from torch import Tensor
from view_folders import draw_view

from lp_framework import registry
from lp_framework.errors import UserError
from lp_framework.geometry import view_pose
from lp_framework.models.backbones import EfficientNetLite0
from lp_framework.models.pose_model import ScoreModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
registry.discover([EXAMPLES])


# ---------------------------------------------------------------- the solver


def test_pattern_search_finds_the_minimum_of_its_basin():
    pairs, true = exact_pairs(4)
    solver = registry.build("solver", {"name": "pattern_search", "steps": 60}, prior=ExactPrior([0.0, math.pi]))
    solution = solver.solve(pairs, around(true, 0.4, 2.8), seed=0)
    off = away(solution.poses, true[:, None]) - torch.tensor([[0.0, 0.0, 0.0], [0.0, math.pi, 0.0]])
    off[..., 1] = torch.remainder(off[..., 1] + math.pi, 2 * math.pi) - math.pi
    assert off.abs().max() < 0.01
    assert solution.energies.max() < 1e-4 and solution.valid.all()
    assert solution.cost.network_passes == 8 + 60 * 2 * 7 * 8  # the images, then both directions of 7 poses per start


def test_pattern_search_solves_each_pair_of_a_batch_as_if_alone():
    pairs, true = exact_pairs(3)
    starts = around(true, 0.3, -0.4)
    solver = registry.build("solver", "pattern_search", prior=ExactPrior(noisy=0.1))
    whole = solver.solve(pairs, starts, seed=0)
    alone = solver.solve(some(pairs, torch.tensor([1])), starts[1:2], seed=0)
    torch.testing.assert_close(alone.poses, whole.poses[1:2])


# ---------------------------------------------------------------- the model


def test_the_robust_loss_is_quadratic_near_zero_and_linear_far_away():
    backbone = EfficientNetLite0(hidden=8, features=4)
    score = ScoreModel(backbone, hidden=8)
    true = torch.tensor([[0.1, 1.0, 0.0], [0.0, 4.0, 0.2]])
    noised, condition = true + torch.tensor([0.2, -0.5, 0.1]), torch.randn(2, 8)
    squared = score.pair_loss(condition, noised, true)  # 1/2 |e|^2
    for delta, expected in ((30.0, squared), (1e-4, 1e-4 * (2 * squared).sqrt())):
        robust = registry.build("model", {"name": "robust_score", "delta": delta, "hidden": 8}, backbone=backbone)
        robust.network = score.network
        torch.testing.assert_close(robust.pair_loss(condition, noised, true), expected, rtol=1e-2, atol=1e-6)
    with pytest.raises(UserError, match=r"model\.delta must be positive, got 0"):
        registry.build("model", {"name": "robust_score", "delta": 0.0}, backbone=backbone)


# ---------------------------------------------------------------- the prior


def cylinder() -> Prior:
    prior: Prior = registry.build("prior", {"name": "cylinder", "image_size": 32})
    return prior


def label() -> Tensor:
    """A label `[3, 256]` of soft stripes that repeat nowhere."""
    angle = torch.arange(256) / 256 * 2 * math.pi
    waves = [angle.sin(), (angle + 2 * (2 * angle).sin()).cos(), (3 * angle).sin() * (0.5 * angle).cos()]
    return torch.stack(waves)


def cans(*longitudes: float) -> Tensor:
    """Views `[I, 3, 32, 32]` of a cylinder with that label, from cameras at these longitudes, far away."""
    column = (torch.arange(32) + 0.5) / 16 - 1
    place = (column.asin() + torch.tensor(longitudes)[:, None]) / (2 * math.pi) % 1 * 256  # [I, 32]
    return label()[:, place.long()].transpose(0, 1)[:, :, None].expand(-1, -1, 32, -1)


def energies(prior: Prior, images: Tensor, longitudes: Tensor) -> Tensor:
    """Denoising errors `[N]` of the second image seen from the first under relative longitudes `[N]`."""
    codes, count = prior.encode(images), len(longitudes)
    index = torch.zeros(count, dtype=torch.int64)
    pose = torch.stack([torch.zeros(count), longitudes, torch.zeros(count)], dim=1)
    noise = torch.randn(1, *prior.latent_shape, generator=torch.Generator().manual_seed(0)).expand(count, -1, -1, -1)
    return prior.denoising_error(codes[index + 1], codes[index], pose, torch.full((count,), 300), noise)


@pytest.mark.parametrize("true_degrees", [-60, -25, 0, 40, 75])
def test_the_cylinder_has_its_lowest_energy_at_the_true_longitude(true_degrees):
    longitudes = torch.arange(-180, 180, 5).deg2rad()
    images = cans(0.7, 0.7 + math.radians(true_degrees))
    best = longitudes[energies(cylinder(), images, longitudes).argmin()].rad2deg()
    assert abs(best - true_degrees) <= 5


def test_the_cylinder_generates_what_the_other_camera_sees():
    prior, pose = cylinder(), torch.tensor([[0.0, 0.5, 0.0]])
    reference, query = cans(0.7, 1.2)
    generated = prior.generate(prior.encode(reference[None]), pose)[0]
    seen = slice(2, 20)  # columns of the query that the reference shows as well, and not at a slant
    assert (generated - query)[..., seen].abs().mean() < 0.1


def test_the_energy_of_the_cylinder_has_a_gradient_in_the_longitude():
    prior, images = cylinder(), cans(0.0, 0.5)
    longitude = torch.tensor([0.3, 0.7], requires_grad=True)
    (gradient,) = torch.autograd.grad(energies(prior, images, longitude).sum(), longitude)
    assert gradient[0] < 0 < gradient[1]  # downhill is towards 0.5 from either side


def test_a_solver_descends_the_cylinder_to_the_true_longitude():
    images = cans(0.7, 1.3)
    solver = registry.build("solver", "ifusion", prior=cylinder())
    pairs = Pairs(images, torch.tensor([0]), torch.tensor([1]), torch.tensor([0]))
    answer = solver.solve(pairs, torch.zeros(1, 1, 3), seed=0).answer()[0]
    assert answer[1].item() == pytest.approx(0.6, abs=0.05)


# ---------------------------------------------------------------- the data set


@pytest.fixture
def turntable(tmp_path):
    """Eight photographs of a mug, 45 degrees apart."""
    from PIL import Image

    (tmp_path / "objects" / "mug").mkdir(parents=True)
    for index in range(8):
        pose = torch.tensor([0.2, index * math.pi / 4, 1.5]).numpy()
        Image.fromarray(draw_view(pose, 32)).save(tmp_path / "objects" / "mug" / f"{index:03d}.png")
    return tmp_path / "objects"


def test_the_turntable_knows_its_cameras(turntable):
    source = registry.build("data", {"name": "turntable", "path": str(turntable), "latitude_degrees": 10.0})
    assert source.names() == ["mug"]
    test, train = source.views("mug", "test"), source.views("mug", "train")
    assert [file.stem for file in test.files] == ["000", "004"]
    assert [file.stem for file in train.files] == ["001", "002", "003", "005", "006", "007"]
    wanted = [[math.radians(10), math.radians(longitude), 1.5] for longitude in (0, 180)]
    torch.testing.assert_close(view_pose(test.cameras), torch.tensor(wanted, dtype=torch.float64))


def test_the_turntable_names_an_object_with_too_few_photographs(turntable):
    source = registry.build("data", {"name": "turntable", "path": str(turntable), "test_every": 8})
    with pytest.raises(UserError, match="mug: needs more than 8 photographs, has 8"):
        source.views("mug", "test")


def test_all_can_be_chosen_on_the_command_line(lp, turntable):
    plugins, data = f"plugins=[{EXAMPLES}]", ("data=turntable", f"data.path={turntable}")
    small = ("data.validation_views=2", "data.image_size=32", "trainer.max_epochs=1")
    trained = lp("train", plugins, *data, *small, "model=robust_score", "model.delta=0.2", "hydra.run.dir=trained")
    assert trained.status == 0, trained.err
    (following,) = re.findall(r"next: +python -m lp_framework (.*)", trained.out)
    first = lp(*shlex.split(following), "solver=langevin", "pictures=false", "hydra.run.dir=first")
    assert first.status == 0, first.err
    choices = ("prior=cylinder", "solver=pattern_search", "start=ring", "solver.steps=3")
    finished = lp("eval", plugins, *data, *choices, "pictures=false", "hydra.run.dir=run")
    assert finished.status == 0, finished.err
    assert "turntable, pattern_search, start=ring, 2 pairs" in finished.out
