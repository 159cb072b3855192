"""Energy landscapes over relative latitude and longitude as plain arrays, their local minima, and score fields.

See the paper's Figures 1 and 2 (appendix, Additional Zero123 MSE Landscape Visualization); `fields` fills the arrays.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.errors import UserError

FLAT = 0.9  # if the floor spans at most a tenth of the range, the longitude is undetermined
PROMINENCE = 0.05  # of the landscape's range; shallower dips do not count as minima

Grid = tuple[Tensor, Tensor]  # relative latitudes `[A]` and longitudes `[O]`, radians


class LandscapeMinimum(NamedTuple):
    """A local minimum: its position (radians, between grid points), and the energy at the nearest grid point.

    `height` is that energy scaled to the landscape's range, 0 to 1. `prominence`, on the same scale, is the climb
    to the lowest pass into a deeper valley; it is 1 for the deepest minimum.
    """

    latitude: float
    longitude: float
    energy: float
    height: float
    prominence: float


class Landscape(NamedTuple):
    """Energies `[A, O]` of a pair at relative latitudes `[A]`, longitudes `[O]` (radians) and `radius` (scene units).

    Latitudes ascend; longitudes are evenly spaced over the full turn, starting at 0.
    """

    latitude: Tensor
    longitude: Tensor
    radius: float
    energy: Tensor

    def minima(self) -> list[LandscapeMinimum]:
        """Local minima, deepest first; see `find_minima`. Positions are refined by a parabola along each angle."""
        return [
            LandscapeMinimum(*self._place(cell), self.energy.flatten()[cell].item(), height, prominence)
            for cell, height, prominence in find_minima(self.energy, PROMINENCE)
        ]

    def floor(self) -> Tensor:
        """Lowest energy at each longitude `[O]`, scaled to the landscape's range, 0 to 1; all 0 without relief."""
        low, high = self.energy.min(), self.energy.max()
        return (self.energy.min(dim=0).values - low) / torch.where(high > low, high - low, 1.0)

    def flatness(self) -> float:
        """How little the longitude matters: 1 if a valley of constant depth runs all around, 0 if a wall blocks it."""
        return 1 - self.floor().max().item()

    def density(self) -> Landscape:
        """The landscape of exp(-E), divided by its maximum."""
        return self._replace(energy=(self.energy.min() - self.energy).exp())

    def _place(self, cell: int) -> tuple[float, float]:
        """Latitude and longitude (radians) of the vertices of the parabolas through a minimum and its neighbours."""
        rows, columns = self.energy.shape
        row, column = divmod(cell, columns)
        latitude, longitude = self.latitude[row].item(), self.longitude[column].item()
        if 0 < row < rows - 1:
            step = (self.latitude[row + 1] - self.latitude[row - 1]).item() / 2
            latitude += step * _vertex(*self.energy[row - 1 : row + 2, column].tolist())
        sides = [(column - 1) % columns, column, (column + 1) % columns]
        longitude += 2 * math.pi / columns * _vertex(*self.energy[row, sides].tolist())
        return latitude, longitude % (2 * math.pi)


def _vertex(left: float, middle: float, right: float) -> float:
    """Minimum of the parabola through three values at -1, 0, 1, at most half a step from 0; 0 if it is flat."""
    curvature = left - 2 * middle + right
    return min(max((left - right) / (2 * curvature), -0.5), 0.5) if curvature > 0 else 0.0


