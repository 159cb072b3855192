"""The matching model: votes, mirrored maps, solvers on its density, and its training losses."""

import math
from functools import partial

import pytest
import torch
from exact_prior import ExactPrior

from lp_framework.errors import UserError
from lp_framework.models.backbones import EfficientNetLite0, EfficientNetLite0Maps
from lp_framework.models.matching import MatchingModel
from lp_framework.models.matching_network import BINS, HARMONICS, MOMENTS, ViewCells, Voting
from lp_framework.models.pose_density import GRID, PoseDensity
from lp_framework.models.pose_model import ScoreModel
from lp_framework.solvers.base import Pairs, ViewSets
from lp_framework.solvers.langevin import Langevin
from lp_framework.solvers.multiview import MultiView
from lp_framework.solvers.starts import Modes

TURN = 2 * math.pi


@pytest.fixture(scope="module")
def model() -> MatchingModel:
    torch.manual_seed(0)
    return MatchingModel(EfficientNetLite0Maps(), width=32, layers=1, cells=64).eval()


def cells_at(azimuths: torch.Tensor) -> ViewCells:
    """A view whose cells are points of an object, distinguished by their descriptors, at these azimuths `[K]`."""
    count = len(azimuths)
    phase = azimuths[:, None] * torch.arange(HARMONICS + 1)
    return ViewCells(
        descriptor=torch.eye(count)[None],
        azimuth=torch.cat([phase.cos(), phase[:, 1:].sin()], dim=1)[None],
        gates=torch.ones(1, count, 2),
        moments=torch.zeros(1, count, MOMENTS),
        shown=torch.ones(1, count, 1),
        pooled=torch.zeros(1, 8),
        pose=torch.zeros(1, 2),
    )


@pytest.mark.parametrize("bin_", [0, 1, 7, 18, 35])
def test_votes_are_highest_at_the_difference_of_the_azimuths(bin_: int):
    """The query's camera stands `longitude` further round: it sees every point at so much less of an azimuth."""
    longitude = bin_ * TURN / BINS
    azimuths = torch.rand(20, generator=torch.Generator().manual_seed(0)) * TURN
    reference, query = cells_at(azimuths), cells_at(azimuths - longitude)
    votes = Voting(width=8, polls=2)._votes(reference, query, torch.eye(20)[None])
    assert votes.argmax(dim=-1).tolist() == [[bin_, bin_]]
    swapped = Voting(width=8, polls=2)._votes(query, reference, torch.eye(20)[None])
    assert swapped.argmax(dim=-1).tolist() == [[-bin_ % BINS] * 2]


def test_soft_matches_are_probabilities_and_leave_out_what_is_not_shown():
    reference, query = cells_at(torch.zeros(5)), cells_at(torch.zeros(5))
    query.shown[0, 3] = 0
    rows, columns = Voting(width=8, polls=2).matches(reference, query)
    torch.testing.assert_close(rows.exp().sum(dim=2), torch.ones(1, 5))
    torch.testing.assert_close(columns.exp().sum(dim=1), torch.ones(1, 5))
    assert rows.exp()[0, :, 3].max() < 1e-10
    assert rows.argmax(dim=2)[0, [0, 1, 2, 4]].tolist() == [0, 1, 2, 4]
    assert rows.argmax(dim=2)[0, 3] == 5  # its match is not shown


def test_mirrored_maps_are_nearly_those_of_the_mirrored_image():
    torch.manual_seed(1)
    backbone = EfficientNetLite0Maps()
    image = torch.nn.functional.interpolate(2 * torch.rand(2, 3, 14, 14) - 1, size=224, mode="bilinear")
    with torch.no_grad():
        maps, flipped = backbone.trunk(image), backbone.trunk(image.flip(3))
    torch.testing.assert_close(backbone.mirrored(backbone.mirrored(maps)), maps, rtol=0, atol=0)
    torch.testing.assert_close(backbone.mirrored(maps)[..., -4:], flipped[..., -4:], rtol=0, atol=0)

    def alike(a: torch.Tensor, b: torch.Tensor) -> float:
        return torch.corrcoef(torch.stack([a.float().flatten(), b.float().flatten()]))[0, 1].item()

    assert alike(backbone.mirrored(maps), flipped) > alike(maps, flipped) + 0.1


