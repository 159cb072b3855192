"""The second stage on Zero123: all starts in one batch against a plain loop over them; a step, and a whole pair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import torch

from lp_framework.benchmarks.counting import counted, launched, peak_rate
from lp_framework.benchmarks.harness import Section, timed, worth
from lp_framework.benchmarks.zero123 import (
    TIMESTEP,
    Computing,
    PlainLoop,
    batched,
    encoded,
    held_bytes,
    looped,
    plain_prior,
    random_pair,
)
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.zero123.networks import DTYPES
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.two_stage import TwoStage

BATCHED, LOOP = "batched", "plain loop"
STEP = "second stage: a step of one pair", (BATCHED, LOOP)
PAIR = "pair: both stages and encoding", (BATCHED, LOOP)


class Arithmetic(NamedTuple):
    """The operations of a start's step, in how many launches, and how many a second the device's peak is."""

    operations: int
    peak: float
    launches: int | None = None  # where they were counted


def measure_step(section: Section, computing: Computing, starts: Sequence[int], rounds: int, steps: int) -> None:
    """`rounds` of `steps` optimisation steps with each number of `starts`, on random weights.

    `computing` is how the batch is computed; the loop is as published in any case.
    """
    device = section.device
    networks, pair = computing.networks(device), random_pair(device)
    batch_prior, loop_prior = computing.prior(networks), plain_prior(networks)
    if device.type == "cuda":
        batch_prior.encode(pair.images)  # the first time prepares it
    encoding, codes = timed(lambda: batch_prior.encode(pair.images), device)
    ready = encoded(batch_prior, codes)
    ring = {count: Ring(count).make(pair, seed=0) for count in starts}
    loops = [PlainLoop(loop_prior, pair.images, start) for start in ring[max(starts)][0]]
    arithmetic = arithmetic_of(computing, device)
    if not (computing.compile or computing.cuda_graph):  # which are there to spare launches
        one, two = (launched(batched(ready, pair, ring[min(starts)], number)) for number in (1, 2))
        arithmetic[BATCHED] = arithmetic[BATCHED]._replace(launches=two - one)
    # A step of some size is prepared when it is first taken; recorded, it takes its memory then.
    peaks = {count: held_bytes(batched(ready, pair, poses, 1), batch_prior, device) for count, poses in ring.items()}
    loop_peak = held_bytes(loops[0].step, loop_prior, device)
    for count, peak in peaks.items() if device.type == "cuda" else ():
        section.add(f"{told(count)}, peak memory, GB", peak / 1e9, loop_peak / 1e9)
    section.note = (
        f"Zero123's {computing.architecture} size, random weights. {BATCHED}: all starts and both directions "
        f"together, images encoded once ({encoding:.3g} s, not counted); {LOOP}: a start at a time, images anew each "
        "step; " + "; ".join(f"{name}: a start's step is {_in_words(each)}" for name, each in arithmetic.items())
    )
    section.facts = {
        "encoding_seconds": encoding,
        "arithmetic_per_start": {name: each._asdict() for name, each in arithmetic.items()},
    }
    works = {
        f"{told(count)}, seconds a step": (
            batched(ready, pair, poses, steps),
            worth(steps, partial(looped, loops[:count], steps)),
        )
        for count, poses in ring.items()
    }
    section.race(works, rounds, warm_up=False)
    for count, label in zip(starts, works, strict=True):
        both = zip(arithmetic.values(), section.medians()[label], strict=True)
        section.add(f"{told(count)}, share of peak", *(count * a.operations / seconds / a.peak for a, seconds in both))


def measure_pair(
    section: Section, computing: Computing, model: PoseModel, paper_seconds: Mapping[int, float],
    starts: Sequence[int], steps: int, rounds: int,
) -> None:  # fmt: skip
    """`two_stage` with `steps` steps of its second stage against the second stage alone by `PlainLoop`.

    The first computes as `computing` says and encodes the images of each pair. The first pair of a number of starts, in
    which kernels are chosen, compiled or recorded, is told apart. `paper_seconds` are the paper's by number of starts.
    """
    networks, pair = computing.networks(section.device), random_pair(section.device)
    batch_prior, loop_prior = computing.prior(networks), plain_prior(networks)
    solver = TwoStage(model, batch_prior, refinement_steps=steps)
    ring = {count: Ring(count).make(pair, seed=0) for count in starts}

    def plain(count: int) -> None:
        looped([PlainLoop(loop_prior, pair.images, start) for start in ring[count][0]], steps)

    ours = {count: worth(1, partial(solver.solve, pair, poses, 0)) for count, poses in ring.items()}
    first = {count: timed(work, section.device)[0] for count, work in ours.items()}
    PlainLoop(loop_prior, pair.images, ring[starts[0]][0, 0]).step()
    section.facts["first_pair_seconds"] = first
    section.note = (
        f"Zero123's {computing.architecture} size, random weights. {BATCHED}: two_stage with {steps} steps of its "
        f"second stage; {LOOP}: as many of each start, images anew each step. "
        f"The first pair took {', '.join(f'{seconds:.3g} s from {count}' for count, seconds in first.items())}. "
        "The paper's pairs, of 50 steps at the published size on an RTX 6000 Ada, take "
        f"{', '.join(f'{seconds} s from {count}' for count, seconds in paper_seconds.items())}"
    )
    works = {f"{told(count)}, seconds a pair": (work, worth(1, partial(plain, count))) for count, work in ours.items()}
    section.race(works, rounds, warm_up=False)


def _in_words(work: Arithmetic) -> str:
    launches = f" in {work.launches:,} launches" if work.launches else ""
    return f"{work.operations / 1e9:.3g} GFLOP{launches}, the device's peak {work.peak / 1e12:.3g} TFLOP/s"


def told(starts: int) -> str:
    """The number of starts in words."""
    return f"{starts} start{'s' if starts > 1 else ''}"


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
