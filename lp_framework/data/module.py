"""The data module: batches of pairs of a source's views, which are created first if needed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from lightning import LightningDataModule
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader

from lp_framework.data.cache import cached_array, cores, decoded_views, tracked
from lp_framework.data.files import content_key
from lp_framework.data.pairs import BlockSampler, PairBatch, PairData, ViewTable, as_images, in_batches, shard_batches
from lp_framework.data.photographic import decoded_renderings
from lp_framework.data.views import FIELD_OF_VIEW_DEGREES, ObjectViews, ViewSource
from lp_framework.errors import UserError, check_settings
from lp_framework.keyed_random import stable_id

EVALUATION_PAIRS = 224  # default pairs per batch: four objects of eight test views
LARGEST_SET = 8  # maximum number of images evaluated jointly, as in the paper's multi-view table


class FeatureExtractor(Protocol):
    """What the data module requires of a backbone to cache its features."""

    def trunk(self, images: Tensor) -> Tensor:
        """Features `[I, ...]` of images `[I, 3, H, W]` in [-1, 1]."""

    def to(self, device: torch.device) -> object:
        """Move the backbone to a device."""

    def fingerprint(self) -> str:
        """A string that changes whenever the trunk's output for any image would."""


class PairDataModule(LightningDataModule):
    """Ordered pairs among the views of each object of a source.

    `cache` is the folder of decoded views (square, `image_size` pixels per side). A training batch has about
    `batch_pairs` pairs over blocks of `block` views (see `BlockSampler`). To choose the best checkpoint,
    `validation_views` of each object's training views are held out; with `validation_objects`, that many whole objects
    are held out instead, and `validation_views` of each are used. Test views are used only for evaluation; with `crop`
    they are prepared like photographs, which loses the radius.
    """

    def __init__(
        self,
        source: ViewSource,
        cache: str = "datasets/cache",
        image_size: int = 256,
        batch_pairs: int = 1024,
        block: int = 8,
        validation_views: int = 8,
        validation_objects: int = 0,
        photographs: float = 0.0,
        crop: bool = False,
        seed: int = 0,
    ) -> None:
        super().__init__()
        wanted = "at least 2, because a pair needs two views, or 0 for no validation"
        check_settings(
            "data",
            ("image_size", image_size, image_size >= 8, "at least 8"),
            ("batch_pairs", batch_pairs, batch_pairs >= 1, "at least 1"),
            ("block", block, block >= 1, "at least 1"),
            ("validation_views", validation_views, validation_views == 0 or validation_views >= 2, wanted),
            ("validation_objects", validation_objects, validation_objects >= 0, "at least 0"),
            ("photographs", photographs, 0 <= photographs <= 1, "a share from 0 to 1"),
            ("validation_objects", validation_objects, validation_views > 0 or validation_objects == 0,
             "0 where data.validation_views is 0"),
        )  # fmt: skip
        self.source, self.cache = source, Path(cache)
        self.image_size, self.batch_pairs, self.block = image_size, batch_pairs, block
        self.photographs, self.crop = photographs, crop
        self.validation_views, self.validation_objects, self.seed = validation_views, validation_objects, seed
        self.with_points = False  # whether training batches have the 3-D points given by the depths
        self._extractor: FeatureExtractor | None = None
        self._output_digest: list[str] = []  # digest of its output
        self._evaluation: tuple[str, int] | None = None  # protocol and seed
        self._views: int | None = None  # images per set, if sets are evaluated
        self._evaluation_pairs = EVALUATION_PAIRS
        self._left_out: set[tuple[int, int]] = set()
        self._folders: dict[str, list[ObjectViews]] = {}
        self._tables: dict[str, ViewTable] = {}
        self._image_keys: dict[str, str] = {}

    def prepare_data(self) -> None:
        """Create what is missing on disk, in one process: views, decoded views, cached features."""
        self.source.prepare()
        self.data("train" if self._evaluation is None else self.evaluation_split())

    def table(self, split: str) -> ViewTable:
        """All views of a split: "test", "all_train", or "train" and "validation", which divide the training views."""
        if split not in self._tables:
            views = self._on_disk(split)
            if split in ("train", "validation") and self.validation_views:
                views = self._divided(views, held_out=split == "validation")
            self._tables[split] = ViewTable(views)
        return self._tables[split]

    def fingerprint(self, split: str) -> str:
        """A string that changes with the contents of a split's batches: images, names, cameras and labels."""
        table, folder = self.table(split), _folder(split)
        if folder not in self._image_keys:
            self.data(split)
        names = [file.name for file in table.files]
        labels = list(zip(table.names, table.counts, table.ambiguities, table.unique_answer, strict=True))
        angles = table.field_of_view
        # Omitted for the default field of view, so that existing fingerprints stay valid.
        others = [] if (angles == math.radians(FIELD_OF_VIEW_DEGREES)).all() else [angles.tolist()]
        return content_key([], "split", self._image_keys[folder], names, labels, table.cameras.tolist(), *others)

    def _on_disk(self, split: str) -> list[ObjectViews]:
        folder = _folder(split)
        if folder not in self._folders:
            self._folders[folder] = [self.source.views(name, folder) for name in self.source.names()]
        return self._folders[folder]

    def _divided(self, views: Sequence[ObjectViews], held_out: bool) -> list[ObjectViews]:
        """The training views held out for validation, or the remaining ones."""
        if not self.validation_objects:
            return [self._some(each, held_out, left=2) for each in views]
        if self.validation_objects >= len(views):
            count = f"data.validation_objects={self.validation_objects} of {len(views)} objects"
            raise UserError(f"{count} leave none to train on")
        names = sorted((each.name for each in views), key=lambda name: stable_id(f"{self.seed} {name}"))
        drawn = names[: self.validation_objects]
        chosen = [each for each in views if (each.name in drawn) == held_out]
        return [self._some(each, held_out=True, left=0) for each in chosen] if held_out else chosen

    def _some(self, views: ObjectViews, held_out: bool, left: int) -> ObjectViews:
        """The held-out `validation_views` of an object, or its remaining views; at least `left` must remain."""
        count = self.validation_views
        if len(views) < count + left:
            wanted = f"holding out data.validation_views={count} needs at least {count + left}"
            raise UserError(f"object '{views.name}' has {len(views)} training views; {wanted}")
        order = np.random.default_rng([self.seed, stable_id(views.name)]).permutation(len(views))
        kept = np.sort(order[:count] if held_out else order[count:])
        files, index = [views.files[index] for index in kept], torch.from_numpy(kept)
        return replace(views, files=files, cameras=views.cameras[index], field_of_view=views.field_of_view[index])

    def evaluate_on(
        self, protocol: str, seed: int = 0, batch_pairs: int = EVALUATION_PAIRS, views: int | None = None
    ) -> None:
        """Select the pairs of an evaluation protocol for `test_dataloader`, and prepare only their views from now on.

        With `views`, select the sets `ViewTable.view_sets` of that many test views instead. A set is `views` - 1
        consecutive pairs, its first view with each of the others. A batch holds whole sets: at least one, and as many
        as make `batch_pairs` pairs.
        """
        if views is not None and (not isinstance(views, int) or not 2 <= views <= LARGEST_SET):
            raise UserError(f"views must be 2 to {LARGEST_SET} images, or null for pairs; got {views}")
        if views is not None and protocol != "ordered":
            raise UserError(f"protocol={protocol} is for pairs; views={views} has its own protocol, so leave it out")
        self._evaluation, self._views, self._evaluation_pairs = (protocol, seed), views, batch_pairs

    def leave_out(self, pairs: Iterable[Sequence[int]]) -> None:
        """Make `test_dataloader` skip batches whose pairs (rows of the table) are all among `pairs`.

        The other batches stay unchanged, so that their results are bit-identical.
        """
        self._left_out = {(reference, query) for reference, query in pairs}

    def evaluation_split(self) -> str:
        """The split used by the protocol of `evaluate_on`."""
        return "all_train" if self._evaluation is not None and self._evaluation[0] == "ifusion" else "test"

    def cache_features(self, extractor: FeatureExtractor) -> None:
        """Make batches carry the features of a frozen backbone, computed once, instead of images."""
        self._extractor, self._output_digest = extractor, _output_digest(extractor, self.image_size)

    def data(self, split: str) -> PairData:
        """The batches of a split, indexed by pairs."""
        table = self.table(split)
        # Training and validation views share one array, so that a different division needs no new decoding.
        files = [file for views in self._on_disk(split) for file in views.files]
        crop = self.crop and split in ("test", "all_train")
        if _folder(split) == "train" and (self.photographs or self.with_points):
            key, views = decoded_renderings(self._on_disk(split), self.photographs, self.image_size, self.cache)
            arrays = {"images": views["pixels"], "points": views["points"], "cropped": views["cropped"]}
        else:
            key, views = decoded_views(files, self.image_size, self.cache, crop)
            arrays = {"images": views}
        self._image_keys[_folder(split)] = key
        if (extractor := self._extractor) is not None:
            # Keyed by the file of decoded views, whose name identifies how they were decoded.
            feature_key = content_key(
                [], "features", Path(str(views.filename)).stem, extractor.fingerprint(), self._output_digest
            )
            device = self.trainer.strategy.root_device if self.trainer else torch.device("cpu")
            arrays["features"] = cached_array(
                self.cache, feature_key, len(files), lambda: _extracted(extractor, arrays["images"], device)
            )
        place = {file: row for row, file in enumerate(files)}
        rows = np.array([place[file] for file in table.files])
        return PairData(table, **arrays, rows=rows, crop=crop)

    def _ranks(self) -> tuple[int, int]:
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    def train_dataloader(self) -> DataLoader[PairBatch]:
        """All ordered pairs of the training views, once per epoch."""
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
        """The pairs or sets chosen for evaluation, by default all ordered pairs of the test views."""
        data = self.data(self.evaluation_split())
        if self._views is not None:
            sets, others = data.table.view_sets(self._views), self._views - 1
            pairs = np.stack([np.repeat(sets[:, :1], others, axis=1), sets[:, 1:]], axis=-1).reshape(-1, 2)
            count = max(1, self._evaluation_pairs // others) * others
        else:
            pairs, count = data.table.pairs(*(self._evaluation or ("ordered", 0))), self._evaluation_pairs
        batches = in_batches(pairs, count)
        left = [each for each in batches if not self._left_out.issuperset(map(tuple, each.tolist()))]
        return self._listed(data, left)

    def _listed(self, data: PairData, batches: Sequence[NDArray[np.int64]]) -> DataLoader[PairBatch]:
        return DataLoader(data, batch_size=None, sampler=shard_batches(batches, *self._ranks()))


def _folder(split: str) -> str:
    return "test" if split == "test" else "train"


def _output_digest(extractor: FeatureExtractor, size: int) -> list[str]:
    """A coarse digest of the extractor's output for one image; changes with its code and settings, not the machine."""
    image = torch.rand(1, 3, size, size, generator=torch.Generator().manual_seed(0)) * 2 - 1
    with torch.inference_mode():
        features = extractor.trunk(image).float().flatten()
    return [f"{part.mean():.2e}" for part in features.abs().chunk(8)]


def _extracted(extractor: FeatureExtractor, images: NDArray, device: torch.device) -> Iterator[NDArray]:
    """Features `[n, ...]` of consecutive images. On a CPU, each thread computes whole images, so the results do not
    depend on the number of threads."""
    count, workers = (1, cores()) if device.type == "cpu" else (256, 1)
    extractor.to(device)  # not in inference mode: parameters moved there can no longer be trained

    @torch.inference_mode()
    def features(start: int) -> NDArray:
        pixels = torch.tensor(images[start : start + count]).to(device)  # a copy: the cache is read-only
        found: NDArray = extractor.trunk(as_images(pixels)).cpu().numpy()
        return found

    threads, ahead = torch.get_num_threads(), 8 * workers * count
    try:
        with ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            for start in tracked(range(0, len(images), ahead), "computing features"):
                yield from pool.map(features, range(start, min(start + ahead, len(images)), count))
    finally:
        torch.set_num_threads(threads)  # the workers have also set PyTorch's default for new threads
