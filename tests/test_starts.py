"""Starts: their positions and dependencies."""

from __future__ import annotations

import math

import pytest
import torch
from scipy import stats
from solver_problems import ExactModel, exact_pairs

from lp_framework import registry
from lp_framework.errors import UserError
from lp_framework.models.backbones import EfficientNetLite0Maps
from lp_framework.models.matching import MatchingModel
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.starts import Grid, Random, Ring, Starts

IDS = torch.tensor([5, 17, 2**62 + 11, 0])


def with_ids(ids: torch.Tensor) -> Pairs:
    """Pairs of one image with itself."""
    return Pairs(torch.zeros(1, 3, 2, 2), torch.zeros_like(ids), torch.zeros_like(ids), ids)


PAIRS = with_ids(IDS)


@pytest.mark.parametrize("name", registry.names("start"))
def test_every_kind_of_start_keeps_its_contract(name):
    model = MatchingModel(EfficientNetLite0Maps(), width=16, layers=1, cells=32).eval()
    starts = registry.build("start", {"name": name}, model=model)
    first, again = starts.make(PAIRS, seed=3), starts.make(PAIRS, seed=3)
    assert first.shape == (len(IDS), starts.count, 3)
    assert first.dtype == torch.float32
    assert first.isfinite().all()
    assert torch.equal(first, again)
    order = torch.tensor([2, 0, 3, 1])
    assert torch.equal(starts.make(with_ids(IDS[order]), seed=3), first[order])
    parts = [starts.make(with_ids(IDS[:1]), seed=3), starts.make(with_ids(IDS[1:]), seed=3)]
    torch.testing.assert_close(torch.cat(parts), first, rtol=1e-5, atol=1e-5)  # a network's products round by batch


@pytest.mark.parametrize("count", [1, 3, 4])
def test_a_ring_goes_evenly_around(count):
    starts = Ring(count, latitude=0.3).make(PAIRS, seed=0)
    expected = torch.tensor([[0.3, 2 * math.pi * each / count, 0.0] for each in range(count)])
    torch.testing.assert_close(starts, expected.expand(4, -1, -1))


def test_the_default_ring_is_ifusions():
    longitudes = Ring().make(PAIRS, seed=0)[0, :, 1].rad2deg()
    torch.testing.assert_close(longitudes, torch.tensor([0.0, 90.0, 180.0, 270.0]))


def test_the_default_grid_has_the_papers_nine():
    starts = Grid().make(PAIRS, seed=0)
    found = {tuple(round(math.degrees(angle)) for angle in pose[:2]) for pose in starts[1].tolist()}
    assert found == {(latitude, longitude) for latitude in (-30, 0, 30) for longitude in (0, 120, 240)}
    assert starts.shape == (4, 9, 3)
    assert (starts[..., 2] == 0).all()


def test_random_starts_fill_their_band_evenly():
    starts = Random(count=8, latitude=0.4).make(with_ids(torch.arange(2_000)), seed=0).reshape(-1, 3).double()
    assert stats.kstest(starts[:, 0].numpy(), stats.uniform(-0.4, 0.8).cdf).pvalue > 1e-3
    assert stats.kstest(starts[:, 1].numpy(), stats.uniform(0, 2 * math.pi).cdf).pvalue > 1e-3
    assert (starts[:, 2] == 0).all()
    assert torch.corrcoef(starts[:, :2].T)[0, 1].abs() < 0.03


def test_random_starts_depend_on_pair_and_seed():
    starts = Random(count=2)
    first = starts.make(PAIRS, seed=0)
    assert not torch.equal(first[0], first[1])
    assert not torch.equal(first[:, 0], first[:, 1])
    assert not torch.equal(first, starts.make(PAIRS, seed=1))


@pytest.mark.parametrize("count", [1, 2, 5])
def test_fewer_random_starts_are_the_first_of_more(count):
    assert torch.equal(Random(count).make(PAIRS, seed=0), Random(8).make(PAIRS, seed=0)[:, :count])


def test_starts_may_ask_a_model(clean_registry):
    @registry.register("start", "where_the_model_leads")
    class Led(Starts):
        count = 1

        def __init__(self, model: ExactModel) -> None:
            self.model = model

        def make(self, pairs: Pairs, seed: int) -> torch.Tensor:
            codes = self.model.encode(pairs.images)
            return self.model.condition(codes[pairs.reference], codes[pairs.query])[:, None]

    pairs, true = exact_pairs(3)
    starts = registry.build("start", "where_the_model_leads", model=ExactModel())
    torch.testing.assert_close(starts.make(pairs, seed=0)[:, 0], true)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Ring(0), "start.count must be at least 1, got 0"),
        (lambda: Random(0), "start.count must be at least 1, got 0"),
        (lambda: Random(latitude=2.0), r"start.latitude must be in \[0, pi/2\), got 2.0"),
        (lambda: Grid([], [0.0]), "at least one angle each"),
    ],
)
def test_bad_settings_are_named(build, message):
    with pytest.raises(UserError, match=message):
        build()
