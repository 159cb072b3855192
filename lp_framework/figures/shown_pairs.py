"""Test views of an object by number, as the pairs that figures show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.data.module import PairDataModule
from lp_framework.errors import UserError, nearest
from lp_framework.solvers.base import Pairs, pairs_of


class ShownPairs(NamedTuple):
    """P pairs of test views: the object of each, its title and ambiguity class; `truth` `[P, 3]` true relative poses,
    `poses` `[P, 2, 3]` view poses and `images` `[P, 2, H, W, 3]` (uint8) of reference and query.
    """

    objects: list[str]
    ambiguities: list[str]
    pairs: Pairs
    truth: Tensor
    poses: Tensor
    images: NDArray


def shown_pairs(
    data: PairDataModule, objects: Sequence[str], places: Sequence[tuple[int, int]], device: torch.device
) -> ShownPairs:
    """Pairs of test views (reference, query), numbered from 0 within their object; on a device.

    `UserError` for an object that the data do not have, and for a view that it does not have.
    """
    table = data.table("test")
    chosen = []
    for name, pair in zip(objects, places, strict=True):
        views = table.views_of(object_index(data, name))
        for place, what in zip(pair, ("reference", "query"), strict=True):
            if not 0 <= place < len(views):
                raise UserError(f"object '{name}' has test views 0 to {len(views) - 1}, there is no {what} {place}")
        if pair[0] == pair[1]:
            raise UserError(f"reference and query must be two views, got {pair[0]} for both")
        chosen.append([views[place] for place in pair])
    numbers = np.array(chosen)
    arrays = data.data("test")
    assert arrays.images is not None  # nothing caches features here
    batch = arrays[numbers]
    return ShownPairs(
        list(objects),
        [table.ambiguities[table.names.index(name)] for name in objects],
        pairs_of(batch, table, device),
        batch.relative_poses(),
        table.poses[torch.from_numpy(numbers)],
        np.stack([np.asarray(arrays.images[pair]) for pair in numbers]),
    )


def object_index(data: PairDataModule, name: str) -> int:
    """The place of an object in the table of test views; `UserError` where there is none of that name."""
    names = data.table("test").names
    if name not in names:
        raise UserError(f"the data have no object '{name}'{nearest(name, names)} (known: {', '.join(names)})")
    return names.index(name)


def words(name: str) -> str:
    """An object's or a solver's name as it is read.

    >>> words("two_stage")
    'two stage'
    """
    return name.replace("_", " ")
