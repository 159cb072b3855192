"""Recall against the number of random starts (Evaluation under Various Numbers of Initializations)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from matplotlib.figure import Figure

from lp_framework.errors import UserError
from lp_framework.figures.base import PaperFigure
from lp_framework.registry import register
from lp_framework.report.runs import find_runs
from lp_framework.report.sweep_figures import is_swept, sweep_figure
from lp_framework.report.sweep_tables import Objects, SweepTable, sweep_tables

EXPERIMENT, COUNT = "starts", "start.count"


@register("figure", "recall")
@dataclass
class RecallFigure(PaperFigure):
    """Recall within 30 degrees against the number of random starts and against time, a curve a solver.

    `runs` is a folder with finished jobs of `eval experiment=starts`; `objects` says whether all objects count, or
    only those with a unique answer.
    """

    runs: str = "runs/multirun/eval/starts"
    objects: Objects = "unique_answer"

    def analyse(self, seed: int, device: torch.device) -> SweepTable:
        """The table of the experiment; nothing is drawn at random."""
        make = f"`python -m lp_framework eval experiment={EXPERIMENT}` makes them"
        if not Path(self.runs).is_dir():
            raise UserError(f"figure.runs={self.runs}: there is no such folder of finished runs; {make}")
        found, _ = find_runs([Path(self.runs)])
        tables, unlabelled = sweep_tables(found, self.objects)
        table = next((each for each in tables if each.experiment == EXPERIMENT and is_swept(each, COUNT)), None)
        if table is None:
            reason = unlabelled[0].reason if unlabelled else f"no finished runs with several numbers of starts; {make}"
            raise UserError(f"figure.runs={self.runs}: {reason}")
        return table

    def draw(self, contents: SweepTable) -> tuple[Figure, str]:
        """See `PaperFigure`."""
        figure = sweep_figure(contents)
        assert figure is not None  # the number of starts varies
        seeds = max(len(row.seeds) for row in contents.rows)
        over = "objects with a unique answer" if self.objects == "unique_answer" else "all objects"
        return figure, (
            "Recall within 30 degrees (and a translation error of 0.2) for different numbers of random starts, and for "
            f"the seconds that they take, over {over}; bars: standard deviation over {seeds} seeds."
        )
