"""Landscapes: energies on the grid, and the minima of landscapes known in closed form."""

from __future__ import annotations

import math

import pytest
import torch
from exact_prior import ExactPrior
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from landscapes import of, wells
from solver_problems import ExactModel, exact_pairs

from lp_framework.analysis.fields import Draws, model_field, pose_energies, prior_landscapes
from lp_framework.analysis.landscapes import Landscape, landscape_grid
from lp_framework.errors import UserError

GRID = landscape_grid()


def places(landscape: Landscape) -> list[tuple[float, float]]:
    """Latitudes and longitudes of the minima, degrees."""
    return [(math.degrees(each.latitude), math.degrees(each.longitude)) for each in landscape.minima()]


def apart(one: float, other: float) -> float:
    """Degrees between two longitudes."""
    return abs((one - other + 180) % 360 - 180)


# ---------------------------------------------------------------- the grid


def test_the_papers_grid():
    latitude, longitude = (each.rad2deg() for each in landscape_grid())
    torch.testing.assert_close(latitude, torch.arange(16) * 8.0 - 60)
    torch.testing.assert_close(longitude, torch.arange(30) * 12.0)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"longitude_step_degrees": 11.0}, "longitude_step_degrees must divide 360 into three or more parts, got 11.0"),
        (
            {"longitude_step_degrees": 180.0},
            "longitude_step_degrees must divide 360 into three or more parts, got 180.0",
        ),
        ({"longitude_step_degrees": 0.0}, "longitude_step_degrees must divide 360 into three or more parts, got 0.0"),
        ({"latitude_step_degrees": 70.0}, "latitudes need a limit between 0 and 180 degrees and a step no larger"),
        ({"latitude_limit_degrees": 0.0}, "latitudes need a limit between 0 and 180 degrees and a step no larger"),
    ],
)
def test_invalid_grids(settings, sentence):
    with pytest.raises(UserError, match=sentence):
        landscape_grid(**settings)


# ---------------------------------------------------------------- minima


@pytest.mark.parametrize("north", [-45.0, 0.0, 21.0])
@pytest.mark.parametrize("east", [0.0, 3.0, 100.0, 186.0, 355.0, 359.9])
def test_a_well_is_found_where_it_is(north, east):
    """Between the grid's points too, and across the seam."""
    ((latitude, longitude),) = places(wells((north, east, 1.0)))
    assert abs(latitude - north) < 0.5 and apart(longitude, east) < 0.5
    (minimum,) = wells((north, east, 1.0)).minima()
    assert minimum.height == 0 and minimum.prominence == 1 and 0 <= minimum.longitude < 2 * math.pi


@settings(deadline=None)
@given(
    st.lists(
        st.tuples(st.floats(-50, 50), st.floats(0, 360), st.floats(0.5, 1.0)), min_size=1, max_size=5
    )
)  # fmt: skip
def test_wells_are_counted(given_wells):
    for index, (north, east, _) in enumerate(given_wells):
        for other, (other_north, other_east, _) in enumerate(given_wells):
            assume(index == other or max(abs(north - other_north) / 1.2, apart(east, other_east)) > 60)
    landscape = wells(*given_wells, width=8.0)
    found = places(landscape)
    assert len(found) == len(given_wells)
    for north, east, _ in given_wells:
        assert min(abs(latitude - north) + apart(longitude, east) for latitude, longitude in found) < 4
    heights = [minimum.height for minimum in landscape.minima()]
    assert heights == sorted(heights) and heights[0] == 0


def test_a_well_of_half_the_depth_has_half_the_prominence():
    deep, shallow = wells((0, 60, 1.0), (0, 240, 0.5), width=8.0).minima()
    assert math.degrees(deep.longitude) == pytest.approx(60, abs=0.5)
    assert shallow.height == pytest.approx(0.5, abs=0.01) and shallow.prominence == pytest.approx(0.5, abs=0.01)
    assert shallow.energy == pytest.approx(0.5, abs=0.01)


def test_a_well_on_the_border_counts():
    (((latitude, longitude)),) = places(wells((60, 90, 1.0)))
    assert latitude == pytest.approx(60, abs=1e-3) and longitude == pytest.approx(90, abs=0.5)
    ((latitude, _),) = places(wells((75, 90, 1.0)))  # the lowest ground there is, its bottom beyond
    assert latitude == pytest.approx(60, abs=1e-3)
    assert len(places(wells((60, 0, 1.0), (-60, 180, 0.9)))) == 2


def test_a_saddle_is_not_a_minimum():
    """Between two wells there is a pass; a landscape of cosines has as many passes as wells."""
    assert len(wells((0, 90, 1.0), (0, 150, 0.9), width=8.0).minima()) == 2
    latitude, longitude = GRID
    energy = -(3 * longitude).cos() + (6 * latitude).cos()[:, None]
    found = Landscape(latitude, longitude, 0.0, energy).minima()
    # Latitudes of cos(6 a) = -1 within 60 degrees: -30 and 30; three longitudes of each.
    assert sorted(round(math.degrees(each.longitude)) % 360 for each in found) == [0, 0, 120, 120, 240, 240]
    assert {round(math.degrees(each.latitude)) for each in found} == {-30, 30}


