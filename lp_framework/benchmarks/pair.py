"""Seconds of a whole pair on Zero123, both stages from all starts, against a plain loop over the starts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import torch

from lp_framework.benchmarks.harness import Contest, Section, timed, worth
from lp_framework.benchmarks.second_stage import (
    BATCHED,
    LOOP,
    Computing,
    PlainLoop,
    looped,
    plain_prior,
    random_pair,
    told,
)
from lp_framework.models.pose_model import PoseModel
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.two_stage import TwoStage

PAPER_STEPS = 50  # of the paper's second stage


def measure(
    computing: Computing,
    model: PoseModel,
    paper_seconds: Mapping[int, float],
    starts: Sequence[int],
    steps: int,
    rounds: int,
    device: torch.device,
) -> Iterator[Section]:
    """`two_stage` with `steps` steps of its second stage against the second stage alone by `PlainLoop`.

    The first computes as `computing` says and encodes the images of each pair. The first pair of a number of starts, in
    which kernels are chosen, compiled or recorded, is told apart. `paper_seconds` are the paper's by number of starts.
    """
    networks, pair = computing.networks(device), random_pair(device)
    batch_prior, loop_prior = computing.prior(networks), plain_prior(networks)
    solver = TwoStage(model.to(device), batch_prior, refinement_steps=steps)
    ring = {count: Ring(count).make(pair, seed=0) for count in starts}

    def plain(count: int) -> None:
        looped([PlainLoop(loop_prior, pair.images, start) for start in ring[count][0]], steps)()

    ours = {count: worth(1, partial(solver.solve, pair, poses, 0)) for count, poses in ring.items()}
    first = {count: timed(work, device)[0] for count, work in ours.items()}
    PlainLoop(loop_prior, pair.images, ring[starts[0]][0, 0]).step()
    section = Section("pair: both stages and encoding", (BATCHED, LOOP), facts={"first_pair_seconds": first})
    section.note = (
        f"Zero123's {computing.architecture} size, random weights. {BATCHED}: two_stage with {steps} steps of its "
        f"second stage{computing.halved(batch_prior)}; {LOOP}: as many of each start, images anew each step. "
        f"The first pair took {', '.join(f'{seconds:.3g} s from {count}' for count, seconds in first.items())}. "
    )
    contests = [
        Contest(f"{told(count)}, seconds a pair", work, worth(1, partial(plain, count))) for count, work in ours.items()
    ]
    yield from section.race(contests, rounds, device, warm_up=False)
    if computing.architecture == "published" and steps == PAPER_STEPS:
        medians = [row.medians[0] for row in section.rows]
        section.note += beside(dict(zip(starts, medians, strict=True)), paper_seconds)
    yield section


def beside(seconds: Mapping[int, float], paper: Mapping[int, float]) -> str:
    """The paper's seconds by the number of starts, for those numbers that have been measured and that it has."""
    found = [
        f"{paper[count]} s from {count} (here {seconds[count] / paper[count]:.2g} of that)"
        for count in seconds
        if count in paper
    ]
    return f"The paper's on an RTX 6000 Ada: {', '.join(found)}" if found else ""
