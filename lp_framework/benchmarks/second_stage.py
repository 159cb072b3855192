"""Seconds per optimisation step of a pair on Zero123: all starts in one batch, against a plain loop over the starts."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any, Literal

import torch
from torch import Tensor, nn

from lp_framework.benchmarks.arithmetic import Arithmetic, counted, launched, peak
from lp_framework.benchmarks.section import Figure, Section
from lp_framework.clock import now
from lp_framework.errors import UserError
from lp_framework.priors.base import ViewCode
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
from lp_framework.solvers.descent import Adam, Plateau
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.twist import SineRadius, TanhRadius, TwistPoses

BATCHED, LOOP = "batched", "plain loop"
TIMESTEP = 500  # the work is that of any other
LEARNING_RATE, FACTOR, PATIENCE = 0.1, 0.6, 10

Architecture = Literal["published", "narrow"]
NARROW: Configs = {  # the same layers, few and narrow: to try the measurement in seconds
    "unet": unet_config([32, 32], 1, [True, False], heads=4, context=32),
    "vae": vae_config([32, 32, 32, 32], 1),
    "image_encoder": clip_config(width=64, layers=1, patch=32, image_size=224, projection=32),
}
ARCHITECTURES: Mapping[Architecture, Configs] = {"published": PUBLISHED, "narrow": NARROW}


def random_pair(device: torch.device) -> Pairs:
    """A pair of random images of Zero123's size."""
    index = torch.arange(2, device=device)
    return Pairs(torch.rand(2, 3, IMAGE_SIZE, IMAGE_SIZE, device=device) * 2 - 1, index[:1], index[1:], ids=index[:1])


def check_counts(name: str, starts: Sequence[int]) -> None:
    """`UserError` unless they are numbers of starts."""
    listed = isinstance(starts, Sequence) and all(isinstance(each, int) and each > 0 for each in starts)
    if not listed or not starts:
        raise UserError(f"{name} must list numbers of starts, at least 1 each, got {starts}")


def halved(prior: Zero123Prior, max_batch: int | None) -> str:
    """What to tell where a GPU had no memory for the samples that were to pass the U-Net at once."""
    size = prior.chunks.size
    return "" if size == max_batch else f" ({size} samples at once, for want of memory)"


class Batched:
    """This package's step, as `two_stage` has it: both directions of all starts `[1, N, 3]` in one batch.

    Images are encoded when `energy` is made; weights have no gradients; twists, rates and losses stay on the device.
    """

    def __init__(self, energy: PairEnergy, starts: Tensor) -> None:
        self.energy, self.steps = energy, 0
        self.pose_of = TwistPoses(starts.clone(), TanhRadius())
        self.twist, self.total = starts.new_zeros(*starts.shape[:2], 6), starts.new_zeros(starts.shape[:2])
        self.adam = Adam(self.twist, LEARNING_RATE)
        self.plateau = Plateau(self.adam, FACTOR, PATIENCE)

    @property
    def poses(self) -> Tensor:
        """Where the starts have come to, `[1, N, 3]`."""
        return self.pose_of(self.twist)

    def step(self) -> None:
        """One update of all starts."""
        noise = self.energy.noise(self.steps)[:, 0]
        twist = self.twist.requires_grad_()
        energies = self.energy(self.pose_of(twist), TIMESTEP, noise)
        (gradient,) = torch.autograd.grad(energies.sum(), twist)
        self.twist = (twist + self.adam.step(gradient)).detach()
        self.total = self.total + energies.detach()
        self.plateau.step(self.total)
        self.steps += 1


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
        self.optimizer = torch.optim.Adam([self.twist], LEARNING_RATE)
        self.scheduler = torch.optim.lr_scheduler.ReduceLROnPlateau(self.optimizer, factor=FACTOR, patience=PATIENCE)

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


@dataclass
class Measured:
    """Of one contender with some number of starts: seconds per step of every round, and the largest peak in bytes."""

    seconds: list[float] = field(default_factory=list)
    peak: int = 0


