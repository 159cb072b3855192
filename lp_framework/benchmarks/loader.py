"""A training step on batches of pairs in feature space, against batches of two images a pair."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from itertools import chain
from typing import Any

import numpy as np
import torch
from lightning.fabric.utilities import move_data_to_device
from torch import Tensor

from lp_framework.benchmarks.harness import Contest, Section, Work
from lp_framework.data.module import PairDataModule
from lp_framework.data.pairs import BlockSampler, PairBatch, PairData
from lp_framework.models.pose_model import PoseModel

FEATURE_SPACE, PLAIN = "pairs in feature space", "plain pair loader"


def measure(
    data: PairDataModule,
    new_model: PoseModel,
    names: Mapping[str, str],
    rounds: int,
    steps: int,
    device: torch.device,
) -> Iterator[Section]:
    """Training steps (forward, backward, optimiser) on batches of either loader, in turn: `steps` a round."""
    views, model = data.data("train"), new_model.to(device)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.0)  # the weights stay, so every step does the same work

    def training(batches: Iterator[PairBatch]) -> Work:
        def work() -> float:
            done = 0
            for _ in range(steps):
                batch = next(batches)
                optimizer.zero_grad()
                loss_on(model, batch, device).backward()
                optimizer.step()
                done += len(batch)
            return done

        return work

    loaders = feature_space(views, data.batch_pairs, data.block), plain_pairs(views, data.batch_pairs)
    section = Section("loader: a training step", (FEATURE_SPACE, PLAIN), told(data, model, names))
    kept = [kept_for_backward(model, next(batches), device) for batches in loaders]  # and a warm-up
    section.add("memory for backward, kB a pair", kept[0] / 1024, kept[1] / 1024)
    contest = Contest("pairs a second", training(loaders[0]), training(loaders[1]), rate=True)
    return section.race([contest], rounds, device, warm_up=False)


def told(data: PairDataModule, model: PoseModel, names: Mapping[str, str]) -> str:
    """The model's backbone and the size of a batch."""
    return f"{names['backbone']} at {model.backbone.image_size} px, {data.batch_pairs} pairs a batch"


def feature_space(data: PairData, batch_pairs: int, block: int) -> Iterator[PairBatch]:
    """Training batches without end, as the data module gives them."""
    sampler = BlockSampler(data.table, batch_pairs, block, seed=0)
    while True:
        for pairs in sampler:
            yield data[pairs]


def plain_pairs(data: PairData, batch_pairs: int) -> Iterator[PairBatch]:
    """Pairs drawn at random, two images a pair, as a data set of image pairs gives them."""
    everything = data.table.pairs()
    random = np.random.default_rng(0)
    while True:
        drawn = everything[random.choice(len(everything), batch_pairs, replace=False)]
        yield side_by_side([data[pair[None]] for pair in drawn])


def side_by_side(batches: list[PairBatch]) -> PairBatch:
    """One batch of several pairs, each with two images of its own."""
    joined: dict[str, Any] = {}
    for name in (field.name for field in fields(PairBatch)):
        parts = [getattr(batch, name) for batch in batches]
        if isinstance(parts[0], Tensor):
            joined[name] = torch.cat(parts)
        else:
            joined[name] = None if parts[0] is None else list(chain(*parts))
    whole = PairBatch(**joined)
    offsets = 2 * torch.arange(len(batches))
    return replace(whole, reference=whole.reference + offsets, query=whole.query + offsets)


def loss_on(model: PoseModel, batch: PairBatch, device: torch.device, features: Tensor | None = None) -> Tensor:
    """The objective of a batch, of its images or of its views' features `[I, D]` where these are given."""
    batch = move_data_to_device(batch, device)
    if features is None:
        features = model.encode(batch.images)
    true = batch.relative_poses()
    condition = model.condition(features[batch.reference], features[batch.query])
    return model.pair_loss(condition, torch.zeros_like(true), true).mean()


def kept_for_backward(model: PoseModel, batch: PairBatch, device: torch.device) -> float:
    """Bytes a pair of the activations that a step keeps for its backward pass."""
    storages: dict[int, int] = {}
    parameters = {parameter.data_ptr() for parameter in model.parameters()}

    def count(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in parameters:
            storages[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(count, lambda tensor: tensor):
        loss = loss_on(model, batch, device)
    loss.backward()
    return sum(storages.values()) / len(batch)
