"""Energies of a pair of views over relative latitude and longitude, and their valleys.

The paper's Figures 1 and 2 (appendix, Additional Zero123 MSE Landscape Visualization): why a start ends in the wrong
valley. The same grid holds the fields of a learned model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from lp_framework.errors import UserError
from lp_framework.models.pose_model import FieldValue
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.progress import steps_of

FLAT = 0.9  # a valley floor of which no more than a tenth of the range is relief tells nothing of the longitude
PROMINENCE = 0.05  # of the landscape's range; a shallower dent is no minimum
BATCH = 64  # poses


class LandscapeMinimum(NamedTuple):
    """A valley's bottom: its place (radians, between the grid's points), and the energy at the nearest of those.

    `height` is where that lies in the landscape's range, from 0 to 1. `prominence` is the climb from there to the
    lowest pass into deeper ground, in units of the range; of the deepest minimum it is 1.
    """

    latitude: float
    longitude: float
    energy: float
    height: float
    prominence: float


class Landscape(NamedTuple):
    """Energies `[A, O]` of one pair at relative latitudes `[A]` and longitudes `[O]` (radians), and one `radius`.

    Latitudes ascend; longitudes are evenly spaced over the whole turn, from 0 up. The radius is relative, in scene
    units.
    """

    latitude: Tensor
    longitude: Tensor
    radius: float
    energy: Tensor

    def minima(self) -> list[LandscapeMinimum]:
        """Its local minima, the deepest first; a dent of less than `PROMINENCE` of the range does not count.

        On a cylinder: periodic in longitude, open in latitude, so the lowest ground on a border is one as well (its
        bottom may lie beyond). A point has eight neighbours. Equal energies side by side are one minimum, saddles are
        none, and a landscape without relief has none. Places are refined by a parabola along either angle.
        """
        energy = self.energy.double().flatten().tolist()
        finite = [cell for cell, value in enumerate(energy) if math.isfinite(value)]
        low, high = (extreme((energy[cell] for cell in finite), default=0.0) for extreme in (min, max))
        if not high > low:
            return []
        found = []
        for cell, climb in self._climbs(energy, sorted(finite, key=energy.__getitem__)).items():
            prominence = min(climb, high - low) / (high - low)
            if prominence >= PROMINENCE:
                height = (energy[cell] - low) / (high - low)
                found.append(LandscapeMinimum(*self._place(cell), energy[cell], height, prominence))
        return sorted(found, key=lambda minimum: minimum.energy)

    def floor(self) -> Tensor:
        """The lowest ground at each longitude `[O]`, in the landscape's range from 0 to 1; all 0 without relief."""
        low, high = self.energy.min(), self.energy.max()
        return (self.energy.min(dim=0).values - low) / torch.where(high > low, high - low, 1.0)

    def flatness(self) -> float:
        """How little the longitude tells: 1 where a valley of one depth runs all around, 0 where a wall blocks it."""
        return 1 - self.floor().max().item()

    def _climbs(self, energy: list[float], ascending: list[int]) -> dict[int, float]:
        """For the bottom of every basin the climb to the pass where it meets a deeper one; endless for the deepest.

        The points are flooded from below: one without flooded neighbours begins a basin, one between basins is a pass.
        """
        rows, columns = self.energy.shape
        basin: dict[int, int] = {}  # of a flooded point a point of the same basin, and at last the basin's bottom
        climbs: dict[int, float] = {}

        def bottom(cell: int) -> int:
            while basin[cell] != cell:
                basin[cell] = basin[basin[cell]]
                cell = basin[cell]
            return cell

        for cell in ascending:
            row, column = divmod(cell, columns)
            around = [
                near * columns + (column + step) % columns
                for near in range(max(0, row - 1), min(rows, row + 2))
                for step in (-1, 0, 1)
            ]
            met = sorted({bottom(each) for each in around if each in basin}, key=energy.__getitem__)
            basin[cell] = met[0] if met else cell
            if not met:
                climbs[cell] = math.inf
            for shallower in met[1:]:
                basin[shallower] = met[0]
                climbs[shallower] = energy[cell] - energy[shallower]
        return climbs

    def _place(self, cell: int) -> tuple[float, float]:
        """Latitude and longitude (radians) of the bottom of the parabolas through a minimum and its neighbours."""
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
    """Where the parabola through three values at -1, 0, 1 is least, at most half a step away; 0 where it is flat."""
    curvature = left - 2 * middle + right
    return min(max((left - right) / (2 * curvature), -0.5), 0.5) if curvature > 0 else 0.0