def find_minima(energy: Tensor, least: float) -> list[tuple[int, float, float]]:
    """Find the local minima of energies `[A, O]` with a prominence of at least `least`, deepest first.

    Returns the index of each minimum in the flattened grid, and its `height` and `prominence` as in
    `LandscapeMinimum`. Points have eight neighbours; the grid is periodic in longitude and open in latitude, so a
    minimum on the border counts. A plateau of equal energies is one minimum, a saddle is none. Energies that are not
    finite are ignored, and a flat landscape has no minimum.
    """
    rows, columns = energy.shape
    heights = energy.double().flatten().tolist()
    ascending = sorted((cell for cell, value in enumerate(heights) if math.isfinite(value)), key=heights.__getitem__)
    if not ascending or heights[ascending[0]] == heights[ascending[-1]]:
        return []
    low, relief = heights[ascending[0]], heights[ascending[-1]] - heights[ascending[0]]
    basin: dict[int, int] = {}  # union-find: maps a flooded point towards the bottom of its basin
    climbs: dict[int, float] = {}  # from the bottom of a basin to its pass into a deeper one

    def bottom(cell: int) -> int:
        while basin[cell] != cell:
            basin[cell] = basin[basin[cell]]
            cell = basin[cell]
        return cell

    # Flood the points from below: one without flooded neighbours starts a basin, one between basins is a pass.
    for cell in ascending:
        row, column = divmod(cell, columns)
        around = [
            near * columns + (column + step) % columns
            for near in range(max(0, row - 1), min(rows, row + 2))
            for step in (-1, 0, 1)
        ]
        met = sorted({bottom(each) for each in around if each in basin}, key=heights.__getitem__)
        basin[cell] = met[0] if met else cell
        if not met:
            climbs[cell] = relief
        for shallower in met[1:]:
            basin[shallower] = met[0]
            climbs[shallower] = heights[cell] - heights[shallower]
    found = [(cell, (heights[cell] - low) / relief, climb / relief) for cell, climb in climbs.items()]
    return sorted((valley for valley in found if valley[2] >= least), key=lambda valley: valley[1])


def landscape_grid(
    latitude_limit_degrees: float = 60.0, latitude_step_degrees: float = 8.0, longitude_step_degrees: float = 12.0
) -> Grid:
    """Relative latitudes `[A]` and longitudes `[O]` (radians, float32) of a landscape; defaults follow the paper.

    Latitudes start at minus the limit. `UserError` if the longitude step does not divide the full turn.

    >>> [len(each) for each in landscape_grid()]
    [16, 30]
    """
    limit, step, longitude_step = latitude_limit_degrees, latitude_step_degrees, longitude_step_degrees
    if not 0 < limit < 180 or not 0 < step <= limit:
        raise UserError(
            f"latitudes need a limit between 0 and 180 degrees and a step no larger, got {limit} and {step}"
        )
    count = round(360 / longitude_step) if 0 < longitude_step <= 120 else 0
    if count < 3 or abs(count * longitude_step - 360) > 1e-6:
        raise UserError(f"longitude_step_degrees must divide 360 into three or more parts, got {longitude_step}")
    latitude = torch.arange(math.floor(2 * limit / step + 1e-9) + 1, dtype=torch.float64) * step - limit
    longitude = torch.arange(count, dtype=torch.float64) * (360 / count)
    return latitude.deg2rad().float(), longitude.deg2rad().float()


def cell_grid(spacing: float) -> Grid:
    """Relative latitudes `[A]` and longitudes `[O]` (radians, float32) at the centres of cells, for arrows.

    The cells are about `spacing` degrees wide and cover longitudes 0..360 and latitudes -60..60 (degrees).

    >>> torch.rad2deg(cell_grid(60.0)[0])
    tensor([-30.0000,  30.0000])
    """
    rows, columns = max(1, round(120 / spacing)), max(1, round(360 / spacing))
    latitude = (torch.arange(rows, dtype=torch.float64) + 0.5) * (120 / rows) - 60
    longitude = (torch.arange(columns, dtype=torch.float64) + 0.5) * (360 / columns)
    return latitude.deg2rad().float(), longitude.deg2rad().float()


class Arrows(NamedTuple):
    """A score field on `cell_grid`: `latitude` `[A]` and `longitude` `[O]` in degrees, `score` `[A, O, 3]` (latitude,
    longitude, radius; radians, scene units). The longest arrow shows a score of length `scale` (None: the longest).
    """

    latitude: NDArray
    longitude: NDArray
    score: NDArray
    scale: float | None = None

    def lengths(self) -> NDArray:
        """Length of the score in the plane of the map, `[A, O]`."""
        return np.hypot(self.score[..., 0], self.score[..., 1])

    def longest(self) -> float:
        """The greatest length in the plane of the map; 0 for an empty field."""
        return float(np.nan_to_num(self.lengths(), posinf=0.0).max())
