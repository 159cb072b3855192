"""Absolute view poses from relative poses of pairs, some of them grossly wrong.

The paper's "global optimization to obtain a consistent set of absolute poses" (Joint Reasoning across Multiple Views),
from several sets of longitudes by iteratively reweighted least squares on the Geman-McClure cost r^2 / (r^2 + c^2),
whose scale c shrinks to its final value on the way (graduated non-convexity); the one that ends lowest is kept.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lp_framework.geometry import relative_pose, wrap_angle

SCALE = 0.2  # radians and scene units: a measurement off by more counts less the further it is off
FIRST_SCALE = 2.0  # nearly least squares
ROUNDS = 30


@torch.no_grad()
def fit_views(measured: Tensor, weights: Tensor) -> Tensor:
    """Poses `[S, V, 3]` of V images relative to their first (0), float64 on the CPU; longitudes in [0, 2 pi).

    `measured[s, i, j, k]` is the k-th of K measurements of the pose of image j relative to i (longitude on any turn),
    `[S, V, V, K, 3]`; `weights` `[S, V, V, K]`, not negative, say how much each counts. What is not finite counts
    nothing, and so does the diagonal. Two images have the mean of what is measured in both directions, as long as it
    agrees to about `SCALE`, else one of the two.
    """
    measured, weights = measured.cpu(), weights.cpu()
    diagonal = torch.eye(measured.shape[1], dtype=torch.bool)[..., None]
    counted = measured.isfinite().all(dim=-1) & (weights > 0) & ~diagonal
    weights = torch.where(counted, weights, 0.0).double()
    measured = torch.where(counted[..., None], measured, 0.0).double()
    longitude = torch.cat([_synchronised(measured, weights)[:, None], _stars(measured, weights)], dim=1)  # [S, C, V]
    poses = torch.stack([torch.zeros_like(longitude), longitude, torch.zeros_like(longitude)], dim=-1)
    measured, weights = measured[:, None], weights[:, None]
    squared = _residual(poses, measured)[..., 1].square()  # latitude and radius have no first guess
    for scale in torch.logspace(math.log10(FIRST_SCALE), math.log10(SCALE), ROUNDS).tolist():
        poses = _least_squares(poses, measured, weights * (1 + squared / scale**2).pow(-2))
        squared = _residual(poses, measured).square().sum(dim=-1)
    cost = (weights * squared / (squared + SCALE**2)).sum(dim=(-3, -2, -1))
    best = poses[torch.arange(len(poses)), cost.argmin(dim=1)]
    return relative_pose(best[:, :1], best)


def _synchronised(measured: Tensor, weights: Tensor) -> Tensor:
    """Longitudes `[S, V]` by angular synchronisation (Singer 2011): the phases of the leading eigenvector of the
    Hermitian matrix of exp(i (longitude_i - longitude_j))."""
    phases = torch.polar(weights, -measured[..., 1]).sum(dim=-1)
    return torch.linalg.eigh(phases + phases.mH).eigenvectors[..., -1].angle()


def _stars(measured: Tensor, weights: Tensor) -> Tensor:
    """For each image r the longitudes `[S, r, V]` that its own heaviest measurements give the others."""
    heaviest = weights.argmax(dim=-1)[..., None]
    return measured[..., 1].gather(-1, heaviest).squeeze(-1)


def _residual(poses: Tensor, measured: Tensor) -> Tensor:
    """Poses `[S, C, V, 3]` against measurements `[S, 1, V, V, K, 3]`: `[S, C, V, V, K, 3]`, longitudes wrapped."""
    latitude, longitude, radius = (poses[..., None, :, None, :] - poses[..., :, None, None, :] - measured).unbind(-1)
    return torch.stack([latitude, wrap_angle(longitude), radius], dim=-1)


def _least_squares(poses: Tensor, measured: Tensor, weights: Tensor) -> Tensor:
    """One Gauss-Newton step `[S, C, V, 3]` of the weighted squared residuals; the mean over the images stays."""
    residual = (weights[..., None] * _residual(poses, measured)).sum(dim=-2)  # [S, C, V, V, 3]
    gradient = residual.sum(dim=-3) - residual.sum(dim=-2)
    edges = weights.sum(dim=-1)
    edges = edges + edges.mT
    degree = edges.sum(dim=-1)
    laplacian = torch.diag_embed(degree) - edges
    # Moving all images together, or one without measurements, does not change the cost: the step leaves those alone.
    scale = degree.mean(dim=-1)[..., None, None]
    identity = torch.eye(degree.shape[-1], dtype=edges.dtype, device=edges.device)
    solution, _ = torch.linalg.solve_ex(laplacian + scale * (1 + 1e-9 * identity) + (scale == 0) * identity, gradient)
    return poses - solution
