"""Problems with known answers, for tests of solvers: pairs for `ExactPrior`, and matching models."""

from __future__ import annotations

from typing import Literal

import torch
from exact_prior import ExactPrior, image_of
from torch import Tensor

from lp_framework.geometry import wrap_angle
from lp_framework.models.pose_model import FieldValue
from lp_framework.priors.base import ViewCode
from lp_framework.solvers.base import Pairs, ViewSets


def exact_pairs(count: int, dtype: torch.dtype = torch.float32, seed: int = 0) -> tuple[Pairs, Tensor]:
    """Pairs of two images each and their true relative poses `[B, 3]`, longitudes in [1, 3], latitudes within 0.5."""
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand(2, count, 3, generator=generator, dtype=torch.float64)
    reference = torch.tensor([-0.2, 1.0, 1.4]) + unit[0] * torch.tensor([0.4, 4.0, 0.3])
    true = torch.tensor([-0.5, 1.0, -0.3]) + unit[1] * torch.tensor([1.0, 2.0, 0.6])
    images = image_of(torch.cat([reference, reference + true]).to(dtype))
    number = torch.arange(count)
    return Pairs(images, number, count + number, 1000 + 7 * number), true.to(dtype)


def exact_sets(sets: int, views: int, dtype: torch.dtype = torch.float32, seed: int = 0) -> tuple[ViewSets, Tensor]:
    """Sets of images and the true poses `[S, V - 1, 3]` of the others relative to the first."""
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand(sets, views, 3, generator=generator, dtype=torch.float64)
    poses = (torch.tensor([-0.3, 0.0, 1.3]) + unit * torch.tensor([0.6, 3.0, 0.5])).to(dtype)
    index = torch.arange(sets * views).view(sets, views)
    return ViewSets(image_of(poses.flatten(0, 1)), index, 50 + torch.arange(sets)), poses[:, 1:] - poses[:, :1]


def some(whole: Pairs, index: Tensor) -> Pairs:
    """The pairs at `index`."""
    return Pairs(whole.images, whole.reference[index], whole.query[index], whole.ids[index])


def around(true: Tensor, *longitudes: float) -> Tensor:
    """Starts `[B, N, 3]` at these longitudes from the truth, the other two numbers 0."""
    starts = true[:, None].repeat(1, len(longitudes), 1)
    starts[..., 1] += torch.tensor(longitudes, dtype=true.dtype)
    starts[..., ::2] = 0.0
    return starts


def away(poses: Tensor, true: Tensor) -> Tensor:
    """Differences `[..., 3]` of poses to true ones, longitudes on the circle: in [-pi, pi)."""
    latitude, longitude, radius = (poses - true).unbind(-1)
    return torch.stack([latitude, wrap_angle(longitude), radius], dim=-1)


class ExactModel:
    """A score model of `ExactPrior`'s images: s(x) = truth - x, the score of the line's kernel at sigma 1."""

    has_energy, has_density, sigma, choose_by = False, False, 1.0, "distance"

    def encode(self, images: Tensor) -> Tensor:
        return images.flatten(1)[:, :3]

    def condition(self, reference: Tensor, query: Tensor) -> Tensor:
        return query - reference

    def field(self, condition: Tensor, pose: Tensor) -> FieldValue:
        return FieldValue(condition - pose, None)

    def probability(self, condition: Tensor, pose: Tensor) -> None:
        return None


class FailingPrior(ExactPrior):
    """Energies, or only their gradients, are NaN where a latitude is further than `limit` from 0."""

    def __init__(self, limit: float, what: Literal["energy", "gradient"] = "energy") -> None:
        super().__init__()
        self.limit, self.what = limit, what

    def residual(self, target: ViewCode, source: ViewCode, pose: Tensor, timestep: Tensor, noise: Tensor) -> Tensor:
        residual = super().residual(target, source, pose, timestep, noise)
        failed = (pose[:, 0].abs() > self.limit)[:, None, None, None]
        if self.what == "energy":
            return residual.masked_fill(failed, torch.nan)
        nothing = (residual - residual.detach()).masked_fill(~failed, 1.0).sqrt()  # 0, with an infinite slope
        return residual + nothing.masked_fill(~failed, 0.0)
