"""`bench`: speed and memory claims, contenders side by side in one run."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator
from statistics import median

import numpy as np
import torch
from lightning.fabric.utilities import move_data_to_device
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from rich.table import Table

from lp_framework import registry
from lp_framework.commands.building import build_data, orderly_console, plain, run_folder, versions
from lp_framework.data.pairs import BlockSampler, PairBatch, PairData
from lp_framework.errors import UserError
from lp_framework.evaluation.tables import write_json
from lp_framework.models.pose_model import PoseModel

FEATURE_SPACE, PLAIN = "pairs in feature space", "plain pair loader"


@orderly_console()
def run(config: DictConfig) -> None:
    """Time training steps (forward, backward, optimiser) on batches of either loader, in turn."""
    if config.rounds < 1 or config.steps < 1:
        raise UserError(f"rounds and steps must be at least 1, got {config.rounds} and {config.steps}")
    folder = run_folder()
    device = _device(config.accelerator)
    data = build_data(config)
    data.prepare_data()
    backbone = registry.build("backbone", config.backbone)
    model: PoseModel = registry.build("model", config.model, backbone=backbone).to(device)
    views = data.data("train")
    contenders = {FEATURE_SPACE: _feature_space(views, config), PLAIN: _plain(views, config.data.batch_pairs)}
    optimizer = torch.optim.Adam(model.parameters(), lr=0.0)  # the weights stay, so every step does the same work
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    pairs: dict[str, int] = {}
    kept: dict[str, float] = {}
    for name, batches in contenders.items():  # warm-up, and the memory
        kept[name], pairs[name] = _kept_for_backward(model, next(batches), device)
    for _ in track(range(config.rounds), description="measuring", transient=True):
        for name, batches in contenders.items():
            began = time.perf_counter()
            done = 0
            for _ in range(config.steps):
                batch = next(batches)
                _step(model, optimizer, batch, device)
                done += len(batch)
            _synchronise(device)
            seconds[name].append((time.perf_counter() - began) / done)
    rates = {name: 1 / median(values) for name, values in seconds.items()}
    per_pair = {name: kept[name] / pairs[name] for name in contenders}
    ratio = {
        "pairs_per_second": rates[FEATURE_SPACE] / rates[PLAIN],
        "bytes_for_backward_per_pair": per_pair[FEATURE_SPACE] / per_pair[PLAIN],
    }
    measured = {
        name: {"pairs_per_second": rates[name], "bytes_for_backward_per_pair": per_pair[name]} for name in contenders
    }
    result = {
        "loader": {**measured, "ratio": ratio},
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or "cpu",
        "threads": torch.get_num_threads(),
        "config": plain(config),
        "versions": versions(),
    }
    write_json(folder / "bench.json", result)
    table = Table(
        title=f"training step, {config.backbone.arch} at {config.backbone.image_size} px", title_justify="left"
    )
    for column in ("loader", "pairs a second", "memory for backward, kB a pair"):
        table.add_column(column, justify="left" if column == "loader" else "right")
    for name in contenders:
        table.add_row(name, f"{rates[name]:.0f}", f"{per_pair[name] / 1024:.0f}")
    table.add_row("ratio", f"{ratio['pairs_per_second']:.1f} x", f"{ratio['bytes_for_backward_per_pair']:.2f} x")
    Console(highlight=False).print(table)
    print(f"results: {folder / 'bench.json'}")


def _device(accelerator: str) -> torch.device:
    available = torch.cuda.is_available()
    if accelerator not in ("auto", "cpu", "cuda") or (accelerator == "cuda" and not available):
        raise UserError(f"accelerator={accelerator} cannot be had here; choose auto or cpu")
    return torch.device("cuda" if available and accelerator != "cpu" else "cpu")


def _feature_space(data: PairData, config: DictConfig) -> Iterator[PairBatch]:
    sampler = BlockSampler(data.table, config.data.batch_pairs, config.data.block, seed=0)
    while True:
        for pairs in sampler:
            yield data[pairs]


def _plain(data: PairData, batch_pairs: int) -> Iterator[PairBatch]:
    """Pairs drawn at random, two images a pair, as a data set of image pairs gives them."""
    everything = data.table.pairs()
    random = np.random.default_rng(0)
    while True:
        drawn = everything[random.choice(len(everything), batch_pairs, replace=False)]
        singles = [data[pair[None]] for pair in drawn]
        offsets = 2 * torch.arange(batch_pairs)
        images = [single.images for single in singles if single.images is not None]
        yield PairBatch(
            images=torch.cat(images),
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
    assert batch.images is not None  # no features are cached here
    features = model.encode(batch.images)
    true = batch.relative_poses()
    condition = model.condition(features[batch.reference], features[batch.query])
    return model.pair_loss(condition, torch.zeros_like(true), true).mean()


def _step(model: PoseModel, optimizer: torch.optim.Optimizer, batch: PairBatch, device: torch.device) -> None:
    optimizer.zero_grad()
    _loss(model, batch, device).backward()
    optimizer.step()


def _kept_for_backward(model: PoseModel, batch: PairBatch, device: torch.device) -> tuple[float, int]:
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


def _synchronise(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
