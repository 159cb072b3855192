"""Pairs of views: evaluation protocols, the training sampler, and the batches that hold the pairs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from lp_framework.data.views import ObjectViews
from lp_framework.errors import UserError, nearest
from lp_framework.geometry import relative_pose
from lp_framework.keyed_random import stable_id

PROTOCOLS = ("ordered", "per_view", "ifusion")


@dataclass
class PairBatch:
    """P pairs among I views: each view is stored once and pairs refer to it by index.

    Fields that may be None are filled on request.
    """

    pixels: Tensor | None  # [I, H, W, 3] (uint8), or ...
    features: Tensor | None  # ... [I, ...] that a frozen backbone computed from them
    names: list[str]  # of the views, as object/image
    poses: Tensor  # [I, 3], view poses, and ...
    cameras: Tensor  # ... [I, 4, 4], the ground truth: float64, always on the CPU
    objects: Tensor  # [I]
    reference: Tensor  # [P], indices of views
    query: Tensor  # [P]
    pairs: Tensor  # [P, 2], the same as rows of the view table
    points: Tensor | None = None  # [I, C^2, 3] (float16), 3-D points seen in C x C cells, object's frame; NaN: none
    cropped: Tensor | None = None  # [I], whether a view is a crop to the object, whose distance is unknown
    field_of_view: Tensor | None = None  # [I], radians (float64), on the CPU; None: unknown, all are crops
    relative: Tensor | None = None  # see `relative_poses`; set when the batch is moved to a device

    def __len__(self) -> int:
        return len(self.reference)

    @property
    def ids(self) -> Tensor:
        """Stable integer ids `[P]` of the pairs: hashes of the views' names, independent of the other data."""
        pairs = zip(self.reference.tolist(), self.query.tolist(), strict=True)
        ids = [stable_id(f"{self.names[reference]} {self.names[query]}") for reference, query in pairs]
        return torch.tensor(ids, dtype=torch.int64, device=self.reference.device)

    @property
    def images(self) -> Tensor:
        """`[I, 3, H, W]` in [-1, 1], computed on the pixels' device to transfer a quarter of the bytes."""
        assert self.pixels is not None  # a batch has either features or pixels
        return as_images(self.pixels)

    def relative_poses(self) -> Tensor:
        """True relative poses `[P, 3]`, float32, on the pairs' device."""
        if self.relative is None:
            return relative_pose(self.poses[self.reference], self.poses[self.query]).float()
        return self.relative

    def to(self, device: torch.device) -> PairBatch:
        """Move the batch to a device, except for float64 tensors, which some devices lack."""
        moved: dict[str, Any] = {
            name: value.to(device)
            for name, value in vars(self).items()
            if isinstance(value, Tensor) and name not in ("poses", "cameras", "field_of_view")
        }
        return replace(self, **moved | {"relative": self.relative_poses().to(device)})


class ViewTable:
    """All views of several objects in one split, numbered 0..N-1 object by object."""

    def __init__(self, objects: Sequence[ObjectViews]) -> None:
        self.objects = list(objects)
        self.names = [views.name for views in objects]
        self.ambiguities = [views.ambiguity for views in objects]
        self.unique_answer = [views.unique_answer for views in objects]
        self.files = [file for views in objects for file in views.files]
        self.view_names = [f"{views.name}/{file.name}" for views in objects for file in views.files]
        self.cameras = torch.cat([views.cameras for views in objects])
        self.poses = torch.cat([views.poses for views in objects])
        self.field_of_view = torch.cat([views.field_of_view for views in objects])
        self.counts = [len(views) for views in objects]
        self.object_of_view = torch.repeat_interleave(torch.arange(len(objects)), torch.tensor(self.counts))
        self._starts = np.cumsum([0, *self.counts])

    def __len__(self) -> int:
        return len(self.files)

    def views_of(self, index: int) -> NDArray[np.int64]:
        """Indices of the views of object `index`."""
        return np.arange(self._starts[index], self._starts[index + 1])

    def pairs(self, protocol: str = "ordered", seed: int = 0) -> NDArray[np.int64]:
        """Ordered pairs `[P, 2]` (reference, query) of a named protocol.

        `ordered`: all ordered pairs of an object's views. `per_view`: each view once as the query, with a random other
        view of its object as the reference (the paper's denominators). `ifusion`: the 20 ordered pairs of an object's
        first five views (iFusion's script, which uses training views).
        """
        if protocol not in PROTOCOLS:
            known = f"{nearest(protocol, PROTOCOLS)} (known: {', '.join(PROTOCOLS)})"
            raise UserError(f"protocol='{protocol}' is not known{known}")
        chosen = []
        for index, name in enumerate(self.names):
            views = self.views_of(index)
            if len(views) < 2:
                raise UserError(f"object '{name}' has {len(views)} view here; a pair needs two")
            if protocol == "per_view":
                random = np.random.default_rng([seed, stable_id(name)])  # independent of the other objects
                others = [random.choice(views[views != query]) for query in views]
                chosen.append(np.stack([np.array(others), views], axis=1))
            else:
                chosen.append(_within(views[:5] if protocol == "ifusion" else views))
        return np.concatenate(chosen)

    def view_sets(self, views: int) -> NDArray[np.int64]:
        """Sets `[S, V]` of `views` images of one object: each view comes first once, followed by the next ones in the
        table's order, wrapping around at the object's last view."""
        chosen = []
        for index, name in enumerate(self.names):
            own = self.views_of(index)
            if len(own) < views:
                raise UserError(f"object '{name}' has {len(own)} views here; sets of views={views} need as many")
            chosen.append(np.stack([np.roll(own, -place) for place in range(views)], axis=1))
        return np.concatenate(chosen)