def landscape_grid(
    latitude_limit: float = 60.0, latitude_step: float = 8.0, longitude_step: float = 12.0
) -> tuple[Tensor, Tensor]:
    """Relative latitudes `[A]` and longitudes `[O]` (radians, float32) of a landscape, of steps in degrees.

    Latitudes go from minus `latitude_limit` up; the defaults are the paper's 16 x 30. `UserError` where the longitudes
    would not be even over the turn.

    >>> [len(each) for each in landscape_grid()]
    [16, 30]
    """
    if not 0 < latitude_limit < 180 or not 0 < latitude_step <= latitude_limit:
        raise UserError(
            f"latitudes need a limit between 0 and 180 degrees and a step up to it, got {latitude_limit} by "
            f"{latitude_step}"
        )
    count = round(360 / longitude_step) if 0 < longitude_step <= 120 else 0
    if count < 3 or abs(count * longitude_step - 360) > 1e-6:
        raise UserError(f"longitude_step_degrees must divide 360 into three or more, got {longitude_step}")
    rows = math.floor(2 * latitude_limit / latitude_step + 1e-9) + 1
    latitude = torch.arange(rows, dtype=torch.float64) * latitude_step - latitude_limit
    longitude = torch.arange(count, dtype=torch.float64) * (360 / count)
    return latitude.deg2rad().float(), longitude.deg2rad().float()


@torch.no_grad()
def prior_landscapes(
    prior: Prior,
    pairs: Pairs,
    radius: Tensor,
    latitude: Tensor,
    longitude: Tensor,
    timesteps: Sequence[int],
    noises: int,
    seed: int,
    batch: int = BATCH,
) -> Tensor:
    """A prior's energies `[B, A, O]` for B pairs, each at its relative radius of `[B]`.

    The mean over timesteps, over `noises` noises each and over both directions of the pair; the noises are the same at
    all poses. No more than `batch` poses pass the prior at once, two samples each. A bar shows the progress inside
    `shown_progress`.
    """
    poses = _poses(radius.to(pairs.images.device), latitude, longitude).flatten(1, 2)
    energies = pose_energies(prior, pairs, poses, timesteps, noises, seed, batch)
    return energies.unflatten(1, (len(latitude), len(longitude)))


@torch.no_grad()
def pose_energies(
    prior: Prior, pairs: Pairs, poses: Tensor, timesteps: Sequence[int], noises: int, seed: int, batch: int = BATCH
) -> Tensor:
    """A prior's energies `[B, N]` of relative poses `[B, N, 3]`; the rest as for `prior_landscapes`."""
    steps = [timestep for timestep in timesteps for _ in range(noises)]
    codes = prior.encode(pairs.images)
    # Several pairs at once, or some poses of one pair.
    groups = torch.arange(len(pairs), device=poses.device).split(max(1, batch // poses.shape[1]))
    parts = torch.arange(poses.shape[1], device=poses.device).split(batch)
    tasks = [(group, part) for group in groups for part in parts]
    energies = poses.new_empty(poses.shape[:2])
    for number in steps_of(len(tasks), "landscape"):
        group, part = tasks[number]
        some = Pairs(pairs.images, pairs.reference[group], pairs.query[group], pairs.ids[group])
        energy = PairEnergy(prior, some, seed, codes)
        place = group[:, None], part
        energies[place] = energy.mean(poses[place], steps, energy.noise(0, count=len(steps)))
    return energies


class PoseField(Protocol):
    """What a landscape asks of a model of the pose, see `PoseModel`."""

    def encode(self, images: Tensor) -> Tensor: ...

    def condition(self, reference: Tensor, query: Tensor) -> Tensor: ...

    def field(self, condition: Tensor, pose: Tensor) -> FieldValue: ...


@torch.no_grad()
def model_landscape(model: PoseField, pairs: Pairs, radius: Tensor, latitude: Tensor, longitude: Tensor) -> FieldValue:
    """A model's scores `[B, A, O, 3]` and, of an energy model, energies `[B, A, O]`, at relative radii `[B]`."""
    features = model.encode(pairs.images)
    condition = model.condition(features[pairs.reference], features[pairs.query])[:, None, None]
    return model.field(condition, _poses(radius.to(pairs.images.device), latitude, longitude))


def _poses(radius: Tensor, latitude: Tensor, longitude: Tensor) -> Tensor:
    """Relative poses `[B, A, O, 3]`, float32."""
    angles = torch.cartesian_prod(latitude.float(), longitude.float()).view(len(latitude), len(longitude), 2)
    angles = angles.to(radius.device).expand(len(radius), -1, -1, -1)
    radii = radius.float()[:, None, None, None].expand(*angles.shape[:3], 1)
    return torch.cat([angles, radii], dim=-1)
