"""Landscapes in closed form, for tests of minima and plots."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from lp_framework.analysis.landscapes import Landscape, landscape_grid


def wells(*places: tuple[float, float, float], width: float = 4.0, **grid: float) -> Landscape:
    """Wells of (latitude, longitude, depth) in a plain at 1, places in degrees; `width` is a von Mises kappa."""
    latitude, longitude = landscape_grid(**grid)
    energy = torch.ones(len(latitude), len(longitude), dtype=torch.float64)
    for north, east, depth in places:
        up = (latitude.double()[:, None] - math.radians(north)).cos() - 1
        along = (longitude.double() - math.radians(east)).cos() - 1
        energy -= depth * (width * (up + along)).exp()
    return Landscape(latitude, longitude, 0.1, energy)


def of(rows: Sequence[Sequence[float]]) -> Landscape:
    """A landscape of these energies; latitudes 10 degrees apart around 0."""
    energy = torch.tensor(rows, dtype=torch.float64)
    latitude = torch.arange(len(rows)) * 10.0 - 5.0 * (len(rows) - 1)
    return Landscape(latitude.deg2rad(), torch.arange(energy.shape[1]) * 2 * math.pi / energy.shape[1], 0.0, energy)
