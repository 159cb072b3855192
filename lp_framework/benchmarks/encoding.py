"""What it takes to encode the images of pairs: each view once for all its pairs, against two images a pair."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from lightning.fabric.utilities import move_data_to_device
from torch import Tensor

from lp_framework.benchmarks.contest import Match, Work, compete
from lp_framework.benchmarks.loader import feature_space, plain_pairs
from lp_framework.benchmarks.section import Section
from lp_framework.data.pairs import PairBatch, PairData
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior

ONCE, PLAIN = "each view once", "two images a pair"


def measure(
    views: PairData,
    model: PoseModel,
    prior: Prior,
    batch_pairs: int,
    block: int,
    rounds: int,
    device: torch.device,
    note: str = "",
) -> Iterator[Section]:
    """Pairs a second through the model's backbone, through the prior's encoder, and in training on a frozen backbone.

    The last is a step of what is trained then, the head and the network: on features that the trunk computed once,
    against features of both images of every pair at every step. Batches are drawn beforehand.
    """
    model, prior = model.to(device), prior.to(device)
    once, plain = next(feature_space(views, batch_pairs, block)), next(plain_pairs(views, batch_pairs))
    kept = trunk_features(model, images_of(once, device))
    matches = [
        Match(
            "backbone",
            "pairs a second, backbone",
            encoding(model.encode, once, device),
            encoding(model.encode, plain, device),
        ),
        Match(
            "prior",
            "pairs a second, prior",
            encoding(prior.encode, once, device),
            encoding(prior.encode, plain, device),
        ),
        Match(
            "frozen_training",
            "pairs a second, training on a frozen backbone",
            training(model, once, lambda: kept),
            training(model, plain, lambda: trunk_features(model, images_of(plain, device))),
        ),
    ]
    return compete("encoding: the images of pairs", (ONCE, PLAIN), matches, rounds, device, note)


def images_of(batch: PairBatch, device: torch.device) -> Tensor:
    """The images of a batch, `[I, 3, H, W]`."""
    return move_data_to_device(batch, device).images


@torch.no_grad()
def trunk_features(model: PoseModel, images: Tensor) -> Tensor:
    """`[I, trunk_dim]`, without a graph, as of a frozen trunk."""
    return model.backbone.trunk(images)


def encoding(encode: Callable[[Tensor], object], batch: PairBatch, device: torch.device) -> Work:
    """Encodes a batch's images, which serve its pairs."""

    def work() -> float:
        with torch.no_grad():
            encode(images_of(batch, device))
        return len(batch)

    return work


def training(model: PoseModel, batch: PairBatch, features: Callable[[], Tensor]) -> Work:
    """A step of head and network on a batch whose trunk features `[I, trunk_dim]` are asked for."""
    parameters = [*model.backbone.head.parameters(), *model.network.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=0.0)  # the weights stay, so every step does the same work

    def work() -> float:
        optimizer.zero_grad()
        loss_on(model, batch, features()).backward()
        optimizer.step()
        return len(batch)

    return work


def loss_on(model: PoseModel, batch: PairBatch, features: Tensor) -> Tensor:
    """The objective of a batch on its trunk features `[I, trunk_dim]`."""
    views = model.backbone.head(features)
    true = batch.relative_poses().to(features)
    condition = model.condition(views[batch.reference.to(features.device)], views[batch.query.to(features.device)])
    return model.pair_loss(condition, torch.zeros_like(true), true).mean()
