"""Zero123's part of a pair: batched against a loop, and in reduced precision against plain float32."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import torch
from torch import Tensor

from lp_framework.benchmarks.harness import Section, peak_bytes, timed, worth
from lp_framework.benchmarks.zero123 import (
    TIMESTEP,
    Architecture,
    Computing,
    PlainLoop,
    batched,
    encoded,
    looped,
    plain_prior,
    random_pair,
)
from lp_framework.errors import UserError
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.priors.zero123.networks import DTYPES
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.two_stage import TwoStage

BATCHED, LOOP = "batched", "plain loop"
STEP = "second stage: a step of one pair", (BATCHED, LOOP)
PAIR = "pair: both stages and encoding", (BATCHED, LOOP)
PRECISION = "precision: a step of one pair", ("as named", "plain float32")
SWITCHES = ("channels_last", "compile", "cuda_graph")


def measure_step(section: Section, computing: Computing, starts: Sequence[int], rounds: int, steps: int) -> None:
    """Optimisation steps on random weights; `computing` is how the batch is computed, the loop is as published."""
    device = section.device
    networks, pair = computing.networks(device), random_pair(device)
    batch_prior, loop_prior = computing.prior(networks), plain_prior(networks)
    if device.type == "cuda":
        batch_prior.encode(pair.images)  # the first time prepares it
    encoding, codes = timed(lambda: batch_prior.encode(pair.images), device)
    ready = encoded(batch_prior, codes)
    ring = {count: Ring(count).make(pair, seed=0) for count in starts}
    loops = [PlainLoop(loop_prior, pair.images, start) for start in ring[max(starts)][0]]
    # A step of some size is prepared when it is first taken; recorded, it takes its memory then.
    peaks = {count: peak_bytes(batched(ready, pair, poses, 1), batch_prior, device) for count, poses in ring.items()}
    loop_peak = peak_bytes(loops[0].step, loop_prior, device)
    for count, peak in peaks.items() if device.type == "cuda" else ():
        section.add(f"{told(count)}, peak memory, GB", peak / 1e9, loop_peak / 1e9)
    section.note = (
        f"Zero123's {computing.architecture} size, random weights. {BATCHED}: all starts and both directions "
        f"together, images encoded once ({encoding:.3g} s, not counted); {LOOP}: a start at a time, images anew each "
        "step"
    )
    section.facts = {"encoding_seconds": encoding}
    works = {
        f"{told(count)}, seconds a step": (
            batched(ready, pair, poses, steps),
            worth(steps, partial(looped, loops[:count], steps)),
        )
        for count, poses in ring.items()
    }
    section.race(works, rounds, warm_up=False)


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


def told(starts: int) -> str:
    """The number of starts in words."""
    return f"{starts} start{'s' if starts > 1 else ''}"


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


def measure_precision(
    section: Section, architecture: Architecture, variants: Sequence[str], starts: int, rounds: int, steps: int,
    max_batch: int | None,
) -> None:  # fmt: skip
    """Steps of a pair on the same random weights, a variant after the other, so that two U-Nets are held at most."""
    device, plain = section.device, Computing(architecture, max_batch=max_batch)
    computings = {words: variant(words, architecture, max_batch) for words in variants}
    networks, pair = plain.networks(device), random_pair(device)
    poses = Ring(starts).make(pair, seed=0)
    prior = plain.prior(networks)
    codes = prior.encode(pair.images)
    ready = encoded(prior, codes)
    memory = peak_bytes(partial(gradient, ready, pair, poses), prior.unet, device)
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):  # in which a GPU convolves float32 otherwise
        exact = gradient(ready, pair, poses)
    section.note = f"Zero123's {architecture} size, random weights, {starts} starts"
    for words, computing in computings.items():
        other = computing.prior(networks)
        theirs = encoded(other, codes)
        # The first step: once recorded it takes no more memory.
        its_memory = peak_bytes(partial(gradient, theirs, pair, poses), other.unet, device)
        off = ((gradient(theirs, pair, poses) - exact).abs().max() / exact.abs().max()).item()
        section.note += f"; {words}: gradient off by {off:.1g}"
        section.facts[words] = {"gradient_deviation": off}
        label = f"{words}: seconds a step"
        section.race({label: (batched(theirs, pair, poses, steps), batched(ready, pair, poses, steps))}, rounds)
        if device.type == "cuda":
            section.add(f"{words}: peak memory, GB", its_memory / 1e9, memory / 1e9)
        del other, theirs


def gradient(prior: Prior, pair: Pairs, poses: Tensor) -> Tensor:
    """Of the energies in the poses `[1, N, 3]`."""
    energy, poses = PairEnergy(prior, pair, seed=0), poses.detach().clone().requires_grad_()
    return torch.autograd.grad(energy(poses, TIMESTEP, energy.noise(0)[:, 0]).sum(), poses)[0]
