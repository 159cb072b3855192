"""What it takes to encode the images of pairs: each view once for all its pairs, against two images a pair."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import torch
from lightning.fabric.utilities import move_data_to_device
from torch import Tensor

from lp_framework.benchmarks.harness import Contest, Section, Work
from lp_framework.benchmarks.loader import feature_space, loss_on, plain_pairs, told
from lp_framework.data.module import PairDataModule
from lp_framework.data.pairs import PairBatch
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior

ONCE, PLAIN = "each view once", "two images a pair"


def measure(
    data: PairDataModule,
    new_model: PoseModel,
    prior: Prior,
    names: Mapping[str, str],
    rounds: int,
    device: torch.device,
) -> Iterator[Section]:
    """Pairs a second through the model's backbone, through the prior's encoder, and in training on a frozen backbone.

    The last is a step of what is trained then, the head and the network: on features that the trunk computed once,
    against features of both images of every pair at every step. Batches are drawn beforehand.
    """
    views, model, prior = data.data("train"), new_model.to(device), prior.to(device)
    once = next(feature_space(views, data.batch_pairs, data.block))
    plain = next(plain_pairs(views, data.batch_pairs))
    optimizer = torch.optim.Adam(  # the weights stay, so every step does the same work
        [*model.backbone.head.parameters(), *model.network.parameters()], lr=0.0
    )

    def images(batch: PairBatch) -> Tensor:
        return move_data_to_device(batch, device).images

    def encoding(encode: Callable[[Tensor], object], batch: PairBatch) -> Work:
        def work() -> float:
            with torch.no_grad():
                encode(images(batch))
            return len(batch)

        return work

    def training(batch: PairBatch, trunk: Callable[[], Tensor]) -> Work:
        def work() -> float:
            optimizer.zero_grad()
            loss_on(model, batch, device, model.backbone.head(trunk())).backward()
            optimizer.step()
            return len(batch)

        return work

    kept = trunk_features(model, images(once))
    contests = [
        Contest(f"pairs a second, {name}", encoding(encode, once), encoding(encode, plain), rate=True)
        for name, encode in (("backbone", model.encode), ("prior", prior.encode))
    ]
    frozen = training(once, lambda: kept), training(plain, lambda: trunk_features(model, images(plain)))
    contests.append(Contest("pairs a second, training on a frozen backbone", *frozen, rate=True))
    note = f"{told(data, model, names)}; prior={names['prior']}"
    return Section("encoding: the images of pairs", (ONCE, PLAIN), note).race(contests, rounds, device)


@torch.no_grad()
def trunk_features(model: PoseModel, images: Tensor) -> Tensor:
    """`[I, trunk_dim]` of images `[I, 3, H, W]`, without a graph, as of a frozen trunk."""
    return model.backbone.trunk(images)