def test_condition_is_indexed_as_the_pairs_are(model: MatchingModel):
    images = 2 * torch.rand(3, 3, 64, 64, generator=torch.Generator().manual_seed(0)) - 1
    with torch.no_grad():
        codes = model.encode(images)
        reference, query = torch.tensor([0, 1, 2]), torch.tensor([1, 2, 0])
        density = model.condition(codes[reference], codes[query])
        alone = model.condition(codes[reference[1:2]], codes[query[1:2]])
    torch.testing.assert_close(density[1:2].logits, alone.logits, rtol=1e-4, atol=1e-4)
    pose = torch.rand(3, 5, 3)
    score, energy = model.field(density[:, None], pose)
    assert score.shape == (3, 5, 3) and energy.shape == (3, 5)
    torch.testing.assert_close(model.field(density, pose[:, 2]).score, score[:, 2], rtol=1e-4, atol=1e-5)


class Bimodal(MatchingModel):
    """A matching model with a given density: 0.6 at a longitude of 100 degrees, 0.4 at 280."""

    def encode(self, images):
        return images.new_zeros(len(images), 1)

    def condition(self, reference, query):
        grid = torch.arange(GRID) * TURN / GRID
        centres = torch.tensor([math.radians(100), math.radians(280)])
        logits = (torch.tensor([0.6, 0.4]) * torch.exp(30 * (grid[:, None] - centres).cos() - 30)).sum(dim=1).log()
        pairs = len(reference)
        mean = torch.tensor([0.2, -0.1]).expand(pairs, 2)
        return PoseDensity(logits.expand(pairs, GRID), mean, torch.full((pairs, 2), 0.1), self.sigma)


@pytest.fixture(scope="module")
def bimodal() -> Bimodal:
    return Bimodal(EfficientNetLite0Maps(), width=32, layers=1)


def a_pair() -> Pairs:
    return Pairs(torch.ones(2, 3, 8, 8), torch.tensor([0]), torch.tensor([1]), torch.tensor([5]))


def test_modes_are_starts_with_the_most_likely_first(bimodal: Bimodal):
    starts = Modes(bimodal, count=2).make(a_pair(), seed=0)
    wanted = torch.tensor([[[0.2, math.radians(100), -0.1], [0.2, math.radians(280), -0.1]]])
    torch.testing.assert_close(starts, wanted, rtol=0, atol=2e-3)


def test_sharpening_descent_ends_in_the_higher_mode(bimodal: Bimodal):
    starts = torch.tensor([[[0.0, math.radians(each), 0.0] for each in (130.0, 250.0, 20.0)]])
    solution = Langevin(bimodal, gamma=0.0, iterations=120, sigma=[1.0, 0.1]).solve(a_pair(), starts, seed=0)
    latitude, longitude, radius = solution.answer()[0].tolist()
    assert math.degrees(longitude) == pytest.approx(100, abs=1)
    assert (latitude, radius) == (pytest.approx(0.2, abs=0.01), pytest.approx(-0.1, abs=0.01))


def test_modes_stay_separate_with_little_smoothing_and_the_energy_chooses(bimodal: Bimodal):
    solver = Langevin(bimodal, gamma=0.0, sigma=0.15)
    starts = Modes(bimodal, count=2).make(a_pair(), seed=0).flip(1)  # the lesser one first
    solution = solver.solve(a_pair(), starts, seed=0)
    assert torch.rad2deg(solution.poses[0, :, 1]).tolist() == pytest.approx([280, 100], abs=1)
    assert solution.chosen.tolist() == [1]


def test_final_poses_have_a_probability(bimodal: Bimodal):
    starts = Modes(bimodal, count=2).make(a_pair(), seed=0)
    solution = Langevin(bimodal, gamma=0.0, sigma=0.15).solve(a_pair(), starts, seed=0)
    assert solution.probability is not None
    assert solution.probability[0].tolist() == pytest.approx([0.6, 0.4], abs=0.02)
    density = bimodal.condition(torch.zeros(1, 1), torch.zeros(1, 1))
    wide = bimodal.probability(density[:, None], solution.poses, degrees=120.0)
    assert (wide > solution.probability).all() and (wide <= 1).all()


