"""Robust estimation of absolute view poses from relative poses of pairs with gross outliers.

This is the paper's "global optimization to obtain a consistent set of absolute poses" (Joint Reasoning across Multiple
Views). Iteratively reweighted least squares minimizes the Geman-McClure cost r^2 / (r^2 + c^2) from several initial
longitudes, with the scale c shrinking to its final value (graduated non-convexity). The lowest final cost wins.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lp_framework.geometry import relative_pose, wrap_angle

SCALE = 0.2  # radians and scene units: measurements with larger residuals are increasingly down-weighted
FIRST_SCALE = 2.0  # close to ordinary least squares
ROUNDS = 30


@torch.no_grad()
def fit_views(measured: Tensor, weights: Tensor) -> Tensor:
    """Poses `[S, V, 3]` of V images relative to the first (0), float64 on the CPU; longitudes in [0, 2 pi).

    `measured[s, i, j, k]` is the k-th of K measurements of the pose of image j relative to i (longitude modulo 2 pi),
    `[S, V, V, K, 3]`, with non-negative `weights` `[S, V, V, K]`. Non-finite measurements and the diagonal are ignored.
    For two images the result is the mean of the measurements in both directions if they agree to about `SCALE`,
    otherwise one of the two.
    """
    measured, weights = measured.cpu(), weights.cpu()
    diagonal = torch.eye(measured.shape[1], dtype=torch.bool)[..., None]
    counted = measured.isfinite().all(dim=-1) & (weights > 0) & ~diagonal
    weights = torch.where(counted, weights, 0.0).double()
    measured = torch.where(counted[..., None], measured, 0.0).double()
    longitude = torch.cat([_synchronised(measured, weights)[:, None], _stars(measured, weights)], dim=1)  # [S, C, V]
    poses = torch.stack([torch.zeros_like(longitude), longitude, torch.zeros_like(longitude)], dim=-1)
    measured, weights = measured[:, None], weights[:, None]
    squared = _residual(poses, measured)[..., 1].square()  # latitude and radius have no initial guess
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
    """For each image r, the longitudes `[S, r, V]` of all images by the measurements of r with the highest weight."""
    heaviest = weights.argmax(dim=-1)[..., None]
    return measured[..., 1].gather(-1, heaviest).squeeze(-1)


def _residual(poses: Tensor, measured: Tensor) -> Tensor:
    """Residuals `[S, C, V, V, K, 3]` (wrapped longitudes) of poses `[S, C, V, 3]`, `measured` `[S, 1, V, V, K, 3]`."""
    latitude, longitude, radius = (poses[..., None, :, None, :] - poses[..., :, None, None, :] - measured).unbind(-1)
    return torch.stack([latitude, wrap_angle(longitude), radius], dim=-1)


def _least_squares(poses: Tensor, measured: Tensor, weights: Tensor) -> Tensor:
    """One Gauss-Newton step `[S, C, V, 3]` on the weighted squared residuals; keeps the mean over the images."""
    residual = (weights[..., None] * _residual(poses, measured)).sum(dim=-2)  # [S, C, V, V, 3]
    gradient = residual.sum(dim=-3) - residual.sum(dim=-2)
    edges = weights.sum(dim=-1)
    edges = edges + edges.mT
    degree = edges.sum(dim=-1)
    laplacian = torch.diag_embed(degree) - edges
    # Moving all images together, or one without measurements, does not change the cost; the step avoids both.
    scale = degree.mean(dim=-1)[..., None, None]
    identity = torch.eye(degree.shape[-1], dtype=edges.dtype, device=edges.device)
    solution, _ = torch.linalg.solve_ex(laplacian + scale * (1 + 1e-9 * identity) + (scale == 0) * identity, gradient)
    return poses - solution
