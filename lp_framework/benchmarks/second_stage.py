"""Seconds per optimisation step of a pair on Zero123: all starts in one batch, against a plain loop over the starts."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor, nn

from lp_framework.benchmarks.arithmetic import Arithmetic, counted, launched, peak_rate
from lp_framework.benchmarks.harness import Contest, Section, Work, timed, worth
from lp_framework.benchmarks.memory import peak_bytes
from lp_framework.priors.base import Prior, ViewCode
from lp_framework.priors.zero123.attention import Attention
from lp_framework.priors.zero123.networks import (
    DTYPES,
    PUBLISHED,
    Configs,
    Dtype,
    Networks,
    clip_config,
    unet_config,
    vae_config,
)
from lp_framework.priors.zero123.prior import IMAGE_SIZE, Zero123Prior
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.ifusion import IFusion
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.twist import SineRadius, TwistPoses

_Prior = TypeVar("_Prior", bound=Prior)
BATCHED, LOOP = "batched", "plain loop"
TIMESTEP = 500  # the work is that of any other

Architecture = Literal["published", "narrow"]
NARROW: Configs = {  # the same layers, few and narrow: to try the measurement in seconds
    "unet": unet_config([32, 32], 1, [True, False], heads=4, context=32),
    "vae": vae_config([32, 32, 32, 32], 1),
    "image_encoder": clip_config(width=64, layers=1, patch=32, image_size=224, projection=32),
}
ARCHITECTURES: Mapping[Architecture, Configs] = {"published": PUBLISHED, "narrow": NARROW}


@dataclass(frozen=True)
class Computing:
    """How Zero123 computes: its size, and settings of `prior=zero123`."""

    architecture: Architecture = "published"
    dtype: Dtype = "float32"
    channels_last: bool = False
    compile: bool = False
    cuda_graph: bool = False
    attention: Attention = "sdpa"
    max_batch: int | None = None

    def networks(self, device: torch.device) -> Networks:
        """The four networks, with random weights."""
        with device:
            return Networks(ARCHITECTURES[self.architecture])

    def prior(self, networks: Networks) -> Zero123Prior:
        """A prior with the weights of these networks, whose memory it shares where nothing converts them."""
        # New parameters around the same storage: a conversion of one does not reach the other.
        shared: dict[int, Any] = {id(each): nn.Parameter(each.detach(), False) for each in networks.parameters()}
        own = copy.deepcopy(networks, shared)
        for part in (own.unet, own.vae, own.image_encoder):
            nn.Module.to(part, DTYPES[self.dtype])  # diffusers' own `to` warns of nothing
        settings = self.channels_last, self.compile, self.cuda_graph, self.attention, self.max_batch
        return Zero123Prior(own, *settings).to(own.cc_projection.weight.device)

    def halved(self, prior: Zero123Prior) -> str:
        """What to tell where a GPU had no memory for the samples that were to pass the U-Net at once."""
        size = prior.chunks.size
        return "" if size == self.max_batch else f" ({size} samples at once, for want of memory)"


def random_pair(device: torch.device) -> Pairs:
    """A pair of random images of Zero123's size."""
    index = torch.arange(2, device=device)
    return Pairs(torch.rand(2, 3, IMAGE_SIZE, IMAGE_SIZE, device=device) * 2 - 1, index[:1], index[1:], ids=index[:1])


def encoded(prior: _Prior, codes: ViewCode) -> _Prior:
    """The prior, for images that have been encoded before: neither contender is charged for them."""
    ready = copy.copy(prior)
    ready.encode = lambda images: codes  # type: ignore[method-assign]
    return ready


# ---------------------------------------------------------------- the contenders


def batched(prior: Prior, pair: Pairs, starts: Tensor, steps: int) -> Work:
    """Steps of this package's `ifusion` from starts `[1, N, 3]`: all of them and both directions in one batch."""
    return worth(steps, partial(IFusion(prior, steps).solve, pair, starts, 0))


def plain_prior(networks: Networks) -> Zero123Prior:
    """In float32, with attention that spells out its weights: softmax(Q K^T / sqrt(d)) V."""
    from diffusers.models.attention_processor import AttnProcessor

    prior = Computing().prior(networks)
    prior.unet.set_attn_processor(AttnProcessor())
    return prior


class PlainLoop:
    """One start `[3]` of a sequential loop, its costs those of iFusion's published code (`optimize_pose_loop`).

    As there: both images are encoded anew at every step, by the autoencoder once as targets and once as conditions,
    by CLIP as conditions; float32; both directions in one batch of two; attention that spells out its weights, also
    over the single token of the condition; weights without gradients; a twist that lives on the CPU; a loss that is
    read at every step, for the plateau scheduler. Left out, and next to free: condition dropout, sampling of the
    posterior, the progress bar.
    """

    def __init__(self, prior: Zero123Prior, images: Tensor, start: Tensor) -> None:
        self.prior, self.total = prior, 0.0
        self.condition, self.target = images, images.flip(0)  # (reference, query) and (query, reference)
        self.poses = TwistPoses(start.cpu(), SineRadius())
        self.twist = torch.zeros(6, requires_grad=True)
        self.optimizer = torch.optim.Adam([self.twist], lr=0.1)
        self.scheduler = torch.optim.lr_scheduler.ReduceLROnPlateau(self.optimizer, factor=0.6, patience=10)

    def loss(self, pose: Tensor, noise: Tensor) -> Tensor:
        """Mean squared error of both directions for a pose `[3]` and noise `[2, *latent_shape]`."""
        source = self.prior.encode(self.condition)  # VAE and CLIP
        latent = self.prior.vae.encode(self.target).latent_dist.mode()  # VAE
        target = ViewCode(latent, source.embedding)  # a target's embedding is not read
        poses = torch.stack([pose, -pose]).to(noise.device)
        timestep = torch.full((2,), TIMESTEP, device=noise.device)
        return self.prior.residual(target, source, poses, timestep, noise).square().mean()

    def step(self) -> None:
        """One update of the start."""
        self.optimizer.zero_grad()
        noise = torch.randn(2, *self.prior.latent_shape, device=self.condition.device)
        loss = self.loss(self.poses(self.twist), noise)
        loss.backward()
        self.optimizer.step()
        self.total += loss.item()
        self.scheduler.step(self.total)


