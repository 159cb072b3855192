"""Fields of learned models and the exact one, and densities, on the grids that figures show."""

from __future__ import annotations

import torch
from torch import Tensor

from lp_framework.evaluation.landscape import Landscape
from lp_framework.models.pose_model import PoseModel
from lp_framework.solvers.base import Pairs
from lp_framework.viz.fields import Grid, field_on_grid, pose_grid
from lp_framework.viz.pictures import ExactModel

SPACING = 20.0  # degrees, of arrows


def model_grid(model: PoseModel | ExactModel, pairs: Pairs, truth: Tensor, number: int = 0) -> Grid:
    """The field of a model on the grid of arrows, for pair `number`, at the radius of the true relative pose `[3]`."""
    device = pairs.images.device
    with torch.no_grad():
        features = model.encode(pairs.images)
        sides = (features[index[number : number + 1]] for index in (pairs.reference, pairs.query))
        condition = model.condition(*sides)[None]  # [1, 1, hidden]
        return field_on_grid(lambda pose: model.field(condition, pose.to(device)), float(truth[2]), SPACING)


def density(energy: Tensor, latitude: Tensor, longitude: Tensor, truth: Tensor) -> Landscape:
    """exp(-E) over its greatest, of energies `[A, O]` at latitudes `[A]` and longitudes `[O]`; truth `[3]`."""
    return Landscape(latitude, longitude, float(truth[2]), (energy.min() - energy).exp().cpu())


def field_error(model: PoseModel, pairs: Pairs, truth: Tensor) -> float:
    """How far a model's scores are from the exact ones, at the arrows of B pairs with true relative poses `[B, 3]`.

    The root of the mean squared distance over that of the mean squared exact score; radii are the true ones.
    """
    device = pairs.images.device
    with torch.no_grad():
        features = model.encode(pairs.images)
        condition = model.condition(features[pairs.reference], features[pairs.query])[:, None]  # [B, 1, hidden]
        poses = pose_grid(0.0, SPACING).flatten(0, 1).repeat(len(pairs), 1, 1)  # [B, N, 3]
        poses[..., 2] = truth[:, 2:]
        exact = model.kernel.score(poses, truth[:, None])
        learned = model.field(condition, poses.to(device)).score.cpu()
    return float(((learned - exact).square().sum() / exact.square().sum()).sqrt())
