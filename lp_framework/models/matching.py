"""The matching model: an energy of the relative pose that generalises to unseen objects.

Unlike a network on pooled features, it does not learn the appearance of certain objects from each viewpoint. It learns
which local features show the same point, and that point's azimuth about the upright axis. See `matching_network`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor, nn

from lp_framework.data.pairs import PairBatch
from lp_framework.data.photographic import CELLS
from lp_framework.errors import UserError, check_settings, positive
from lp_framework.geometry import relative_pose
from lp_framework.models.backbones import Backbone, EfficientNetLite0Maps, Standardise
from lp_framework.models.matching_network import HARMONICS, SHOWN, ViewCells, ViewEncoder, Voting
from lp_framework.models.objectives import PoseKernel
from lp_framework.models.pair_mean import PairMean
from lp_framework.models.pose_density import PoseDensity, from_bins
from lp_framework.models.pose_model import FieldValue, PoseModel
from lp_framework.registry import register

POSE_SCALE = (0.3, 0.25)  # radians, scene units: approximate spread of latitudes and radii
POINT_SCALE = 3.0  # for the cells' 3-D points, whose coordinates lie within half a scene unit
NEAR_AXIS = 0.35  # scene units: closer to the upright axis, a point's azimuth is less informative
MEAN_RADIUS = 1.6
SMALLEST_DEVIATION, LARGEST_DEVIATION = 0.05, 3.0  # of latitude and radius, in units of POSE_SCALE
SAME_POINT = 0.05  # scene units: standard deviation of the distance between two matching cells' points
OVERLAPPING = 1.75  # radians: pairs further apart in longitude share too few points to learn matches from


@register("model", "matching")
class MatchingModel(PoseModel):
    """Energy model from soft matches of local features: -log p of a closed-form density (see `PoseDensity`).

    The backbone must produce feature maps. The `cells` cells of a view with the largest share of the object are
    matched; training samples them at random from all cells on the object. `flips` is the fraction of training objects
    that are mirrored; `feature_noise` is in units of the features' spread. The losses are the negative log-likelihoods
    of the longitude and the Gaussians, plus supervision from rendered depth, weighted by `point_loss` (3-D points),
    `azimuth_loss` and `match_loss`. Inference averages over views and their mirror images and divides the log-density
    of the longitude by `temperature` (Guo et al. 2017), which is above 1 for an overconfident model.
    """

    backbone: EfficientNetLite0Maps
    has_energy, has_density, choose_by, needs_points = True, True, "energy", True

    def __init__(
        self,
        backbone: Backbone,
        sigma: float = 1.0,
        width: int = 128,
        layers: int = 3,
        heads: int = 4,
        descriptor: int = 48,
        polls: int = 6,
        cells: int = 128,
        training_cells: int = 80,
        pairs_per_object: int = 20,
        dropout: float = 0.05,
        feature_noise: float = 0.15,
        flips: float = 0.5,
        temperature: float = 1.0,
        point_loss: float = 1.0,
        azimuth_loss: float = 2.0,
        match_loss: float = 0.5,
        optimizer: Literal["adam", "adamw"] = "adamw",
        learning_rate: float = 1e-3,
        weight_decay: float = 5e-2,
        schedule: Literal["cosine", "constant"] = "cosine",
        seed: int = 0,
    ) -> None:
        super().__init__(backbone, optimizer, learning_rate, weight_decay, schedule, seed)
        positive("model", sigma=sigma, temperature=temperature)
        check_settings("model", ("flips", flips, 0 <= flips <= 1, "in [0, 1]"))
        if not isinstance(backbone, EfficientNetLite0Maps):
            raise UserError("model=matching needs maps of local features: backbone=efficientnet_lite0_maps")
        self.sigma, self.kernel = sigma, PoseKernel("periodic", sigma)
        self.temperature = temperature
        self.cells, self.training_cells = cells, training_cells
        self.pairs_per_object, self.feature_noise, self.flips = pairs_per_object, feature_noise, flips
        self.point_loss, self.azimuth_loss, self.match_loss = point_loss, azimuth_loss, match_loss
        self.standardise = Standardise(backbone.feature_dim)
        self.encoder = ViewEncoder(backbone.feature_dim, width, layers, heads, descriptor, polls, dropout)
        self.voting = Voting(width, polls)
        self.validation_loss = PairMean()
        self.pose_scale = nn.Buffer(torch.tensor(POSE_SCALE), persistent=False)

    def encode(self, images: Tensor) -> ViewCells:
        """The cells of images `[I, 3, H, W]` in [-1, 1] and of their mirror images: each field `[I, 2, ...]`."""
        return self._encode(self.backbone.trunk(images))

    def condition(self, reference: ViewCells, query: ViewCells) -> PoseDensity:
        """The densities of P pairs, given the cells of both views; averages over the views and their mirror images."""
        density = self._density(reference.flattened(), query.flattened())
        straight, mirrored = density.logits.log_softmax(dim=-1).unflatten(0, (-1, 2)).unbind(dim=1)
        logits = torch.logaddexp(straight, mirrored.flip(-1).roll(1, -1)) / self.temperature
        mean = density.mean.unflatten(0, (-1, 2))
        variance = density.deviation.square().unflatten(0, (-1, 2)).mean(dim=1) + mean.var(dim=1, correction=0)
        return PoseDensity(logits, mean.mean(dim=1), variance.sqrt(), self.sigma)

    def field(self, condition: PoseDensity, pose: Tensor) -> FieldValue:
        """Score and energy at relative poses `[..., 3]` of the density, smoothed by the condition's `sigma`."""
        return FieldValue(*condition.smoothed(pose))

    def at_sigma(self, condition: PoseDensity, sigma: float) -> PoseDensity:
        return replace(condition, sigma=sigma)

    def probability(self, condition: PoseDensity, pose: Tensor, degrees: float = 30.0) -> Tensor:
        return condition.probability(pose, degrees)

    def modes(self, condition: PoseDensity, count: int) -> Tensor:
        """The highest maxima `[P, count, 3]` of the longitude's density, at the mean latitude and radius."""
        latitude, radius = condition.mean[:, None].expand(-1, count, -1).unbind(dim=-1)
        return torch.stack([latitude, condition.modes(count), radius], dim=-1)

    def _encode(self, maps: Tensor) -> ViewCells:
        maps = maps.float()  # cached as float16, which cannot be stacked under bfloat16 autocast
        both = torch.stack([maps, self.backbone.mirrored(maps)], dim=1).flatten(0, 1)
        features, coverage, cells = self._foremost(both, self.cells)
        return self.encoder(self._standardised(features, coverage), coverage, cells)[0].unflattened(2)

    def _density(self, reference: ViewCells, query: ViewCells) -> PoseDensity:
        """The networks' density for P pairs of views."""
        with torch.autocast(reference.descriptor.device.type, enabled=False):
            logits, mean, deviation = self.voting(reference, query)
        deviation = deviation.exp().clamp(SMALLEST_DEVIATION, LARGEST_DEVIATION)
        return PoseDensity(from_bins(logits), mean * self.pose_scale, deviation * self.pose_scale, self.sigma)

    def _foremost(self, maps: Tensor, count: int, shuffle: torch.Generator | None = None) -> tuple[Tensor, ...]:
        """Features `[I, K, F]`, coverage `[I, K, 4]` and indices `[I, K]` of the cells that show most of the object."""
        features, coverage = maps.split([maps.shape[-1] - 4, 4], dim=-1)
        share = coverage.float().mean(dim=-1)
        if shuffle is None:
            spread = torch.arange(CELLS**2, device=maps.device) * 79 % CELLS**2  # break ties all over the image
            order = share + 1e-4 * spread / CELLS**2
        else:
            order = (share > SHOWN) * (1 + torch.rand(share.shape, generator=shuffle).to(share))
        cells = order.topk(min(count, CELLS**2), dim=1).indices
        return _taken(features, cells).float(), _taken(coverage, cells).float(), cells

    def _standardised(self, features: Tensor, coverage: Tensor) -> Tensor:
        """Standardise the features of cells on the object; other cells become 0 and do not affect the statistics."""
        shown = coverage.mean(dim=-1) > SHOWN
        result = torch.zeros_like(features)
        result[shown] = self.standardise(features[shown])
        return result

    def training_step(self, batch: PairBatch, batch_idx: int) -> Tensor:
        assert batch.cropped is not None  # because of `needs_points`
        random = self._generator()
        maps, points, poses = self._mirrored(batch, random)
        features, coverage, cells = self._foremost(maps, self.training_cells, random)
        features = self._standardised(features, coverage)
        features = features + self.feature_noise * torch.randn(features.shape, generator=random).to(features)
        views, predicted_points = self.encoder(features, coverage, cells)
        pairs = self._some_pairs(batch, random)
        reference, query = batch.reference[pairs], batch.query[pairs]
        density = self._density(views[reference], views[query])
        true = relative_pose(poses[reference], poses[query])
        cropped = batch.cropped.to(reference.device)
        placed = (poses[:, ::2] - poses.new_tensor([0.0, MEAN_RADIUS])) / self.pose_scale
        losses = {
            "longitude": -density.log_prob(true[:, 1]).mean(),
            "shift": 0.5 * self._shift_loss(density, true, cropped[reference] | cropped[query]),
            "view": 0.5 * _mean_without_crops_radii((views.pose - placed).abs(), cropped),
            **self._geometry_losses(views, predicted_points, _taken(points, cells), poses, reference, query),
        }
        for name, value in losses.items():
            self.log(f"train/{name}", value, batch_size=len(pairs))
        loss = torch.stack(list(losses.values())).sum()
        self.log("train/loss", loss, prog_bar=True, batch_size=len(pairs))
        return loss

    def validation_step(self, batch: PairBatch, batch_idx: int) -> None:
        assert batch.features is not None  # its backbone is frozen
        views = self._encode(batch.features)
        density = self.condition(views[batch.reference], views[batch.query])
        loss = -density.log_prob(batch.relative_poses()[:, 1])
        self.validation_loss.update(batch.ids, loss)
        self.log("val/loss", self.validation_loss, prog_bar=True, on_step=False, on_epoch=True, batch_size=len(batch))

    def _mirrored(self, batch: PairBatch, random: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Maps, points and poses of the batch's views, with some objects mirrored left to right."""
        assert batch.features is not None and batch.points is not None
        objects, place = batch.objects.unique(return_inverse=True)
        flip = (torch.rand(len(objects), generator=random).to(batch.features.device) < self.flips)[place]
        maps = torch.where(flip[:, None, None], self.backbone.mirrored(batch.features), batch.features)
        points = batch.points.view(len(maps), CELLS, CELLS, 3)
        points = torch.where(flip[:, None, None, None], points.flip(2) * points.new_tensor([-1.0, 1.0, 1.0]), points)
        poses = batch.poses.float().to(maps.device)
        sign = torch.where(flip, -1.0, 1.0)
        return maps, points.flatten(1, 2).float(), torch.stack([poses[:, 0], poses[:, 1] * sign, poses[:, 2]], dim=-1)

    def _some_pairs(self, batch: PairBatch, random: torch.Generator) -> Tensor:
        """Indices of up to `pairs_per_object` random pairs of each object."""
        order = torch.randperm(len(batch), generator=random)
        owner = batch.objects.cpu()[batch.reference.cpu()[order]]
        owner, by_object = owner.sort(stable=True)
        rank = torch.arange(len(owner)) - torch.searchsorted(owner, owner)
        return order[by_object[rank < self.pairs_per_object]].to(batch.reference.device)

    def _shift_loss(self, density: PoseDensity, true: Tensor, cropped: Tensor) -> Tensor:
        """Negative log-likelihood of latitude and radius under their Gaussians, plus the means' absolute error."""
        offset = (true[:, ::2] - density.mean) / self.pose_scale
        deviation = density.deviation / self.pose_scale
        loss = 0.5 * (offset / deviation).square() + deviation.log() + offset.abs()
        return _mean_without_crops_radii(loss, cropped)

    def _geometry_losses(
        self, views: ViewCells, predicted: Tensor, points: Tensor, poses: Tensor, reference: Tensor, query: Tensor
    ) -> dict[str, Tensor]:
        """Losses supervised by rendered depth; `points` `[I, K, 3]` in the object's frame, NaN on the background."""
        seen = points.isfinite().all(dim=-1, keepdim=True)
        upright = _turned(points.nan_to_num(), -poses[:, 1])  # as seen from longitude 0
        point_loss = ((predicted - POINT_SCALE * upright).abs() * seen).sum() / seen.sum() / 3
        distance = upright[..., ::2].norm(dim=-1, keepdim=True)
        phase = torch.atan2(upright[..., :1], upright[..., 2:]) * torch.arange(HARMONICS + 1, device=points.device)
        azimuth = torch.cat([phase.cos(), phase[..., 1:].sin()], dim=-1) * (distance / NEAR_AXIS).clamp(max=1)
        azimuth_loss = ((views.azimuth - azimuth).square() * seen).mean() * seen.numel() / seen.sum()
        near = (poses[query, 1] - poses[reference, 1]).cos() > math.cos(OVERLAPPING)
        match_loss = self._match_loss(views, points, reference[near], query[near])
        return {
            "points": self.point_loss * point_loss,
            "azimuth": self.azimuth_loss * azimuth_loss,
            "matches": self.match_loss * match_loss,
        }

    def _match_loss(self, views: ViewCells, points: Tensor, reference: Tensor, query: Tensor) -> Tensor:
        """Cross entropy between predicted and true matches; cells without a match have weight 1/4."""
        if len(reference) == 0:
            return points.new_zeros(())
        first, second = points[reference], points[query]
        seen_first, seen_second = (each.isfinite().all(dim=-1) for each in (first, second))
        distance = torch.cdist(first.nan_to_num(9.0), second.nan_to_num(-9.0))
        same = torch.exp(-0.5 * (distance / SAME_POINT).square()) * (distance < 2.4 * SAME_POINT)
        with torch.autocast(points.device.type, enabled=False):
            rows, columns = self.voting.matches(views[reference], views[query])
        loss = points.new_zeros(())
        for log_prob, true, known in ((rows, same, seen_first), (columns.mT, same.mT, seen_second)):
            total = true.sum(dim=-1, keepdim=True)
            none = (total < 1e-3).float()
            wanted = torch.cat([true / (total + 1e-6) * (1 - none), none], dim=-1)
            weight = torch.where(none[..., 0] > 0, 0.25, 1.0) * known
            loss = loss - ((wanted * log_prob).sum(dim=-1) * weight).sum() / weight.sum().clamp(min=1)
        return loss / 2


def _mean_without_crops_radii(losses: Tensor, cropped: Tensor) -> Tensor:
    """The mean of losses `[B, 2]` of latitude and radius, ignoring the radii of crops `[B]`, which are unknown."""
    known = torch.stack([torch.ones_like(cropped), ~cropped], dim=-1)
    return (losses * known).sum() / known.sum()


def _taken(values: Tensor, cells: Tensor) -> Tensor:
    """Gather values `[I, CELLS^2, C]` at cells `[I, K]`: `[I, K, C]`."""
    return values.gather(1, cells[..., None].expand(-1, -1, values.shape[-1]))


def _turned(points: Tensor, angle: Tensor) -> Tensor:
    """Rotate points `[I, K, 3]` about the upright axis by angles `[I]`, which are added to the azimuths."""
    cosine, sine = angle.cos()[:, None], angle.sin()[:, None]
    x, y, z = points.unbind(dim=-1)
    return torch.stack([x * cosine + z * sine, y, z * cosine - x * sine], dim=-1)
