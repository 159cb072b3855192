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
from lp_framework.benchmarks.second_stage import ARCHITECTURES, TIMESTEP, Architecture, Batched, random_pair
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
        """The section after every stretch."""
        variants = {words: Variant.named(words) for words in self.variants}
        with self.device:
            networks = Networks(ARCHITECTURES[self.architecture])
        pair = random_pair(self.device)
        priors = {words: self.prior(networks, variant) for words, variant in variants.items()}
        plain = Zero123Prior(networks, max_batch=self.max_batch).to(self.device)
        codes = plain.encode(pair.images)
        starts = Ring(self.starts).make(pair.ids, seed=0)
        runners = {words: Batched(PairEnergy(prior, pair, 0, codes), starts) for words, prior in priors.items()}
        runners[PLAIN] = Batched(PairEnergy(plain, pair, 0, codes), starts)
        memory: dict[str, int] = {}
        with torch.backends.cudnn.flags(allow_tf32=False):  # in which a GPU convolves float32 otherwise
            exact = self.first_gradient(PLAIN, runners[PLAIN], plain, memory)
        off = {
            words: deviation(self.first_gradient(words, runners[words], priors[words], memory), exact)
            for words in variants
        }
        operations = self.operations()
        arithmetic = {
            words: Arithmetic(operations, peak(self.device, DTYPES[variant.dtype]))
            for words, variant in {PLAIN: Variant(), **variants}.items()
        }
        matches = [
            Match(words, f"{words}: seconds a step", self.work(runners[words]), self.work(runners[PLAIN]), rate=False)
            for words in variants
        ]
        note = f"Zero123's {self.architecture} size, random weights, {self.starts} starts. " + "; ".join(
            f"{words}: a step is {arithmetic[words]}, gradient off by {off[words]:.1g}" for words in variants
        )
        title = "precision: a step of one pair"
        for section in compete(title, (VARIANT, PLAIN), matches, self.rounds, self.device, note):
            figures: list[Figure] = []
            record: dict[str, Any] = {}
            for seconds in section.figures:
                words = seconds.label.partition(":")[0]
                both = {VARIANT: words, PLAIN: PLAIN}
                figures.append(seconds)
                record[words] = {
                    "seconds_per_step": section.record[words],
                    "arithmetic": {name: arithmetic[each].record() for name, each in both.items()},
                    "gradient_deviation": off[words],
                }
                shares = arithmetic[words].share(seconds.first), arithmetic[PLAIN].share(seconds.second)
                figures.append(Figure(f"{words}: share of peak", *shares))
                record[words]["share_of_peak"] = dict(zip(both, shares, strict=True))
                if memory:
                    figures.append(Figure(f"{words}: peak memory, GB", *(memory[each] / 1e9 for each in both.values())))
                    record[words]["peak_bytes"] = {name: memory[each] for name, each in both.items()}
            yield replace(section, figures=figures, record=record)

    def first_gradient(self, words: str, runner: Batched, prior: Zero123Prior, memory: dict[str, int]) -> torch.Tensor:
        """The gradient before the first step, and on a GPU the memory of it: later a recorded step takes no more."""
        found: list[torch.Tensor] = []
        if self.device.type == "cuda":
            memory[words] = peak_bytes(lambda: found.append(gradient(runner)), self.device)
            memory[words] += sum(each.nbytes for each in prior.unet.parameters())
        else:
            found.append(gradient(runner))
        return found[0]

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
        return counted(Batched(PairEnergy(prior, pair, seed=0), Ring(self.starts).make(pair.ids, seed=0)).step)

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