def looped(loops: Sequence[PlainLoop], steps: int) -> Work:
    """Steps of each start, one start after the other."""

    def run() -> None:
        for loop in loops:
            for _ in range(steps):
                loop.step()

    return worth(steps, run)


# ---------------------------------------------------------------- the measurement


def measure(
    computing: Computing, starts: Sequence[int], rounds: int, steps: int, device: torch.device
) -> Iterator[Section]:
    """`rounds` of `steps` optimisation steps with each number of `starts`, on random weights.

    `computing` is how the batch is computed; the loop is as published in any case.
    """
    networks, pair = computing.networks(device), random_pair(device)
    batch_prior, loop_prior = computing.prior(networks), plain_prior(networks)
    if device.type == "cuda":
        batch_prior.encode(pair.images)  # the first time prepares it
    encoding, codes = timed(lambda: batch_prior.encode(pair.images), device)
    ready = encoded(batch_prior, codes)
    ring = {count: Ring(count).make(pair, seed=0) for count in starts}
    loops = [PlainLoop(loop_prior, pair.images, start) for start in ring[max(starts)][0]]
    arithmetic = arithmetic_of(computing, device)
    section = Section("second stage: a step of one pair", (BATCHED, LOOP))

    if not (computing.compile or computing.cuda_graph):  # which are there to spare launches
        one, two = (launched(batched(ready, pair, ring[min(starts)], number)) for number in (1, 2))
        arithmetic[BATCHED] = arithmetic[BATCHED]._replace(launches=two - one)

    # A step of some size is prepared when it is first taken; recorded, it takes its memory then.
    first = {count: batched(ready, pair, poses, 1) for count, poses in ring.items()}
    if device.type == "cuda":
        peaks = {count: held_bytes(work, batch_prior, device) for count, work in first.items()}
        loop_peak = held_bytes(loops[0].step, loop_prior, device)
        for count, peak in peaks.items():
            section.add(f"{told(count)}, peak memory, GB", peak / 1e9, loop_peak / 1e9)
    else:
        for count in starts if computing.compile else [min(starts)]:
            first[count]()
        loops[0].step()
    section.note = (
        f"Zero123's {computing.architecture} size, random weights. {BATCHED}: all starts and both directions "
        f"together{computing.halved(batch_prior)}, images encoded once ({encoding:.3g} s, not counted); "
        f"{LOOP}: a start at a time, images anew each step; "
        + "; ".join(f"{name}: a start's step is {each}" for name, each in arithmetic.items())
    )
    section.facts = {
        "encoding_seconds": encoding,
        "arithmetic_per_start": {name: each._asdict() for name, each in arithmetic.items()},
    }
    contests = [
        Contest(f"{told(count)}, seconds a step", batched(ready, pair, poses, steps), looped(loops[:count], steps))
        for count, poses in ring.items()
    ]
    yield from section.race(contests, rounds, device, warm_up=False)
    for count, row in zip(starts, section.rows[-len(starts) :], strict=True):
        shares = (count * each.share(seconds) for each, seconds in zip(arithmetic.values(), row.medians, strict=True))
        section.add(f"{told(count)}, share of peak", *shares)
    yield section


def told(starts: int) -> str:
    """The number of starts in words."""
    return f"{starts} start{'s' if starts > 1 else ''}"


def held_bytes(work: Callable[[], object], prior: nn.Module, device: torch.device) -> int:
    """The peak of memory of a contender, in bytes: its weights, and what its work takes."""
    return peak_bytes(work, device) + sum(each.nbytes for each in prior.parameters())


def arithmetic_of(computing: Computing, device: torch.device) -> dict[str, Arithmetic]:
    """What the energy of a start and its gradient take of either contender, counted without computing anything."""
    meta = torch.device("meta")
    networks, pair = computing.networks(meta), random_pair(meta)
    prior = Computing(dtype=computing.dtype, attention=computing.attention).prior(networks)
    energy, loop = PairEnergy(prior, pair, seed=0), PlainLoop(plain_prior(networks), pair.images, torch.zeros(3))
    poses = torch.zeros(1, 1, 3, device=meta, requires_grad=True)
    noise = torch.empty(1, 2, *prior.latent_shape, device=meta)

    def ours() -> None:
        energy(poses, TIMESTEP, noise).sum().backward()

    def plain() -> None:
        loop.loss(poses[0, 0], noise[0]).backward()

    return {
        BATCHED: Arithmetic(counted(ours), peak_rate(device, DTYPES[computing.dtype])),
        LOOP: Arithmetic(counted(plain), peak_rate(device, torch.float32), launched(plain)),
    }