def test_equal_energies_side_by_side_are_one_minimum():
    assert len(of([[2, 2, 2, 2, 2], [2, 1, 1, 2, 2], [2, 1, 2, 2, 2], [2, 2, 2, 2, 2]]).minima()) == 1
    assert len(of([[1, 2, 2, 2, 1], [2, 2, 2, 2, 2]]).minima()) == 1  # across the seam
    assert len(of([[2, 1, 2, 2], [1, 2, 2, 2], [2, 2, 2, 2]]).minima()) == 1  # touching at a corner
    assert len(of([[3, 1, 3, 1, 3, 3]]).minima()) == 2
    assert len(of([[2, 2, 2], [1, 1, 1], [2, 2, 2]]).minima()) == 1  # a valley all around


def test_the_minimum_lies_between_two_equal_points():
    landscape = wells((4.0, 90.0, 1.0))  # latitudes 4 and longitudes 84, 96 are on the grid
    ((_, longitude),) = places(landscape)
    assert longitude == pytest.approx(90, abs=1e-3)


def test_shallow_dips_do_not_count_and_a_flat_landscape_has_no_minimum():
    deep, shallow = (0, 60, 1.0), (0, 240, 0.03)
    assert len(wells(deep, shallow, width=8.0).minima()) == 1
    assert of([[1.0] * 6] * 4).minima() == []


def test_non_finite_energies_are_ignored():
    landscape = wells((0, 60, 1.0), (0, 240, 0.5), width=8.0)
    landscape.energy[:, 0] = math.nan
    landscape.energy[-1] = math.inf
    assert len(landscape.minima()) == 2


def test_the_floor_is_the_lowest_energy_at_each_longitude():
    assert of([[3, 1, 2], [5, 4, 0], [2, 2, 2]]).floor().tolist() == pytest.approx([0.4, 0.2, 0.0])
    assert of([[1.0] * 3] * 2).floor().tolist() == [0, 0, 0]


def test_flatness():
    latitude, longitude = GRID
    valley = (latitude[:, None] ** 2).expand(-1, len(longitude))
    assert Landscape(latitude, longitude, 0.0, valley).flatness() == 1
    wall = valley + 100 * (1 - longitude.cos())
    assert Landscape(latitude, longitude, 0.0, wall).flatness() < 0.01


# ---------------------------------------------------------------- energies


class Counted(ExactPrior):
    """Keeps the sizes of the batches that go through it, and how many images it has encoded."""

    def __init__(self, **settings: float) -> None:
        super().__init__(**settings)
        self.sizes: list[int] = []
        self.encoded = 0

    def encode(self, images):
        self.encoded += len(images)
        return super().encode(images)

    def residual(self, target, source, pose, timestep, noise):
        self.sizes.append(len(pose))
        return super().residual(target, source, pose, timestep, noise)


def test_energies_are_the_closed_form():
    pairs, true = exact_pairs(3)
    found = prior_landscapes(ExactPrior(), pairs, true[:, 2] + 0.2, GRID, Draws([100, 900], 2, seed=0))
    latitude, longitude = GRID
    for landscape, truth in zip(found, true, strict=True):
        assert landscape.radius == pytest.approx(truth[2].item() + 0.2)
        up = (latitude - truth[0]).square()[:, None] + 0.2**2
        torch.testing.assert_close(
            landscape.energy, up / 2 + (1 - (longitude - truth[1]).cos()) / 2, atol=1e-5, rtol=1e-4
        )
        minima = landscape.minima()
        assert len(minima) == 1 and abs(minima[0].longitude - truth[1]) < math.radians(1)
        assert abs(minima[0].latitude - truth[0]) < math.radians(1)


@pytest.mark.parametrize("batch", [1, 7, 64, 481, 100_000])
def test_batches_bound_the_memory_and_change_nothing(batch):
    pairs, true = exact_pairs(3)
    prior = Counted(noisy=0.3)
    coarse = landscape_grid(60, 20, 40)  # 7 x 9
    draws = Draws([100, 900], 2, seed=0)
    found = prior_landscapes(prior, pairs, true[:, 2], coarse, draws._replace(batch=batch))
    assert max(prior.sizes) <= 2 * batch and sum(prior.sizes) == 3 * 63 * 4 * 2
    assert prior.encoded == len(pairs.images)  # each once
    whole = prior_landscapes(prior, pairs, true[:, 2], coarse, draws)
    for one, other in zip(found, whole, strict=True):
        torch.testing.assert_close(one.energy, other.energy)
    alone, _ = exact_pairs(3)
    poses = torch.cat([torch.cartesian_prod(*coarse), true[1, 2].expand(63, 1)], dim=1)
    torch.testing.assert_close(
        pose_energies(prior, alone, poses.expand(3, -1, -1), draws)[1].view(7, 9), whole[1].energy
    )


def test_noises_are_those_of_the_seed_and_the_pair():
    pairs, true = exact_pairs(2)
    prior, coarse = ExactPrior(noisy=0.3), landscape_grid(60, 40, 40)

    def energies(seed):
        found = prior_landscapes(prior, pairs, true[:, 2], coarse, Draws([500], 3, seed))
        return torch.stack([each.energy for each in found])

    assert torch.equal(energies(1), energies(1)) and not torch.equal(energies(1), energies(2))


def test_a_models_field_on_the_grid():
    pairs, true = exact_pairs(2)
    field = model_field(ExactModel(), pairs, true[:, 2], GRID)
    assert field.energy is None and field.score.shape == (2, 16, 30, 3)
    expected = torch.stack(torch.meshgrid(*GRID, indexing="ij"), dim=-1)
    torch.testing.assert_close(field.score[1, ..., :2], true[1, :2] - expected)
    torch.testing.assert_close(field.score[..., 2], torch.zeros(2, 16, 30), atol=1e-6, rtol=0)
