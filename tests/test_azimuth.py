"""The energy around an object: its lowest azimuth, profile and minima."""

from __future__ import annotations

import math

import pytest
import torch
from exact_prior import ExactPrior, image_of
from hypothesis import given
from hypothesis import strategies as st

from lp_framework.analysis.ambiguity import Profile, azimuth_energies, profile, within
from lp_framework.analysis.fields import Draws
from lp_framework.solvers.base import Pairs

AZIMUTHS = torch.arange(24) * math.pi / 12


def scanned(prior: ExactPrior, count: int = 6) -> tuple[torch.Tensor, torch.Tensor]:
    """Energies of `count` pairs, and their true longitudes."""
    views = torch.rand(2 * count, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 6.0, 0.5])
    pairs = Pairs(image_of(views), torch.arange(count), torch.arange(count, 2 * count), torch.arange(count))
    poses = views[count:] - views[:count]
    return azimuth_energies(prior, pairs, poses, AZIMUTHS, Draws([100, 900], 2, seed=0)), poses[:, 1]


def test_the_energy_has_its_minimum_at_the_truth_and_a_closed_form():
    energies, truth = scanned(ExactPrior())
    assert within(energies, AZIMUTHS, truth).all()
    # With all but the longitude true the closed form is (1 - cos d) / 2.
    torch.testing.assert_close(energies, (1 - (AZIMUTHS - truth[:, None]).cos()) / 2, atol=1e-5, rtol=1e-4)


def test_a_wrong_prior_is_detected():
    energies, truth = scanned(ExactPrior(offsets=(math.pi / 2,)))
    assert not within(energies, AZIMUTHS, truth).any()


def test_a_profile_is_centred_on_the_truth():
    energies, truth = scanned(ExactPrior(offsets=(0.0, math.pi), depths=(0.0, 0.3)))
    curve = profile(energies, AZIMUTHS, truth)
    assert curve.degrees.tolist() == [float(15 * k) for k in range(-12, 12)]
    first, second = curve.minima()
    assert first == {"degrees": 0, "height": 0}
    assert abs(second["degrees"]) == 180 and 0 < second["height"] < 1


@given(st.integers(1, 5), st.floats(-180, 180))
def test_the_minima_of_a_wave_are_counted(waves, phase):
    degrees = torch.arange(-180.0, 180.0, 5.0)
    curve = Profile(degrees, -(waves * (degrees - phase)).deg2rad().cos())
    assert len(curve.minima()) == waves


def test_shallow_dips_are_no_minima_and_a_flat_profile_has_no_relief():
    degrees = torch.arange(-180.0, 180.0, 15.0)
    dented = Profile(degrees, 2 - degrees.deg2rad().cos() - 0.05 * (degrees == 120))
    assert [minimum["degrees"] for minimum in dented.minima()] == [0.0]
    assert dented.relief == pytest.approx(1.0, abs=0.01)
    assert Profile(degrees, torch.ones(24)).relief == 0
