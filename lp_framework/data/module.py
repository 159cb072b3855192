"""The data module: views of objects on disk, rendered first where need be, as batches of pairs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from lightning import LightningDataModule
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader

from lp_framework.data.cache import cached_array, content_key, decoded_views, tracked
from lp_framework.data.pairs import (
    BlockSampler,
    ListSampler,
    PairBatch,
    PairData,
    Rows,
    ViewTable,
    as_images,
    in_batches,
)
from lp_framework.data.views import ObjectViews, object_names, read_views
from lp_framework.errors import UserError

EVALUATION_PAIRS = 224  # pairs a batch, by default; four objects of eight test views
LARGEST_SET = 8  # images that are evaluated together at most, as in the paper's multi-view table


class FeatureExtractor(Protocol):
    """What the data module asks of a backbone in order to cache its features."""

    trunk_dim: int

    def trunk(self, images: Tensor) -> Tensor:
        """Features `[I, trunk_dim]` of images `[I, 3, H, W]` in [-1, 1]."""

    def to(self, device: torch.device) -> object:
        """Move it there."""

    def fingerprint(self) -> str:
        """A text that changes when the trunk's output for some image would."""


class PairDataModule(LightningDataModule):
    """Ordered pairs among each object's views, from a folder of views.

    `path` holds the views, `cache` the decoded ones (square, `image_size` pixels a side). A training batch has about
    `batch_pairs` pairs over blocks of `block` views (see `BlockSampler`). `validation_views` of each object's training
    views are held out to choose the best checkpoint; the test views are not touched before evaluation.
    """

    def __init__(
        self, path: str, cache: str, image_size: int, batch_pairs: int, block: int, validation_views: int, seed: int
    ) -> None:
        super().__init__()
        for name, value, least in (("image_size", image_size, 8), ("batch_pairs", batch_pairs, 1), ("block", block, 1)):
            if value < least:
                raise UserError(f"data.{name} must be at least {least}, got {value}")
        if validation_views == 1 or validation_views < 0:
            raise UserError(
                f"data.validation_views must be 0 or at least 2, a pair needs two views; got {validation_views}"
            )
        self.path, self.cache = Path(path), Path(cache)
        self.image_size, self.batch_pairs, self.block = image_size, batch_pairs, block
        self.validation_views, self.seed = validation_views, seed
        self._extractor: FeatureExtractor | None = None
        self._evaluation: tuple[str, int] | None = None  # protocol and seed
        self._views: int | None = None  # images a set, where sets are evaluated
        self._evaluation_pairs = EVALUATION_PAIRS
        self._left_out: set[tuple[int, int]] = set()
        self._folders: dict[str, list[ObjectViews]] = {}
        self._tables: dict[str, ViewTable] = {}
        self._image_keys: dict[str, str] = {}

    # ------------------------------------------------------------ what there is

    def prepare_data(self) -> None:
        """Make what is missing on disk, in one process: decoded views, cached features."""
        self.data("train" if self._evaluation is None else self.evaluation_split())

    def table(self, split: str) -> ViewTable:
        """All views of a split: "train" and "validation" divide the training views, "all_train" does not; "test"."""
        if split not in self._tables:
            views = self._on_disk(split)
            if split in ("train", "validation") and self.validation_views:
                views = [self._validation_split(each, held_out=split == "validation") for each in views]
            self._tables[split] = ViewTable(views)
        return self._tables[split]

    def names(self) -> list[str]:
        """The objects of this data set, sorted: all whose views are in `path`."""
        return object_names(self.path)

    def fingerprint(self, split: str) -> str:
        """A text that changes with what a split's batches are made of: its images, names, cameras and labels."""
        table, folder = self.table(split), _folder(split)
        if folder not in self._image_keys:
            self.data(split)
        names = [file.name for file in table.files]
        labels = list(zip(table.names, table.counts, table.ambiguities, table.unique_answer, strict=True))
        return content_key([], "split", self._image_keys[folder], names, labels, table.cameras.tolist())

    def _on_disk(self, split: str) -> list[ObjectViews]:
        folder = _folder(split)
        if folder not in self._folders:
            self._folders[folder] = [read_views(self.path, name, folder) for name in self.names()]
        return self._folders[folder]

    def _validation_split(self, views: ObjectViews, held_out: bool) -> ObjectViews:
        count = self.validation_views
        if len(views) < count + 2:
            raise UserError(
                f"object '{views.name}' has {len(views)} training views; holding out data.validation_views={count} "
                "leaves fewer than two to train on"
            )
        order = np.random.default_rng([self.seed, len(views)]).permutation(len(views))
        kept = np.sort(order[:count] if held_out else order[count:])
        files, cameras = [views.files[index] for index in kept], views.cameras[torch.from_numpy(kept)]
        return replace(views, files=files, cameras=cameras)

    def evaluate_on(self, protocol: str, seed: int, batch_pairs: int = EVALUATION_PAIRS) -> None:
        """From now on prepare only what the pairs of an evaluation protocol need; `test_dataloader` gives them."""
        self._evaluation, self._views, self._evaluation_pairs = (protocol, seed), None, batch_pairs

    def evaluate_on_sets(self, views: int, batch_pairs: int = EVALUATION_PAIRS) -> None:
        """From now on prepare only the test views; `test_dataloader` gives `ViewTable.view_sets` of so many images.

        A set comes as the pairs of its first view with each other one, `views` - 1 in a row, a batch holds whole sets:
        as many as make `batch_pairs` pairs, one at least.
        """
        if not isinstance(views, int) or not 2 <= views <= LARGEST_SET:
            raise UserError(f"views must be 2 to {LARGEST_SET} images, or null for pairs; got {views}")
        self._evaluation, self._views, self._evaluation_pairs = ("view_sets", 0), views, batch_pairs

    def leave_out(self, pairs: Iterable[Sequence[int]]) -> None:
        """From now on `test_dataloader` leaves out the batches all of whose pairs (rows of the table) are among these.

        The other batches stay as they are, so that what is computed of them stays the same to the last bit.
        """
        self._left_out = {(reference, query) for reference, query in pairs}

    def evaluation_split(self) -> str:
        """The split that the protocol of `evaluate_on` takes its pairs from."""
        return "all_train" if self._evaluation is not None and self._evaluation[0] == "ifusion" else "test"

    def cache_features(self, extractor: FeatureExtractor) -> None:
        """From now on batches carry the features of a frozen backbone, computed once, instead of images."""
        self._extractor = extractor

    def _features(self, key: str, images: NDArray) -> NDArray | None:
        if self._extractor is None:
            return None
        extractor, device = self._extractor, self._device()
        shape = (len(images), extractor.trunk_dim)
        feature_key = content_key([], "features", key, extractor.fingerprint())
        return cached_array(
            self.cache, feature_key, shape, np.float32, lambda array: _extract(extractor, images, array, device)
        )

    # ------------------------------------------------------------ batches

    def data(self, split: str) -> PairData:
        """The batches of a split, addressed by pairs."""
        table = self.table(split)
        # Training and validation views share one array, so that another way to divide them decodes nothing anew.
        files = [file for views in self._on_disk(split) for file in views.files]
        key, images = decoded_views(files, self.image_size, self.cache)
        self._image_keys[_folder(split)] = key
        features = self._features(key, images)
        if files == table.files:
            return PairData(table, images, features)
        place = {file: row for row, file in enumerate(files)}
        rows = np.array([place[file] for file in table.files])
        return PairData(table, Rows(images, rows), None if features is None else Rows(features, rows))

    def _device(self) -> torch.device:
        """Where the networks are going to be."""
        return self.trainer.strategy.root_device if self.trainer else torch.device("cpu")

    def _ranks(self) -> tuple[int, int]:
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    def train_dataloader(self) -> DataLoader[PairBatch]:
        """All ordered pairs of the training views once an epoch."""
        data = self.data("train")
        sampler = BlockSampler(data.table, self.batch_pairs, self.block, self.seed, *self._ranks())
        return DataLoader(data, batch_size=None, sampler=sampler)

    def val_dataloader(self) -> DataLoader[PairBatch] | list[DataLoader[PairBatch]]:
        """All ordered pairs of the held-out training views, always in the same order."""
        if not self.validation_views:
            return []
        data = self.data("validation")
        return self._listed(data, in_batches(data.table.pairs("ordered"), self.batch_pairs))

    def test_dataloader(self) -> DataLoader[PairBatch]:
        """The pairs or sets to evaluate on that were chosen, by default all ordered pairs of the test views."""
        data = self.data(self.evaluation_split())
        if self._views is not None:
            sets = data.table.view_sets(self._views)
            pairs = np.stack([np.repeat(sets[:, :1], self._views - 1, axis=1), sets[:, 1:]], axis=-1).reshape(-1, 2)
            count = max(1, self._evaluation_pairs // (self._views - 1)) * (self._views - 1)
        else:
            pairs, count = data.table.pairs(*(self._evaluation or ("ordered", 0))), self._evaluation_pairs
        batches = [
            each for each in in_batches(pairs, count) if not self._left_out.issuperset(map(tuple, each.tolist()))
        ]
        return self._listed(data, batches)

    def _listed(self, data: PairData, batches: Sequence[NDArray[np.int64]]) -> DataLoader[PairBatch]:
        return DataLoader(data, batch_size=None, sampler=ListSampler(batches, *self._ranks()))


def _folder(split: str) -> str:
    return "test" if split == "test" else "train"


def _extract(extractor: FeatureExtractor, images: NDArray, array: NDArray, device: torch.device) -> None:
    batch = 32 if device.type == "cpu" else 256
    extractor.to(device)  # not in inference mode: what is moved there cannot be trained any more
    with torch.inference_mode():
        for start in tracked(range(0, len(images), batch), "computing features"):
            pixels = torch.tensor(images[start : start + batch]).to(device)  # a copy: the cache is read-only
            array[start : start + batch] = extractor.trunk(as_images(pixels)).cpu().numpy()
