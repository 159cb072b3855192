"""Networks that match local features of two views and let the matches vote for the relative longitude.

A view is represented by the cells of its feature map that show the object. For each cell the network predicts a
descriptor, and an azimuth about the upright axis relative to the camera. If two views show the same point of the
object, the difference of its azimuths equals the difference of the cameras' longitudes. Matches are soft (dual softmax
with a no-match bin), and votes are harmonics of the azimuths, summed over all pairs of cells.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from torch import Tensor, nn
from torch.nn import functional

from lp_framework.data.photographic import CELLS

HARMONICS = 8  # of a cell's azimuth
BINS = 36  # longitudes at which the network predicts the log-density
SHOWN = 0.05  # minimum coverage for a cell to count as showing the object
MOMENTS = 6  # per cell of a match: position in the image (2), in space (3), and the constant 1


@dataclass(frozen=True)
class ViewCells:
    """K cells of each of I views, with the inputs for the votes; can be indexed like a batch.

    `descriptor` `[I, K, D]` of length 1; `azimuth` `[I, K, 2 H + 1]`, cosines and sines of the multiples of a cell's
    azimuth, with smaller amplitude if it is uncertain; `gates` `[I, K, G]` in [0, 1], the weight of a cell's votes in
    each of G polls; `moments` `[I, K, 6]`; `shown` `[I, K, 1]`, 1 if the cell shows the object and 0 otherwise;
    `pooled` `[I, C]`, features of the whole view; `pose` `[I, 2]`, its latitude and radius in units of `POSE_SCALE`.
    """

    descriptor: Tensor
    azimuth: Tensor
    gates: Tensor
    moments: Tensor
    shown: Tensor
    pooled: Tensor
    pose: Tensor

    def __len__(self) -> int:
        return len(self.pose)

    def __getitem__(self, index: Tensor) -> ViewCells:
        return self._each(lambda value: value[index])

    def flattened(self) -> ViewCells:
        """Views `[I, N]` as `[I x N]`."""
        return self._each(lambda value: value.flatten(0, 1))

    def unflattened(self, count: int) -> ViewCells:
        """Views `[I x count]` as `[I, count]`."""
        return self._each(lambda value: value.unflatten(0, (-1, count)))

    def _each(self, change: Callable[[Tensor], Tensor]) -> ViewCells:
        return ViewCells(**{each.name: change(getattr(self, each.name)) for each in fields(self)})


class Layer(nn.Module):
    """A pre-norm transformer layer (Xiong et al. 2020)."""

    def __init__(self, width: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.heads = heads
        self.attention_norm, self.mlp_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.queries, self.keys_values, self.out = (nn.Linear(width, n * width) for n in (1, 2, 1))
        self.mlp = nn.Sequential(nn.Linear(width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width))
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, shown: Tensor) -> Tensor:
        """`[I, K, C]` to `[I, K, C]`; cells with `shown` `[I, K, 1]` of 0 are not attended to."""
        batch, cells, width = x.shape
        y = self.attention_norm(x)
        queries = self.queries(y).view(batch, cells, self.heads, -1).transpose(1, 2)
        keys, values = self.keys_values(y).view(batch, cells, 2, self.heads, -1).permute(2, 0, 3, 1, 4)
        # Written out because fused attention has a slow backward pass on the CPU.
        logits = (queries @ keys.transpose(-1, -2)).float() / math.sqrt(width / self.heads)
        weights = logits.masked_fill(shown.view(batch, 1, 1, cells) == 0, -1e4).softmax(dim=-1).to(values.dtype)
        attended = (weights @ values).transpose(1, 2).reshape(batch, cells, width)
        x = x + self.dropout(self.out(attended))
        return x + self.dropout(self.mlp(self.mlp_norm(x)))


def position_code(width: int) -> Tensor:
    """Sinusoidal encoding of the cells' positions in the image, `[CELLS^2, width]`."""
    places = torch.linspace(-1, 1, CELLS)
    grid = torch.stack(torch.meshgrid(places, places, indexing="ij"), dim=-1).view(-1, 2)
    phase = grid[:, :, None] * torch.logspace(-0.3, 1.1, width // 4)
    return 0.7 * torch.cat([phase.sin(), phase.cos()], dim=-1).flatten(1)


class ViewEncoder(nn.Module):
    """Transformer over the cells of a view's feature map; returns `ViewCells`."""

    def __init__(
        self, features: int, width: int, layers: int, heads: int, descriptor: int, polls: int, dropout: float
    ) -> None:
        super().__init__()
        self.embed = nn.Linear(features + 4, width)
        self.position = nn.Parameter(position_code(width))
        self.layers = nn.ModuleList(Layer(width, heads, dropout) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        self.descriptor = nn.Linear(width, descriptor)
        self.appearance = nn.Linear(features, descriptor, bias=False)  # gives matches at initialization
        self.azimuth, self.gates = nn.Linear(width, 2 * HARMONICS + 1), nn.Linear(width, polls)
        self.points = nn.Linear(width, 3)
        self.pose = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 2))

    def forward(self, features: Tensor, coverage: Tensor, cells: Tensor) -> tuple[ViewCells, Tensor]:
        """Map features `[I, K, F]`, the object's coverage of each quarter of a cell `[I, K, 4]` and the cells' indices
        `[I, K]` to `ViewCells` and the cells' 3-D points `[I, K, 3]`."""
        share = coverage.mean(dim=-1, keepdim=True)
        shown = (share > SHOWN).float()
        x = self.embed(torch.cat([features, coverage], dim=-1)) + self.position[cells]
        for layer in self.layers:
            x = layer(x, shown)
        x = self.norm(x)
        pooled = (x * share).sum(dim=1) / (share.sum(dim=1) + 1e-3)
        descriptor = functional.normalize((self.descriptor(x) + self.appearance(features)).float(), dim=-1)
        points = self.points(x).float()
        place = torch.stack([cells % CELLS, cells // CELLS], dim=-1) * (2 / (CELLS - 1)) - 1
        moments = torch.cat([place, points.detach(), torch.ones_like(shown)], dim=-1)
        gates = self.gates(x).float().sigmoid() * shown
        azimuth, pose = self.azimuth(x).float(), self.pose(pooled).float()
        return ViewCells(descriptor, azimuth, gates, moments * shown, shown, pooled.float(), pose), points


class Voting(nn.Module):
    """Maps the cells of two views to the log-density of the relative longitude, and relative latitude and radius."""

    def __init__(self, width: int, polls: int) -> None:
        super().__init__()
        self.temperature, self.no_match = nn.Parameter(torch.tensor(2.3)), nn.Parameter(torch.tensor(3.0))
        curves = 2 * polls + 1
        self.read = nn.Sequential(
            _circular(curves, 64, 5), nn.ReLU(), _circular(64, 64, 5), nn.ReLU(), _circular(64, 1, 1)
        )
        self.vote_scale = nn.Parameter(torch.tensor(0.1))
        self.from_moments = nn.Sequential(nn.Linear(MOMENTS**2 + 1, 64), nn.ReLU(), nn.Linear(64, 4))
        self.from_views = nn.Sequential(nn.Linear(2 * width, width), nn.ReLU(), nn.Linear(width, 2))
        angles = torch.arange(HARMONICS + 1)[:, None] * torch.arange(BINS) * (2 * math.pi / BINS)
        self.angles = nn.Buffer(angles, persistent=False)

    def matches(self, reference: ViewCells, query: ViewCells) -> tuple[Tensor, Tensor]:
        """Log-probabilities of matches: for each reference cell over the query's cells and no match `[P, K, K + 1]`,
        and for each query cell over the reference's cells and no match `[P, K + 1, K]`."""
        logits = reference.descriptor @ query.descriptor.transpose(1, 2) * self.temperature.exp()
        logits = logits.masked_fill(reference.shown == 0, -30.0).masked_fill(query.shown.transpose(1, 2) == 0, -30.0)
        none = self.no_match.expand(len(logits), logits.shape[1], 1)
        rows = torch.cat([logits, none], dim=2).log_softmax(dim=2)
        none = self.no_match.expand(len(logits), 1, logits.shape[2])
        return rows, torch.cat([logits, none], dim=1).log_softmax(dim=1)

    def forward(self, reference: ViewCells, query: ViewCells) -> tuple[Tensor, Tensor, Tensor]:
        """Logits `[P, BINS]`; mean and log-deviation `[P, 2]` of latitude and radius, in units of `POSE_SCALE`."""
        rows, columns = self.matches(reference, query)
        weight = (0.5 * (rows[:, :, :-1] + columns[:, :-1])).exp()  # [P, K, K]
        count = weight.sum(dim=(1, 2))[:, None]
        votes = self._votes(reference, query, weight)
        spread = votes.std(dim=-1, keepdim=True)
        amount = (count + 0.1).log()[..., None].expand(-1, -1, BINS)
        curves = torch.cat([0.3 * votes, votes / (spread + 0.05), 0.5 * amount], dim=1)
        logits = self.read(curves).squeeze(1) + self.vote_scale * votes.mean(dim=1)
        moments = (reference.moments.transpose(1, 2) @ (weight @ query.moments)).flatten(1) / (count + 0.1)
        shift = self.from_moments(torch.cat([moments, (count + 0.1).log()], dim=1))
        forth = self.from_views(torch.cat([query.pooled, reference.pooled], dim=-1))
        back = self.from_views(torch.cat([reference.pooled, query.pooled], dim=-1))
        return logits, shift[:, :2] + query.pose - reference.pose + forth - back, shift[:, 2:]

    def _votes(self, reference: ViewCells, query: ViewCells, weight: Tensor) -> Tensor:
        """Votes `[P, polls, BINS]` for each longitude: sum over matches of cos(k (azimuth - azimuth' - longitude))."""
        pairs, cells, polls = reference.gates.shape
        reference_votes = reference.gates[..., None] * reference.azimuth[:, :, None]
        query_votes = (query.gates[..., None] * query.azimuth[:, :, None]).flatten(2)
        query_votes = (weight @ query_votes).view(pairs, cells, polls, -1)
        cosine, sine = reference_votes.split([HARMONICS + 1, HARMONICS], dim=-1)
        cosine_, sine_ = query_votes.split([HARMONICS + 1, HARMONICS], dim=-1)
        zero = sine.new_zeros(*sine.shape[:-1], 1)
        sine, sine_ = torch.cat([zero, sine], dim=-1), torch.cat([zero, sine_], dim=-1)
        real = (cosine * cosine_ + sine * sine_).sum(dim=1)
        imaginary = (sine * cosine_ - cosine * sine_).sum(dim=1)
        votes = real @ self.angles.cos() + imaginary @ self.angles.sin()
        return votes - votes.mean(dim=-1, keepdim=True)


def _circular(inputs: int, outputs: int, size: int) -> nn.Conv1d:
    return nn.Conv1d(inputs, outputs, size, padding=size // 2, padding_mode="circular")
