"""A step of the second stage in reduced precision, in another memory layout and compiled, against plain float32."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from lp_framework.benchmarks.counting import peak_rate
from lp_framework.benchmarks.harness import Section
from lp_framework.benchmarks.second_stage import BATCHED, arithmetic_of
from lp_framework.benchmarks.zero123 import TIMESTEP, Architecture, Computing, batched, encoded, held_bytes, random_pair
from lp_framework.errors import UserError
from lp_framework.priors.base import Prior
from lp_framework.priors.zero123.networks import DTYPES
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.starts import Ring

CONTENDERS = "precision: a step of one pair", ("as named", "plain float32")
SWITCHES = ("channels_last", "compile", "cuda_graph")


def variant(words: str, architecture: Architecture, max_batch: int | None) -> Computing:
    """Of words such as "bfloat16 channels_last compile", in any order; the dtype is float32 where none is named."""
    chosen, known = words.split(), [*DTYPES, *SWITCHES]
    dtypes = [word for word in chosen if word in DTYPES]
    if not chosen or len(dtypes) > 1 or not {*chosen} <= {*known}:
        raise UserError(
            f"precision.variants: '{words}' is none; give one or more of {', '.join(known)}, with one dtype at most"
        )
    settings = {"dtype": dtypes[0] if dtypes else "float32", **{word: word in chosen for word in SWITCHES}}
    return Computing(architecture, **settings, max_batch=max_batch)  # type: ignore[arg-type]


def measure(
    section: Section, architecture: Architecture, variants: Sequence[str], starts: int, rounds: int, steps: int,
    max_batch: int | None,
) -> None:  # fmt: skip
    """`rounds` of `steps` steps of a pair from `starts` starts, on the same random weights.

    One variant after the other, so that no more than two U-Nets are held.
    """
    device, plain = section.device, Computing(architecture, max_batch=max_batch)
    computings = {words: variant(words, architecture, max_batch) for words in variants}
    networks, pair = plain.networks(device), random_pair(device)
    poses = Ring(starts).make(pair, seed=0)
    prior = plain.prior(networks)
    codes = prior.encode(pair.images)
    ready = encoded(prior, codes)
    operations = starts * arithmetic_of(plain, device)[BATCHED].operations
    memory = held_bytes(partial(gradient, ready, pair, poses), prior.unet, device)
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):  # in which a GPU convolves float32 otherwise
        exact = gradient(ready, pair, poses)
    section.note = (
        f"Zero123's {architecture} size, random weights, {starts} starts, a step is {operations / 1e9:.3g} GFLOP"
    )
    for words, computing in computings.items():
        other = computing.prior(networks)
        theirs = encoded(other, codes)
        # The first step: once recorded it takes no more memory.
        its_memory = held_bytes(partial(gradient, theirs, pair, poses), other.unet, device)
        off = ((gradient(theirs, pair, poses) - exact).abs().max() / exact.abs().max()).item()
        peaks = [peak_rate(device, DTYPES[each.dtype]) for each in (computing, plain)]
        section.note += f"; {words}: gradient off by {off:.1g}, the device's peak {peaks[0] / 1e12:.3g} TFLOP/s"
        section.facts[words] = {"gradient_deviation": off, "peak_operations_per_second": peaks[0]}
        label = f"{words}: seconds a step"
        section.race({label: (batched(theirs, pair, poses, steps), batched(ready, pair, poses, steps))}, rounds)
        seconds = section.medians()[label]
        shares = (operations / each / peak for each, peak in zip(seconds, peaks, strict=True))
        section.add(f"{words}: share of peak", *shares)
        if device.type == "cuda":
            section.add(f"{words}: peak memory, GB", its_memory / 1e9, memory / 1e9)
        del other, theirs


def gradient(prior: Prior, pair: Pairs, poses: Tensor) -> Tensor:
    """Of the energies in the poses `[1, N, 3]`."""
    energy, poses = PairEnergy(prior, pair, seed=0), poses.detach().clone().requires_grad_()
    return torch.autograd.grad(energy(poses, TIMESTEP, energy.noise(0)[:, 0]).sum(), poses)[0]
