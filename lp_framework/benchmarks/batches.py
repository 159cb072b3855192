"""Batches that share views among pairs against batches of two images per pair: loading, encoding, training."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lp_framework.benchmarks.harness import Section, Work, work_of
from lp_framework.data.module import PairDataModule
from lp_framework.data.pairs import PairBatch
from lp_framework.models.pose_model import DenoisingModel
from lp_framework.priors.base import Prior


def measure_loading(section: Section, data: PairDataModule, new_model: DenoisingModel, rounds: int, steps: int) -> None:
    """Time training steps (forward, backward, optimizer) with both loaders in turn: `steps` steps per round."""
    section.title, section.contenders = "loader: a training step", ("pairs in feature space", "plain pair loader")
    optimizer = torch.optim.Adam(new_model.parameters(), lr=0.0)  # constant weights, so every step does the same work

    def training(batches: Iterator[PairBatch]) -> Work:
        def work() -> float:
            done = 0
            for _ in range(steps):
                batch = next(batches)
                optimizer.zero_grad()
                training_loss(new_model, batch.to(section.device)).backward()
                optimizer.step()
                done += len(batch)
            return done

        return work

    loaders = feature_space(data), plain_pairs(data)
    section.note = f"images of {new_model.backbone.image_size} px, {data.batch_pairs} pairs per batch"
    kept = [kept_for_backward(new_model, next(batches).to(section.device)) for batches in loaders]  # doubles as warm-up
    section.add("memory for backward, kB a pair", kept[0] / 1024, kept[1] / 1024)
    works = {"pairs per second": (training(loaders[0]), training(loaders[1]))}
    section.race(works, rounds, rate=True, warm_up=False)


def measure_encoding(
    section: Section, data: PairDataModule, new_model: DenoisingModel, prior: Prior, rounds: int
) -> None:
    """Pairs per second through the model's backbone, through the prior's encoder, and in training with a frozen trunk.

    The last is a training step of the head and the network, with features computed once by the trunk against features
    of both images of every pair computed at every step. Batches are drawn beforehand.
    """
    section.title, section.contenders = "encoding: the images of pairs", ("each view once", "two images per pair")
    once, plain = next(feature_space(data)), next(plain_pairs(data))
    head = new_model.backbone.head
    optimizer = torch.optim.Adam([*head.parameters(), *new_model.network.parameters()], lr=0.0)

    @torch.no_grad()
    def encoded(encoder: Callable[[Tensor], Tensor], batch: PairBatch) -> Tensor:
        return encoder(batch.to(section.device).images)

    def train(batch: PairBatch, trunk: Callable[[], Tensor]) -> None:
        optimizer.zero_grad()
        training_loss(new_model, batch.to(section.device), head(trunk())).backward()
        optimizer.step()

    def encoding(encoder: Callable[[Tensor], Any]) -> tuple[Work, Work]:
        first, second = (work_of(len(batch), partial(encoded, encoder, batch)) for batch in (once, plain))
        return first, second

    trunk = new_model.backbone.trunk
    kept = encoded(trunk, once)
    section.note = f"images of {new_model.backbone.image_size} px, {data.batch_pairs} pairs per batch"
    works = {
        "pairs per second, backbone": encoding(new_model.encode),
        "pairs per second, prior": encoding(prior.encode),
        "pairs per second, training on a frozen backbone": (
            work_of(len(once), lambda: train(once, lambda: kept)),
            work_of(len(plain), lambda: train(plain, lambda: encoded(trunk, plain))),
        ),
    }
    section.race(works, rounds, rate=True)


def feature_space(data: PairDataModule) -> Iterator[PairBatch]:
    """Yield training batches of the data module forever."""
    while True:
        yield from data.train_dataloader()


def plain_pairs(data: PairDataModule) -> Iterator[PairBatch]:
    """Yield random pairs forever, two images per pair, as from a data set of image pairs."""
    views, random = data.data("train"), np.random.default_rng(0)
    everything = views.table.pairs()
    while True:
        yield two_images_per_pair(views[everything[random.choice(len(everything), data.batch_pairs, replace=False)]])


def two_images_per_pair(batch: PairBatch) -> PairBatch:
    """Copy the batch so that every pair has its own two images."""
    views = torch.stack([batch.reference, batch.query], dim=-1).flatten()
    own = {name: getattr(batch, name)[views] for name in ("pixels", "poses", "cameras", "objects")}
    reference = 2 * torch.arange(len(batch))
    return replace(batch, **own, names=[batch.names[view] for view in views], reference=reference, query=reference + 1)


def training_loss(model: DenoisingModel, batch: PairBatch, features: Tensor | None = None) -> Tensor:
    """The training loss of a batch, from its images or, if given, from features `[I, D]` of its views."""
    if features is None:
        features = model.encode(batch.images)
    true = batch.relative_poses()
    condition = model.condition(features[batch.reference], features[batch.query])
    return model.pair_loss(condition, torch.zeros_like(true), true).mean()


def kept_for_backward(model: DenoisingModel, batch: PairBatch) -> float:
    """Bytes of activations per pair that a step keeps for its backward pass."""
    storages: dict[int, int] = {}
    parameters = {parameter.data_ptr() for parameter in model.parameters()}

    def count(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in parameters:
            storages[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(count, lambda tensor: tensor):
        loss = training_loss(model, batch)
    loss.backward()
    return sum(storages.values()) / len(batch)
