"""Finished runs as tables: what varies between them, and mean and spread over their seeds."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from lp_framework.report.paper import PaperRow, PaperTable, paper_table
from lp_framework.report.runs import LeftOut, Run, checkpoint_names

Objects = Literal["unique_answer", "all"]


class Spread(NamedTuple):
    """Mean over seeds and sample standard deviation (n - 1), NaN for a single seed or where it is not finite."""

    mean: float
    std: float


@dataclass(frozen=True)
class Row:
    """The runs that differ in nothing but their seeds: what was set, of the table's columns, and the metrics.

    Or a row of the paper, with its `source`, and no runs.
    """

    settings: Mapping[str, Any]
    metrics: Mapping[str, Spread]
    seeds: Sequence[int] = ()
    runs: Sequence[str] = ()  # their folders
    pairs: int | None = None
    source: str = "runs"

    @property
    def paper(self) -> bool:
        """Whether it is the paper's."""
        return not self.runs


@dataclass(frozen=True)
class SweepTable:
    """The runs of one experiment (or those without one): a row for every combination of settings.

    `columns` are the settings that vary and those that the paper's table varies; `common` holds those that all runs
    share, and `paper` the paper's own table of this experiment, if it has one.
    """

    experiment: str | None
    columns: Sequence[str]
    rows: Sequence[Row]
    common: Mapping[str, Any]
    paper: PaperTable | None

    def apart_from(self, axis: str) -> list[list[Row]]:
        """The rows in groups, in each of which they differ in nothing but the setting `axis`."""
        others = [key for key in self.columns if key != axis]
        groups: dict[str, list[Row]] = {}
        for row in self.rows:
            groups.setdefault(json.dumps([row.settings.get(key) for key in others]), []).append(row)
        return list(groups.values())

    def papers(self, settings: Mapping[str, Any]) -> list[Row]:
        """The paper's rows to compare a run of these settings with."""
        return [] if self.paper is None else [_printed(each) for each in self.paper.matching(settings)]

    def with_paper(self) -> list[Row]:
        """The rows, each followed by the paper's to compare it with; the rest of the paper's are last."""
        rows = [each for row in self.rows for each in (row, *self.papers(row.settings))]
        return rows + [each for each in self.all_papers() if each not in rows]

    def all_papers(self) -> list[Row]:
        """The paper's rows."""
        return [] if self.paper is None else [_printed(each) for each in self.paper.rows]


def _printed(row: PaperRow) -> Row:
    metrics = {name: Spread(value, math.nan) for name, value in row.metrics.items()}
    return Row(row.settings, metrics, source=f"paper: {row.label}")


def sweep_tables(runs: Sequence[Run], objects: Objects) -> tuple[list[SweepTable], list[LeftOut]]:
    """A table an experiment, by name, those without one last; and the runs that have nothing to say of `objects`."""
    reason = "no object is labelled as having a unique answer; objects=all counts every object"
    left_out = [LeftOut(run.folder, reason) for run in runs if run.metrics[objects] is None]
    runs = [run for run in runs if run.metrics[objects] is not None]
    names = sorted({run.experiment for run in runs}, key=lambda name: (name is None, name or ""))
    return [_table([run for run in runs if run.experiment == name], name, objects) for name in names], left_out


def spread(values: Sequence[float]) -> Spread:
    """Mean and sample standard deviation.

    >>> spread([1.0, 2.0, 3.0])
    Spread(mean=2.0, std=1.0)
    """
    mean = math.fsum(values) / len(values)
    return Spread(mean, statistics.stdev(values) if len(values) > 1 and math.isfinite(mean) else math.nan)


def varying(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """The fewest keys that tell the given settings apart, in their order.

    A key that only some have (a solver's own setting) counts only if it varies among those; and a setting that the
    choice of its group says (`solver.steps`, where every `solver.name` has its own) is left out. Either comes back
    where two different settings would look the same without it.

    >>> varying([{"solver.name": "a", "solver.steps": 1}, {"solver.name": "b", "solver.steps": 2, "solver.tries": 1}])
    ['solver.name']
    """

    def told_apart(keys: Sequence[str]) -> int:
        return len({json.dumps({key: each[key] for key in keys if key in each}) for each in settings})

    keys = list(dict.fromkeys(key for each in settings for key in each))
    chosen = [key for key in keys if len(_values(settings, key)) > 1 and not _said_by_choice(settings, key)]
    for key in keys:
        if told_apart([*chosen, key]) > told_apart(chosen):
            chosen.append(key)
    # Names come first, so that a number's values stand together.
    return sorted(chosen, key=lambda key: (not key.endswith(".name"), keys.index(key)))


def in_order(value: Any) -> tuple[int, float, str]:
    """A sort key for settings: nothing, false, true, numbers by size, everything else as text.

    >>> sorted([10, "b", None, 9, "a"], key=in_order)
    [None, 9, 10, 'a', 'b']
    """
    if isinstance(value, bool | int | float):
        return (1, float(value), "")
    return (0, 0.0, "") if value is None else (2, 0.0, str(value))


def heading(key: str) -> str:
    """A setting as a heading, as it is written on the command line.

    >>> heading("solver.name"), heading("solver.gamma")
    ('solver', 'solver.gamma')
    """
    return key.removesuffix(".name")


def shown(value: Any) -> str:
    """A setting's value in a table."""
    if value is None:
        return "-"
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)


def _table(runs: Sequence[Run], experiment: str | None, objects: Objects) -> SweepTable:
    names = checkpoint_names(runs)
    groups: dict[str, list[Run]] = {}
    for run in sorted(runs, key=lambda run: (run.seed, str(run.folder))):
        groups.setdefault(json.dumps(run.settings, sort_keys=True), []).append(run)
    shown = [
        {key: names.get(value, value) if key == "checkpoint" else value for key, value in group[0].settings.items()}
        for group in groups.values()
    ]
    paper = paper_table(experiment)
    columns = varying(shown)
    columns += [key for key in (paper.settings if paper else []) if key not in columns and _values(shown, key)]
    rows = []
    for settings, group in zip(shown, groups.values(), strict=True):
        metrics = [found for run in group if (found := run.metrics[objects]) is not None]
        rows.append(
            Row(
                {key: settings[key] for key in columns if key in settings},
                {name: spread([each[name] for each in metrics]) for name in metrics[0]},
                [run.seed for run in group],
                [str(run.folder) for run in group],
                group[0].pairs,
            )
        )
    rows.sort(key=lambda row: [in_order(row.settings.get(key)) for key in columns])
    common = {key: value for key, value in shown[0].items() if all(each.get(key) == value for each in shown)}
    return SweepTable(experiment, columns, rows, common, paper)


def _values(settings: Sequence[Mapping[str, Any]], key: str) -> set[str]:
    """The values of a key, as text, of those that have it."""
    return {json.dumps(each[key]) for each in settings if key in each}


def _said_by_choice(settings: Sequence[Mapping[str, Any]], key: str) -> bool:
    choice = f"{key.rpartition('.')[0]}.name"
    names = {each.get(choice) for each in settings if key in each}
    if key == choice or len(names) == 1:
        return False
    return all(len(_values([each for each in settings if each.get(choice) == name], key)) == 1 for name in names)
