"""The paper's joint reasoning over several views, applied to the densities of all pairs.

A pair's density has several modes, and the pair alone often cannot tell which is right. All pairs together can: the
true longitudes agree with every pair. Hypotheses for all longitudes are sampled along random trees of pairs, and each
climbs to a local maximum of the sum of all pairs' log-densities. A view's density is the mixture, over these maxima, of
its density given the other views. Pairs that share views have correlated errors, so together they count for more than
one pair but for less than as many independent ones.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lp_framework.keyed_random import keyed_uniform
from lp_framework.models.pose_density import GRID, PoseDensity

HYPOTHESES = 64
SWEEPS = 10  # coordinate ascent over all views: each moves to its best longitude given the others
DEPENDENCE = 0.7  # at 0, V - 1 pairs count as independent; at 1, together as one
_TREES = 0x4A4F  # makes these draws independent of others under the same seed


def joint_density(density: PoseDensity, sets: int, ids: Tensor, seed: int) -> PoseDensity:
    """The densities of S x (V - 1) views relative to the first, from those of all ordered pairs `[S x V x (V - 1)]`
    (by reference, then query). Draws are keyed by `seed` and the sets' `ids` `[S]`."""
    views = round((1 + math.sqrt(1 + 4 * len(density.logits) / sets)) / 2)
    log_prob = _table(density.logits.log_softmax(dim=-1), sets, views)
    log_prob = (log_prob + log_prob.transpose(1, 2).flip(-1).roll(1, -1)) / 2  # average with the reversed pair
    places = _ascended(log_prob, _sampled(log_prob, ids, seed))
    mean, deviation = _combined(
        _table(density.mean, sets, views), _table(density.deviation.square().reciprocal(), sets, views)
    )
    mixture = _mixture(log_prob, places).flatten(0, 1)
    return PoseDensity(mixture, mean.flatten(0, 1), deviation.flatten(0, 1), density.sigma)


def _table(values: Tensor, sets: int, views: int) -> Tensor:
    """Values `[S x V x (V - 1), C]` of ordered pairs as `[S, V, V, C]`, 0 on the diagonal."""
    table = values.new_zeros(sets, views, views, values.shape[-1])
    off = ~torch.eye(views, dtype=torch.bool, device=values.device)
    table[:, off] = values.unflatten(0, (sets, -1))
    return table


def _sampled(log_prob: Tensor, ids: Tensor, seed: int) -> Tensor:
    """Sample longitudes `[S, H, V]` (grid indices) along random trees of pairs, preferring peaked densities."""
    sets, views = log_prob.shape[:2]
    uniform = keyed_uniform(
        seed, _TREES, ids[:, None, None], torch.arange(HYPOTHESES)[:, None], torch.arange(views - 1), count=2
    ).to(log_prob)
    peak = log_prob.exp().amax(dim=-1)[:, None].expand(-1, HYPOTHESES, -1, -1)
    cumulated = log_prob.exp().cumsum(dim=-1)
    placed = torch.zeros(sets, HYPOTHESES, views, dtype=torch.bool, device=log_prob.device)
    placed[..., 0] = True
    places = torch.zeros(sets, HYPOTHESES, views, dtype=torch.long, device=log_prob.device)
    row, column = torch.meshgrid(
        torch.arange(sets, device=log_prob.device), torch.arange(HYPOTHESES, device=log_prob.device), indexing="ij"
    )
    for step in range(views - 1):
        weight = (peak * placed[..., None] * ~placed[..., None, :]).flatten(2).cumsum(dim=-1)
        pair = torch.searchsorted(weight, uniform[:, :, step, :1] * weight[..., -1:]).squeeze(-1)
        known, new = pair // views, pair % views
        cells = cumulated[row, known, new]
        turn = torch.searchsorted(cells, uniform[:, :, step, 1:] * cells[..., -1:]).squeeze(-1)
        places[row, column, new] = (places[row, column, known] + turn) % GRID
        placed[row, column, new] = True
    return places


def _given_others(log_prob: Tensor, places: Tensor, view: int) -> Tensor:
    """Log-densities of `view` given the other views, summed over their pairs, `[S, H, GRID]`."""
    turn = (torch.arange(GRID, device=log_prob.device) - places[..., None]) % GRID  # [S, H, V, GRID]
    of_view = log_prob[:, None, :, view].expand(-1, places.shape[1], -1, -1)
    return of_view.gather(-1, turn).sum(dim=2) - of_view[:, :, view].gather(-1, turn[:, :, view])


def _ascended(log_prob: Tensor, places: Tensor) -> Tensor:
    """Move each hypothesis to a local maximum by coordinate ascent over the views, for at most `SWEEPS` sweeps."""
    for _ in range(SWEEPS):
        before = places.clone()
        for view in range(1, log_prob.shape[1]):
            places[..., view] = _given_others(log_prob, places, view).argmax(dim=-1)
        if torch.equal(before, places):
            break
    return places


def _mixture(log_prob: Tensor, places: Tensor) -> Tensor:
    """Log-densities `[S, V - 1, GRID]` of all views except the first."""
    _, hypotheses, views = places.shape
    turn = (places[:, :, None] - places[..., None]) % GRID  # [S, H, V, V]
    at = log_prob[:, None].expand(-1, hypotheses, -1, -1, -1).gather(-1, turn[..., None])[..., 0]
    witnesses = (views - 1) ** DEPENDENCE
    score = at.sum(dim=(2, 3)) / 2 / witnesses  # the diagonal is 0
    same = (places[:, :, None] == places[:, None]).all(dim=-1).tril(-1).any(dim=-1)  # duplicates of an earlier one
    share = score.masked_fill(same, -torch.inf).log_softmax(dim=-1)[..., None]
    others = [
        (share + (_given_others(log_prob, places, view) / witnesses).log_softmax(dim=-1)).logsumexp(dim=1)
        for view in range(1, views)
    ]
    return torch.stack(others, dim=1)


def _combined(mean: Tensor, precision: Tensor) -> tuple[Tensor, Tensor]:
    """Least-squares latitude and radius relative to the first view: values and deviations `[S, V - 1, 2]`, from the
    differences `[S, V, V, 2]` of ordered pairs; deviations as from a single pair, see above."""
    views = mean.shape[1]
    weight = (precision + precision.transpose(1, 2)).movedim(-1, 1)  # [S, 2, V, V]
    weight = weight * ~torch.eye(views, dtype=torch.bool, device=mean.device)
    pull = (precision * mean - (precision * mean).transpose(1, 2)).movedim(-1, 1).sum(dim=2)  # [S, 2, V]
    normal = torch.diag_embed(weight.sum(dim=-1)) - weight
    inverse = torch.linalg.inv(normal[..., 1:, 1:].double())
    values = (inverse @ pull[..., 1:, None].double())[..., 0]
    variance = views * inverse.diagonal(dim1=-2, dim2=-1)
    return values.movedim(1, -1).to(mean), variance.sqrt().movedim(1, -1).to(mean)
