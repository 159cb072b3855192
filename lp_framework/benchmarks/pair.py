"""Seconds of a whole pair on Zero123, both stages from all starts, against a plain loop over the starts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from lp_framework.benchmarks.contest import Match, Work, compete, timed
from lp_framework.benchmarks.second_stage import (
    BATCHED,
    LOOP,
    PlainLoop,
    SecondStage,
    check_counts,
    halved,
    random_pair,
)
from lp_framework.benchmarks.section import Section
from lp_framework.models.pose_model import PoseModel
from lp_framework.report.paper import paper_table
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.two_stage import TwoStage

PAPER_STEPS = 50  # of the paper's second stage


def measure(stage: SecondStage, model: PoseModel, starts: Sequence[int], steps: int, rounds: int) -> Iterator[Section]:
    """The section after every pair.

    The first contender is `two_stage` with `steps` steps of its second stage, images encoded for each pair, computing
    as `stage` says; the second the second stage alone, by `PlainLoop`. The first pair of a number of starts, in which
    kernels are chosen, compiled or recorded, is told apart.
    """
    check_counts("pair.starts", starts)
    batch_prior, loop_prior = stage.priors()
    solver = TwoStage(model.to(stage.device), batch_prior, refinement_steps=steps)
    pair = random_pair(stage.device)
    ring = {count: Ring(count).make(pair, seed=0).to(stage.device) for count in starts}

    def ours(count: int) -> Work:
        def work() -> float:
            solver.solve(pair, ring[count], seed=0)
            return 1

        return work

    def plain(count: int) -> Work:
        def work() -> float:
            for start in ring[count][0]:
                loop = PlainLoop(loop_prior, pair.images, start)
                for _ in range(steps):
                    loop.step()
            return 1

        return work

    first = {str(count): timed(ours(count), stage.device)[0] for count in starts}
    PlainLoop(loop_prior, pair.images, ring[starts[0]][0, 0]).step()
    matches = [
        Match(str(count), f"{count} start{'s' if count > 1 else ''}, seconds a pair", ours(count), plain(count), False)
        for count in starts
    ]
    note = (
        f"Zero123's {stage.architecture} size, random weights. {BATCHED}: two_stage with {steps} steps of its second "
        f"stage; {LOOP}: as many of each start, images anew each step. "
        f"The first pair took {', '.join(f'{seconds:.3g} s from {count}' for count, seconds in first.items())}. "
    )
    title = "pair: both stages and encoding"
    for section in compete(title, (BATCHED, LOOP), matches, rounds, stage.device, note, warm_up=False):
        few = halved(batch_prior, stage.max_batch)
        papers = beside(section) if stage.architecture == "published" and steps == PAPER_STEPS else ""
        yield replace(section, record={**section.record, "first_pair_seconds": first}, note=note + papers + few)


def beside(section: Section) -> str:
    """The paper's seconds, from those numbers of starts that have been measured and that it has."""
    paper = paper_seconds()
    told = [
        f"{paper[key]} s from {key} (here {entry[BATCHED]['median'] / paper[key]:.2g} of that)"
        for key, entry in section.record.items()
        if key in paper
    ]
    return f"The paper's on an RTX 6000 Ada: {', '.join(told)}" if told else ""


def paper_seconds() -> dict[str, float]:
    """The paper's seconds a pair by the number of starts (appendix, Analysis of Inference Time)."""
    table = paper_table("starts")
    assert table is not None  # it is in this package
    rows = [row for row in table.rows if row.settings["solver.name"] == "two_stage"]
    return {str(row.settings["start.count"]): row.metrics["seconds_per_pair"] for row in rows}
