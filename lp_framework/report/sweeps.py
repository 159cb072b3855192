"""Sweeps of evaluations in a report: their figures, their parts of the page, and their tables as files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lp_framework.evaluation.tables import write_csv, write_json, write_text
from lp_framework.report.parts import Section, render
from lp_framework.report.printed_tables import Layout, csv_rows, heading, layout, shown
from lp_framework.report.runs import LeftOut
from lp_framework.report.sweep_figures import cost_figure, sweep_figure
from lp_framework.report.sweep_tables import Objects, SweepTable
from lp_framework.viz.style import save_figure

PLACE = ("data.name", "protocol", "checkpoint", "prior.name", "solver.name", "start.name", "views")  # of all runs


@dataclass(frozen=True)
class Sweep:
    """A table of runs with its title, as it is printed, and with the files of its figures."""

    title: str
    table: SweepTable
    layout: Layout
    files: Sequence[Path]

    @property
    def pictures(self) -> list[Path]:
        """Those of its files that a page can show."""
        return [file for file in self.files if file.suffix == ".png"]


def draw_sweep(table: SweepTable, folder: Path) -> Sweep:
    """A table with the figures that it calls for, which are saved in `folder`."""
    name = table.experiment or "runs"
    shared = [f"{heading(key)} {shown(table.common[key])}" for key in PLACE if table.common.get(key) is not None]
    figures = {name: sweep_figure(table), f"{name}_seconds": cost_figure(table)}
    files = [file for stem, each in figures.items() if each is not None for file in save_figure(each, folder / stem)]
    return Sweep(", ".join([name, *shared]), table, layout(table), files)


def counted(objects: Objects) -> str:
    """In words, what the numbers are over."""
    over = "objects with a unique answer" if objects == "unique_answer" else "all objects"
    return f"metrics over {over}; mean and standard deviation over seeds"


def sweep_sections(sweeps: Sequence[Sweep], left_out: Sequence[LeftOut]) -> list[Section]:
    """The sweeps on a page, and the runs that their tables leave out."""
    sections = [Section(sweep.title, render("sweep.html.j2", sweep=sweep)) for sweep in sweeps]
    return [*sections, Section("Left out", render("left_out.html.j2", left_out=left_out))] if left_out else sections


def write_sweeps(
    folder: Path, sweeps: Sequence[Sweep], left_out: Sequence[LeftOut], objects: Objects, about: Mapping[str, Any]
) -> None:
    """`report.md`, `report.csv` (a row a combination) and `report.json` in `folder`; the last with what `about` has."""
    write_csv(folder / "report.csv", *csv_rows([sweep.table for sweep in sweeps]))
    text = render("report.md.j2", sweeps=sweeps, left_out=left_out, counted=counted(objects))
    write_text(folder / "report.md", text)
    write_json(
        folder / "report.json",
        {
            "objects": objects,
            "tables": [_as_json(sweep) for sweep in sweeps],
            "left_out": [{"folder": str(path), "reason": reason} for path, reason in left_out],
            **about,
        },
    )


def _as_json(sweep: Sweep) -> dict[str, Any]:
    metrics = [{name: value._asdict() for name, value in row.metrics.items()} for row in sweep.table.rows]
    rows = [{**asdict(row), "metrics": each} for row, each in zip(sweep.table.rows, metrics, strict=True)]
    return {**asdict(sweep.table), "rows": rows, "figures": [file.name for file in sweep.files]}
