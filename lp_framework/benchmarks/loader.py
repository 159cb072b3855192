"""A training step on batches of pairs in feature space, against batches of two images a pair."""

from __future__ import annotations

from collections.abc import Iterator
from statistics import median

import numpy as np
import torch
from lightning.fabric.utilities import move_data_to_device

from lp_framework.benchmarks.section import Figure, Section
from lp_framework.clock import now
from lp_framework.data.pairs import BlockSampler, PairBatch, PairData
from lp_framework.models.pose_model import PoseModel

FEATURE_SPACE, PLAIN = "pairs in feature space", "plain pair loader"


def measure(
    views: PairData,
    model: PoseModel,
    batch_pairs: int,
    block: int,
    rounds: int,
    steps: int,
    device: torch.device,
    note: str = "",
) -> Iterator[Section]:
    """Time training steps (forward, backward, optimiser) on batches of either loader, in turn: `steps` a round."""
    model = model.to(device)
    contenders = {FEATURE_SPACE: feature_space(views, batch_pairs, block), PLAIN: plain_pairs(views, batch_pairs)}
    optimizer = torch.optim.Adam(model.parameters(), lr=0.0)  # the weights stay, so every step does the same work
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    kept: dict[str, float] = {}
    for name, batches in contenders.items():  # warm-up, and the memory
        storage, pairs = kept_for_backward(model, next(batches), device)
        kept[name] = storage / pairs
    for number in range(rounds):
        for name, batches in contenders.items():
            began = now(device)
            done = 0
            for _ in range(steps):
                batch = next(batches)
                _step(model, optimizer, batch, device)
                done += len(batch)
            seconds[name].append((now(device) - began) / done)
        yield _section(seconds, kept, (number + 1) / rounds, note)


def _section(seconds: dict[str, list[float]], kept: dict[str, float], done: float, note: str) -> Section:
    rates = {name: 1 / median(values) for name, values in seconds.items()}
    record: dict[str, dict[str, float]] = {
        name: {"pairs_per_second": rates[name], "bytes_for_backward_per_pair": kept[name]} for name in seconds
    }
    record["ratio"] = {key: value / record[PLAIN][key] for key, value in record[FEATURE_SPACE].items()}
    figures = [
        Figure("pairs a second", rates[FEATURE_SPACE], rates[PLAIN]),
        Figure("memory for backward, kB a pair", kept[FEATURE_SPACE] / 1024, kept[PLAIN] / 1024),
    ]
    return Section("loader: a training step", (FEATURE_SPACE, PLAIN), figures, record, done, note)


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
        singles = [data[pair[None]] for pair in drawn]
        offsets = 2 * torch.arange(batch_pairs)
        yield PairBatch(
            pixels=torch.cat([single.pixels for single in singles if single.pixels is not None]),
            features=None,
            poses=torch.cat([single.poses for single in singles]),
            cameras=torch.cat([single.cameras for single in singles]),
            objects=torch.cat([single.objects for single in singles]),
            reference=torch.cat([single.reference for single in singles]) + offsets,
            query=torch.cat([single.query for single in singles]) + offsets,
            pairs=torch.cat([single.pairs for single in singles]),
        )


def _loss(model: PoseModel, batch: PairBatch, device: torch.device) -> torch.Tensor:
    batch = move_data_to_device(batch, device)
    features = model.encode(batch.images)
    true = batch.relative_poses()
    condition = model.condition(features[batch.reference], features[batch.query])
    return model.pair_loss(condition, torch.zeros_like(true), true).mean()


def _step(model: PoseModel, optimizer: torch.optim.Optimizer, batch: PairBatch, device: torch.device) -> None:
    optimizer.zero_grad()
    _loss(model, batch, device).backward()
    optimizer.step()


def kept_for_backward(model: PoseModel, batch: PairBatch, device: torch.device) -> tuple[float, int]:
    """Bytes of the activations that a step keeps for its backward pass, and the batch's number of pairs."""
    storages: dict[int, int] = {}
    parameters = {parameter.data_ptr() for parameter in model.parameters()}

    def count(tensor: torch.Tensor) -> torch.Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in parameters:
            storages[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(count, lambda tensor: tensor):
        loss = _loss(model, batch, device)
    loss.backward()
    return float(sum(storages.values())), len(batch)