@dataclass(eq=False)
class PairData(Dataset[PairBatch]):
    """Batches of pairs over a view table, indexed by the pairs `[P, 2]` themselves.

    `images` (uint8), `features`, `points` and `cropped` (see `PairBatch`), where given, have one row per view of the
    table, or more rows, of which `rows` selects the table's. With `crop` all images are crops to the object.
    """

    table: ViewTable
    images: NDArray | None
    features: NDArray | None = None
    points: NDArray | None = None
    cropped: NDArray | None = None
    rows: NDArray[np.int64] | None = None
    crop: bool = False

    def __getitem__(self, pairs: NDArray[np.int64]) -> PairBatch:
        views, place = np.unique(pairs, return_inverse=True)
        place = place.reshape(pairs.shape)
        index, rows = torch.from_numpy(views), views if self.rows is None else self.rows[views]

        def stored(array: NDArray | None) -> Tensor | None:
            return None if array is None else torch.from_numpy(array[rows])

        return PairBatch(
            pixels=stored(self.images) if self.features is None else None,
            features=stored(self.features),
            names=[self.table.view_names[view] for view in views],
            poses=self.table.poses[index],
            cameras=self.table.cameras[index],
            objects=self.table.object_of_view[index],
            reference=torch.from_numpy(place[:, 0]),
            query=torch.from_numpy(place[:, 1]),
            pairs=torch.from_numpy(pairs),
            points=stored(self.points),
            cropped=stored(self.cropped),
            field_of_view=None if self.crop else self.table.field_of_view[index],
        )


def as_images(pixels: Tensor) -> Tensor:
    """Images `[I, 3, H, W]` in [-1, 1] from pixels `[I, H, W, 3]` (uint8)."""
    return pixels.permute(0, 3, 1, 2).float() / 127.5 - 1


class BlockSampler(Sampler[NDArray[np.int64]]):
    """Samples all ordered pairs of every object once per epoch, in batches with many pairs among few views.

    The views of an object are shuffled and cut into blocks of B. A unit is two blocks with the 2 B^2 pairs across them
    (pairs within a block are added to one unit); a batch is a few units of any objects. Each view passes through the
    backbone once and serves about B pairs of its batch. The order depends only on (seed, epoch).

    Units are divided among processes: each gets the same number of batches, whose sizes differ by at most one unit.
    Units are repeated only if there are fewer units than batches.
    """

    def __init__(
        self, table: ViewTable, batch_pairs: int, block: int, seed: int, rank: int = 0, ranks: int = 1
    ) -> None:
        if 1 in table.counts:
            raise UserError(f"object '{table.names[table.counts.index(1)]}' has 1 view to train on; a pair needs two")
        self.table, self.block, self.seed, self.rank, self.ranks = table, block, seed, rank, ranks
        self.units_per_batch = max(1, round(batch_pairs / (2 * block * block)))
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Called by Lightning at the start of every epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        blocks = [-(-count // self.block) for count in self.table.counts]
        units = sum(max(1, each * (each - 1) // 2) for each in blocks)
        return -(-units // self.units_per_batch // self.ranks)

    def __iter__(self) -> Iterator[NDArray[np.int64]]:
        random = np.random.default_rng([self.seed, self.epoch])
        units = [unit for index in range(len(self.table.names)) for unit in self._object_units(index, random)]
        order = random.permutation(len(units))
        batches = len(self) * self.ranks
        order = np.resize(order, max(len(order), batches))  # repeats from the start if there are too few
        for chosen in np.array_split(order, batches)[self.rank :: self.ranks]:
            yield np.concatenate([units[unit] for unit in chosen])

    def _object_units(self, index: int, random: np.random.Generator) -> list[NDArray[np.int64]]:
        views = random.permutation(self.table.views_of(index))
        blocks = [views[start : start + self.block] for start in range(0, len(views), self.block)]
        own = [_within(block) for block in blocks]
        if len(blocks) == 1:
            return own
        units = []
        for i in range(len(blocks)):
            for j in range(i):
                across = _product(blocks[i], blocks[j])
                # Pairs within a block belong to exactly one unit: of block i to (i, i - 1), of block 0 to (1, 0).
                extra = ([own[i]] if j == i - 1 else []) + ([own[0]] if (i, j) == (1, 0) else [])
                units.append(np.concatenate([across, across[:, ::-1], *extra]))
        return units


def _product(a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)


def _within(views: NDArray[np.int64]) -> NDArray[np.int64]:
    pairs = _product(views, views)
    return pairs[pairs[:, 0] != pairs[:, 1]]


def in_batches(pairs: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """Split pairs `[P, 2]` in order, `count` per batch."""
    return [pairs[start : start + count] for start in range(0, len(pairs), count)]


def shard_batches(batches: Sequence[NDArray[np.int64]], rank: int = 0, ranks: int = 1) -> list[NDArray[np.int64]]:
    """The batches of process `rank` of `ranks`. All processes get the same number: if it does not divide evenly, the
    last ones repeat earlier batches, and the metrics count each pair once."""
    rounds = -(-len(batches) // ranks)
    return [batches[(step * ranks + rank) % len(batches)] for step in range(rounds)]