@dataclass(frozen=True)
class SecondStage:
    """The measurement: `rounds` of `steps` optimisation steps with each number of `starts`, on random weights.

    `dtype` to `max_batch` are those of `prior=zero123`, for the batch; the loop is as published in any case.
    """

    device: torch.device
    architecture: Architecture
    starts: Sequence[int]
    rounds: int
    steps: int
    dtype: Dtype
    channels_last: bool
    compile: bool
    cuda_graph: bool
    attention: Attention
    max_batch: int | None

    def __post_init__(self) -> None:
        check_counts("second_stage.starts", self.starts)
        if self.max_batch is not None and self.max_batch < 1:
            raise UserError(f"second_stage.max_batch must be at least 1 or null, got {self.max_batch}")

    def measure(self) -> Iterator[Section]:
        """The section after every stretch of either contender."""
        work = self.work()
        batch_prior, loop_prior = self.priors()
        pair = random_pair(self.device)
        if self.device.type == "cuda":
            batch_prior.encode(pair.images)  # the first time prepares it
        began = now(self.device)
        energy = PairEnergy(batch_prior, pair, seed=0)
        encoding = now(self.device) - began
        ring = {count: Ring(count).make(pair, seed=0) for count in self.starts}
        batched = {count: Batched(energy, starts) for count, starts in ring.items()}
        loops = [PlainLoop(loop_prior, pair.images, start) for start in ring[max(self.starts)][0]]
        measured = {count: {BATCHED: Measured(), LOOP: Measured()} for count in self.starts}
        for count in self.sizes():
            # A step that is recorded takes its memory now.
            _, measured[count][BATCHED].peak = self.run(batched[count], batch_prior, steps=1)
        loops[0].step()
        done, total = 0, 2 * self.rounds * sum(self.starts)
        for _ in range(self.rounds):
            for count in self.starts:
                contenders: dict[str, tuple[Sequence[Batched | PlainLoop], Zero123Prior]]
                contenders = {BATCHED: ([batched[count]], batch_prior), LOOP: (loops[:count], loop_prior)}
                for name, (runners, prior) in contenders.items():
                    seconds = 0.0
                    for runner in runners:
                        stretch, peak = self.run(runner, prior, self.steps)
                        seconds += stretch / self.steps
                        measured[count][name].peak = max(measured[count][name].peak, peak)
                        done += count // len(runners)
                        few = halved(batch_prior, self.max_batch)
                        yield self.section(measured, work, encoding, done / total, few)
                    measured[count][name].seconds.append(seconds)
                yield self.section(measured, work, encoding, done / total, few)

    def work(self) -> dict[str, Arithmetic]:
        """What a start's step takes of either contender, counted on the meta device: nothing is computed."""
        meta = replace(self, device=torch.device("meta"), compile=False)
        batch_prior, loop_prior = meta.priors()
        pair = random_pair(meta.device)
        batched = Batched(PairEnergy(batch_prior, pair, seed=0), Ring(1).make(pair, seed=0))
        loop = PlainLoop(loop_prior, pair.images, torch.zeros(3))
        pose = torch.zeros(3, device=meta.device, requires_grad=True)
        noise = torch.empty(2, *loop_prior.latent_shape, device=meta.device)
        return {
            BATCHED: Arithmetic(
                counted(batched.step),
                peak(self.device, DTYPES[self.dtype]),
                None if self.compile or self.cuda_graph else launched(batched.step),  # which are there to spare them
            ),
            LOOP: Arithmetic(
                counted(lambda: loop.loss(pose, noise).backward()),
                peak(self.device, torch.float32),
                launched(lambda: loop.loss(pose, noise).backward()),
            ),
        }

    def priors(self) -> tuple[Zero123Prior, Zero123Prior]:
        """The same random weights for the batch and for the loop; they share memory where nothing converts them."""
        from diffusers.models.attention_processor import AttnProcessor

        with self.device:
            networks = Networks(ARCHITECTURES[self.architecture])
        # New parameters around the same storage: a conversion of one does not reach the other.
        shared: dict[int, Any] = {id(each): nn.Parameter(each.detach(), False) for each in networks.parameters()}
        loop = Zero123Prior(copy.deepcopy(networks, shared)).to(self.device)
        loop.unet.set_attn_processor(AttnProcessor())  # softmax(Q K^T / sqrt(d)) V, step by step
        networks.to(DTYPES[self.dtype])
        batch = Zero123Prior(
            networks, self.channels_last, self.compile, self.cuda_graph, self.attention, self.max_batch
        )
        return batch.to(self.device), loop

    def sizes(self) -> Sequence[int]:
        """The numbers of starts to warm up with: on a GPU, and compiled, all, as the first of a size prepares it."""
        return self.starts if self.device.type == "cuda" or self.compile else [min(self.starts)]

    def run(self, runner: Batched | PlainLoop, prior: Zero123Prior, steps: int) -> tuple[float, int]:
        """Seconds of some steps, and on a GPU the peak of memory in bytes: this contender's weights and its work."""
        cuda = self.device.type == "cuda"
        began = now(self.device)
        if cuda:
            torch.cuda.reset_peak_memory_stats(self.device)
            before = torch.cuda.memory_allocated(self.device)
        for _ in range(steps):
            runner.step()
        seconds = now(self.device) - began
        if not cuda:
            return seconds, 0
        weights = sum(each.nbytes for each in prior.parameters())
        return seconds, torch.cuda.max_memory_allocated(self.device) - before + weights

    def section(
        self,
        measured: Mapping[int, Mapping[str, Measured]],
        work: Mapping[str, Arithmetic],
        encoding: float,
        done: float,
        few: str,
    ) -> Section:
        """The figures of those numbers of starts that both contenders have gone through."""
        figures: list[Figure] = []
        record: dict[str, Any] = {}
        for count, both in measured.items():
            entry: dict[str, Any] = {}
            for name, one in both.items():
                if one.seconds:
                    seconds = median(one.seconds)
                    share = count * work[name].share(seconds)
                    entry[name] = {"seconds_per_step": seconds, "rounds": list(one.seconds), "share_of_peak": share}
                    entry[name] |= {"peak_bytes": one.peak} if one.peak else {}
            if len(entry) == 2:
                label = f"{count} start{'s' if count > 1 else ''}"
                rows = [Figure(f"{label}, seconds a step", *(median(one.seconds) for one in both.values()))]
                rows.append(Figure(f"{label}, share of peak", *(entry[name]["share_of_peak"] for name in both)))
                if both[LOOP].peak:
                    rows.append(Figure(f"{label}, peak memory, GB", *(one.peak / 1e9 for one in both.values())))
                entry["ratio"] = {"seconds_per_step": rows[0].ratio}
                entry["ratio"] |= {"peak_bytes": rows[2].ratio} if both[LOOP].peak else {}
                figures += rows
            if entry:
                record[str(count)] = entry
        return Section(
            "second stage: a step of one pair",
            (BATCHED, LOOP),
            figures,
            {
                "starts": record,
                "encoding_seconds": encoding,
                "arithmetic_per_start": {name: one.record() for name, one in work.items()},
            },
            done,
            f"Zero123's {self.architecture} size, random weights. {BATCHED}: all starts and both directions "
            f"together{few}, images encoded once ({encoding:.3g} s, not counted); "
            f"{LOOP}: a start at a time, images anew each step; "
            + "; ".join(f"{name}: a start's step is {one}" for name, one in work.items()),
        )
