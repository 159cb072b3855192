"""A step of the second stage in reduced precision, in another memory layout and compiled, against plain float32."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from lp_framework.benchmarks.arithmetic import peak_rate
from lp_framework.benchmarks.harness import Contest, Section
from lp_framework.benchmarks.second_stage import (
    BATCHED,
    TIMESTEP,
    Architecture,
    Computing,
    arithmetic_of,
    batched,
    encoded,
    held_bytes,
    random_pair,
)
from lp_framework.errors import UserError
from lp_framework.priors.base import Prior
from lp_framework.priors.zero123.networks import DTYPES
from lp_framework.priors.zero123.prior import Zero123Prior
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.starts import Ring

VARIANT, PLAIN = "as named", "plain float32"
SWITCHES = ("channels_last", "compile", "cuda_graph")


def variant(words: str, architecture: Architecture, max_batch: int | None) -> Computing:
    """Of words such as "bfloat16 channels_last compile", in any order; the dtype is float32 where none is named."""
    chosen, known = words.split(), [*DTYPES, *SWITCHES]
    dtypes = [word for word in chosen if word in DTYPES]
    if not chosen or len(dtypes) > 1 or len({*chosen}) < len(chosen) or not {*chosen} <= {*known}:
        raise UserError(
            f"precision.variants: '{words}' is none; give one or more of {', '.join(known)}, with one dtype at most"
        )
    settings = {"dtype": dtypes[0] if dtypes else "float32", **{word: word in chosen for word in SWITCHES}}
    return Computing(architecture, **settings, max_batch=max_batch)  # type: ignore[arg-type]


def measure(
    architecture: Architecture,
    variants: Sequence[str],
    starts: int,
    rounds: int,
    steps: int,
    max_batch: int | None,
    device: torch.device,
) -> Iterator[Section]:
    """`rounds` of `steps` steps of a pair from `starts` starts, on the same random weights.

    One variant after the other, so that no more than two U-Nets are held.
    """
    chosen = {words: variant(words, architecture, max_batch) for words in variants}
    plain = Computing(architecture, max_batch=max_batch)
    networks, pair = plain.networks(device), random_pair(device)
    poses = Ring(starts).make(pair, seed=0)
    prior = plain.prior(networks)
    codes = prior.encode(pair.images)
    ready = encoded(prior, codes)
    operations = starts * arithmetic_of(plain, device)[BATCHED].operations
    memory = step_bytes(ready, pair, poses, device)
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):  # in which a GPU convolves float32 otherwise
        exact = gradient(ready, pair, poses)
    section = Section("precision: a step of one pair", (VARIANT, PLAIN), races=len(chosen))
    section.note = (
        f"Zero123's {architecture} size, random weights, {starts} starts, a step is {operations / 1e9:.3g} GFLOP"
    )
    for words, computing in chosen.items():
        other = computing.prior(networks)
        theirs = encoded(other, codes)
        its_memory = step_bytes(theirs, pair, poses, device)
        off = deviation(gradient(theirs, pair, poses), exact)
        peaks = [peak_rate(device, DTYPES[each.dtype]) for each in (computing, plain)]
        section.note += f"; {words}: gradient off by {off:.1g}, the device's peak {peaks[0] / 1e12:.3g} TFLOP/s"
        section.note += computing.halved(other)
        section.facts[words] = {"gradient_deviation": off, "peak_operations_per_second": peaks[0]}
        contest = Contest(
            f"{words}: seconds a step", batched(theirs, pair, poses, steps), batched(ready, pair, poses, steps)
        )
        yield from section.race([contest], rounds, device)
        shares = (operations / each / peak for each, peak in zip(section.rows[-1].medians, peaks, strict=True))
        section.add(f"{words}: share of peak", *shares)
        if device.type == "cuda":
            section.add(f"{words}: peak memory, GB", its_memory / 1e9, memory / 1e9)
        yield section
        del other, theirs, contest


def step_bytes(prior: Zero123Prior, pair: Pairs, poses: Tensor, device: torch.device) -> int:
    """Bytes of the first step, on a GPU, and of the U-Net's weights: once recorded a step takes no more."""
    return held_bytes(lambda: gradient(prior, pair, poses), prior.unet, device) if device.type == "cuda" else 0


def gradient(prior: Prior, pair: Pairs, poses: Tensor) -> Tensor:
    """Of the energies in the poses `[1, N, 3]`."""
    energy, poses = PairEnergy(prior, pair, seed=0), poses.detach().clone().requires_grad_()
    return torch.autograd.grad(energy(poses, TIMESTEP, energy.noise(0)[:, 0]).sum(), poses)[0]


def deviation(one: Tensor, other: Tensor) -> float:
    """The largest difference, relative to the largest entry of `other`."""
    return ((one - other).abs().max() / other.abs().max()).item()
