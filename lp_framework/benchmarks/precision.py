"""A step of the second stage in reduced precision, in another memory layout and compiled, against plain float32."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import nn

from lp_framework.benchmarks.arithmetic import Arithmetic, counted, peak
from lp_framework.benchmarks.contest import Match, Work, compete
from lp_framework.benchmarks.memory import peak_bytes
from lp_framework.benchmarks.second_stage import ARCHITECTURES, TIMESTEP, Architecture, Batched, halved, random_pair
from lp_framework.benchmarks.section import Figure, Section
from lp_framework.errors import UserError
from lp_framework.priors.zero123.networks import DTYPES, Networks
from lp_framework.priors.zero123.prior import Zero123Prior
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.starts import Ring

VARIANT, PLAIN = "as named", "plain float32"
LAYOUT, COMPILED, RECORDED = "channels_last", "compile", "cuda_graph"


class Variant(NamedTuple):
    """How the U-Net computes."""

    dtype: str = "float32"
    channels_last: bool = False
    compiled: bool = False
    recorded: bool = False

    @staticmethod
    def named(words: str) -> Variant:
        """Of words such as "bfloat16 channels_last compile", in any order; the dtype is float32 where none is named."""
        chosen = words.split()
        dtypes = [word for word in chosen if word in DTYPES]
        known = [*DTYPES, LAYOUT, COMPILED, RECORDED]
        if not chosen or len(dtypes) > 1 or len({*chosen}) < len(chosen) or not {*chosen} <= {*known}:
            raise UserError(
                f"precision.variants: '{words}' is none; give one or more of {', '.join(known)}, with one dtype at most"
            )
        return Variant(dtypes[0] if dtypes else "float32", *(word in chosen for word in (LAYOUT, COMPILED, RECORDED)))


class Contender(NamedTuple):
    """A way to compute the step; on a GPU with the bytes that it takes at most, else 0."""

    runner: Batched
    arithmetic: Arithmetic
    peak_bytes: int


@dataclass(frozen=True)
class Precision:
    """The measurement: `rounds` of `steps` steps of a pair from `starts` starts, on the same random weights."""

    device: torch.device
    architecture: Architecture
    variants: Sequence[str]
    starts: int
    rounds: int
    steps: int
    max_batch: int | None

    def measure(self) -> Iterator[Section]:
        """The section after every stretch. One variant after the other, so that no more than two U-Nets are held."""
        variants = {words: Variant.named(words) for words in self.variants}
        with self.device:
            networks = Networks(ARCHITECTURES[self.architecture])
        pair = random_pair(self.device)
        plain = Zero123Prior(networks, max_batch=self.max_batch).to(self.device)
        codes = plain.encode(pair.images)
        starts = Ring(self.starts).make(pair, seed=0)
        runner = Batched(PairEnergy(plain, pair, 0, codes), starts)
        memory = self.memory(runner, plain)
        with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):  # in which a GPU convolves float32 otherwise
            exact = gradient(runner)
        operations = self.operations()
        ours = Contender(runner, Arithmetic(operations, peak(self.device, torch.float32)), memory)
        title, note = "precision: a step of one pair", f"Zero123's {self.architecture} size, random weights, "
        note += f"{self.starts} starts, a step is {operations / 1e9:.3g} GFLOP"
        figures: list[Figure] = []
        record: dict[str, Any] = {}
        for number, (words, variant) in enumerate(variants.items()):
            for section in self.against(words, self.prior(networks, variant), DTYPES[variant.dtype], ours, exact):
                entry = {words: section.record} if section.record else {}
                yield Section(
                    title,
                    (VARIANT, PLAIN),
                    [*figures, *section.figures],
                    {**record, **entry},
                    (number + section.done) / len(variants),
                    note + section.note,
                )
            figures, record, note = [*figures, *section.figures], {**record, **entry}, note + section.note

    def against(
        self, words: str, prior: Zero123Prior, dtype: torch.dtype, ours: Contender, exact: torch.Tensor
    ) -> Iterator[Section]:
        """A variant's section; `exact` is the gradient `[1, N, 3]` in plain float32. Its U-Net is gone afterwards."""
        plain = ours.runner.energy
        starts = Ring(self.starts).make(plain.pairs, seed=0)
        runner = Batched(PairEnergy(prior, plain.pairs, plain.seed, plain.codes), starts)
        memory = self.memory(runner, prior)
        off = deviation(gradient(runner), exact)
        theirs = Contender(runner, Arithmetic(ours.arithmetic.operations, peak(self.device, dtype)), memory)
        both = {VARIANT: theirs, PLAIN: ours}
        match = Match(words, f"{words}: seconds a step", self.work(theirs.runner), self.work(ours.runner), rate=False)
        for section in compete("", (VARIANT, PLAIN), [match], self.rounds, self.device):
            figures, record = list(section.figures), {}
            if figures:
                shares = [
                    each.arithmetic.share(seconds)
                    for each, seconds in zip(both.values(), (figures[0].first, figures[0].second), strict=True)
                ]
                figures.append(Figure(f"{words}: share of peak", *shares))
                record = {
                    "seconds_per_step": section.record[words],
                    "arithmetic": {name: each.arithmetic.record() for name, each in both.items()},
                    "share_of_peak": dict(zip(both, shares, strict=True)),
                    "gradient_deviation": off,
                }
                if ours.peak_bytes:
                    gigabytes = (each.peak_bytes / 1e9 for each in both.values())
                    figures.append(Figure(f"{words}: peak memory, GB", *gigabytes))
                    record["peak_bytes"] = {name: each.peak_bytes for name, each in both.items()}
            note = f"; {words}: gradient off by {off:.1g}, the device's peak {theirs.arithmetic.peak}"
            yield replace(section, figures=figures, record=record, note=note + halved(prior, self.max_batch))

    def memory(self, runner: Batched, prior: Zero123Prior) -> int:
        """Bytes of the first step, on a GPU, and of the U-Net's weights: once recorded a step takes no more."""
        if self.device.type != "cuda":
            return 0
        step = peak_bytes(lambda: gradient(runner), self.device)
        return step + sum(each.nbytes for each in prior.unet.parameters())

    def prior(self, networks: Networks, variant: Variant) -> Zero123Prior:
        """With a U-Net of its own."""
        others = {id(each): each for each in (networks.vae, networks.image_encoder)}
        own = copy.deepcopy(networks, others)
        nn.Module.to(own.unet, DTYPES[variant.dtype])  # diffusers' own `to` warns of nothing
        settings = variant.channels_last, variant.compiled, variant.recorded
        return Zero123Prior(own, *settings, max_batch=self.max_batch).to(self.device)

    def operations(self) -> int:
        """Of a step, counted on the meta device: nothing is computed."""
        meta = torch.device("meta")
        with meta:
            prior = Zero123Prior(Networks(ARCHITECTURES[self.architecture]))
        pair = random_pair(meta)
        return counted(Batched(PairEnergy(prior, pair, seed=0), Ring(self.starts).make(pair, seed=0)).step)

    def work(self, runner: Batched) -> Work:
        """Some steps, worth as many."""

        def steps() -> float:
            for _ in range(self.steps):
                runner.step()
            return self.steps

        return steps


def gradient(runner: Batched) -> torch.Tensor:
    """Of the energies in the poses, `[1, N, 3]`, before the first step."""
    poses = runner.poses.detach().clone().requires_grad_()
    energies = runner.energy(poses, TIMESTEP, runner.energy.noise(0)[:, 0])
    return torch.autograd.grad(energies.sum(), poses)[0]


def deviation(one: torch.Tensor, other: torch.Tensor) -> float:
    """The largest difference, relative to the largest entry of `other`."""
    return ((one - other).abs().max() / other.abs().max()).item()