class Undecided(Bimodal):
    """Reads longitudes from the images; pairs that are far apart prefer half a turn more."""

    def encode(self, images):
        return images[:, 0, 0, 0]

    def condition(self, reference, query):
        turn = query - reference
        share = torch.where(turn.cos() < 0.0, 0.4, 0.95)[:, None]
        grid = torch.arange(GRID) * TURN / GRID
        right, other = (torch.exp(30 * (grid - turn[:, None] - shift).cos() - 30) for shift in (0.0, math.pi))
        logits = (share * right + (1 - share) * other).log()
        return PoseDensity(logits, torch.zeros(len(turn), 2), torch.full((len(turn), 2), 0.1), self.sigma)


@pytest.mark.parametrize("solver", ["langevin", "multiview"])
def test_several_views_correct_a_wrong_pair(solver: str):
    model = Undecided(EfficientNetLite0Maps(), width=32, layers=1)
    longitudes = torch.tensor([0.0, 60.0, 120.0, 180.0]).deg2rad()
    images = longitudes[:, None, None, None].expand(-1, 3, 8, 8)
    sets = ViewSets(images, torch.arange(4)[None], torch.tensor([7]))
    settings = {"langevin": {"gamma": 0.0, "sigma": 0.15}, "multiview": {"gamma": 0.0, "second_stage": False}}[solver]
    build = {"langevin": Langevin, "multiview": partial(MultiView, prior=ExactPrior())}[solver]
    modes = Modes(model, count=2)
    pairs = modes.make(sets.with_first(), seed=0)
    assert pairs[:, 0, 1].rad2deg().tolist() == pytest.approx([60, 300, 0], abs=1.5)  # the second and third are wrong
    found = build(model, **settings).solve_views(sets, pairs[None], seed=0)
    assert found.poses[0, :, 1].rad2deg().tolist() == pytest.approx([60, 120, 180], abs=1.5)
    if solver == "langevin":
        assert found.pairs is not None and found.pairs.probability is not None
        assert (found.pairs.probability[:, 0] < found.pairs.probability.amax(dim=1))[1:].all()


def test_a_mirror_image_has_the_mirrored_density(model: MatchingModel):
    maps = model.backbone.trunk(2 * torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0)) - 1)
    with torch.no_grad():
        views, mirrored = model._encode(maps), model._encode(model.backbone.mirrored(maps))
        one, other = (model.condition(each[torch.tensor([0])], each[torch.tensor([1])]) for each in (views, mirrored))
    torch.testing.assert_close(
        other.logits.log_softmax(-1), one.logits.log_softmax(-1).flip(-1).roll(1, -1), rtol=0, atol=1e-4
    )
    torch.testing.assert_close(other.mean, one.mean, rtol=0, atol=1e-5)


def test_temperature_flattens_the_density(model: MatchingModel):
    images = 2 * torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0)) - 1
    hot = MatchingModel(EfficientNetLite0Maps(), width=32, layers=1, cells=64, temperature=2.0).eval()
    hot.load_state_dict(model.state_dict())
    with torch.no_grad():
        logits = []
        for each in (model, hot):
            codes = each.encode(images)
            logits.append(each.condition(codes[torch.tensor([0])], codes[torch.tensor([1])]).logits.log_softmax(-1))
    torch.testing.assert_close(logits[1], (logits[0] / 2).log_softmax(-1), rtol=0, atol=1e-5)


def test_other_models_refuse_density_methods():
    model = ScoreModel(EfficientNetLite0(hidden=8, features=4), hidden=8, layers=1)
    starts = torch.zeros(1, 1, 3)
    assert Langevin(model).solve(a_pair(), starts, seed=0).probability is None
    with pytest.raises(UserError, match=r"solver\.sigma needs model=matching"):
        Langevin(model, sigma=0.2).solve(a_pair(), starts, seed=0)
    with pytest.raises(UserError, match="start=modes needs model=matching"):
        Modes(model).make(a_pair(), seed=0)
