"""`report`: finished runs as one page; evaluations as tables and figures, too, beside the paper's numbers."""

from __future__ import annotations

import typing
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig, ListConfig
from rich.console import Console
from rich.text import Text

from lp_framework.commands.building import plain, run_folder, versions
from lp_framework.errors import UserError, nearest
from lp_framework.evaluation.tables import write_csv, write_json, write_text
from lp_framework.report.printed_tables import as_json, csv_rows, heading, markdown, shown, terminal
from lp_framework.report.runs import LeftOut, find_runs, run_folders
from lp_framework.report.sweep_figures import cost_figure, sweep_figure
from lp_framework.report.sweep_tables import Objects, SweepTable, sweep_tables
from lp_framework.viz.html.run_page import PAGE, write_report_page
from lp_framework.viz.html.sweep_part import left_out_part, sweep_part
from lp_framework.viz.style import save_figure

PLACE = ("data.name", "protocol", "checkpoint", "prior.name", "solver.name", "start.name", "views")  # of all runs


def run(config: DictConfig) -> None:
    """Gather the runs and write `report.html` and, of evaluations, `report.md`, `.csv`, `.json` and figures."""
    if config.objects not in typing.get_args(Objects):
        known = typing.get_args(Objects)
        raise UserError(
            f"objects={config.objects} is none of its values{nearest(str(config.objects), known)} "
            f"(known: {', '.join(known)})"
        )
    where = list(config.runs) if isinstance(config.runs, ListConfig) else [config.runs]
    folders = [Path(str(each)) for each in where]
    found, left_out = find_runs(folders)
    finished = {run.folder.resolve() for run in found}
    runs = [run for run in run_folders(folders) if run[1] != "eval" or run[0].resolve() in finished]
    others = {folder.resolve() for folder, kind in runs if kind != "eval"}
    left_out = [each for each in left_out if each.folder.resolve() not in others]
    tables, unlabelled = sweep_tables(found, config.objects)
    left_out += unlabelled
    if not tables and not others:
        reason = f": {left_out[0].folder} is {left_out[0].reason}" if left_out else ", nor an unfinished one"
        raise UserError(f"runs={', '.join(map(str, where))}: holds no finished run to report{reason}")
    folder = run_folder()
    console = Console(width=10_000 if not Console().is_terminal else None, highlight=False)
    console.print(f"{len(runs)} runs" + (f"; {counted(config.objects)}" if tables else ""))
    figures: list[list[Path]] = []
    for table in tables:
        figures.append(drawn(table, folder))
        console.print()
        console.print(Text(title(table), style="bold"), soft_wrap=True)
        console.print(terminal(table))
        for note in table.paper.notes if table.paper is not None else []:
            console.print(f"paper: {note}", style="dim", soft_wrap=True)
    console.print()
    for path, reason in left_out:
        console.print(f"left out: {path}: {reason}", style="yellow", soft_wrap=True)
    sections = [sweep_part(table, title(table), pngs(files)) for table, files in zip(tables, figures, strict=True)]
    page = write_report_page(folder / PAGE, runs, [*sections, *([left_out_part(left_out)] if left_out else [])])
    if tables:
        write_tables(folder, config, tables, figures, left_out)
        console.print(f"report:  {folder / 'report.md'} (report.csv, report.json)", soft_wrap=True)
    for files in figures:
        for file in pngs(files):
            console.print(f"figure:  {file}", soft_wrap=True)
    console.print(f"page:    {page}", soft_wrap=True)


def write_tables(
    folder: Path,
    config: DictConfig,
    tables: Sequence[SweepTable],
    figures: Sequence[Sequence[Path]],
    left_out: Sequence[LeftOut],
) -> None:
    """`report.md`, `report.csv` and `report.json` of evaluations."""
    write_csv(folder / "report.csv", *csv_rows(tables))
    write_text(folder / "report.md", "\n".join(document(tables, figures, left_out, config.objects)) + "\n")
    write_json(
        folder / "report.json",
        {
            "objects": config.objects,
            "tables": [
                {**as_json(table), "figures": [file.name for file in files]}
                for table, files in zip(tables, figures, strict=True)
            ],
            "left_out": [{"folder": str(path), "reason": reason} for path, reason in left_out],
            "config": plain(config),
            "versions": versions(),
        },
    )


def drawn(table: SweepTable, folder: Path) -> list[Path]:
    """Save the figures that a table calls for; their files."""
    name = table.experiment or "runs"
    figures = {name: sweep_figure(table), f"{name}_seconds": cost_figure(table)}
    return [file for stem, each in figures.items() if each is not None for file in save_figure(each, folder / stem)]


def pngs(files: Sequence[Path]) -> list[Path]:
    """Those to be shown, of the files of figures."""
    return [file for file in files if file.suffix == ".png"]


def title(table: SweepTable) -> str:
    """The experiment and what all of its runs share."""
    shared = [f"{heading(key)} {shown(table.common[key])}" for key in PLACE if table.common.get(key) is not None]
    return ", ".join([table.experiment or "runs", *shared])


def counted(objects: Objects) -> str:
    """In words, what the numbers are over."""
    over = "objects with a unique answer" if objects == "unique_answer" else "all objects"
    return f"metrics over {over}; mean and standard deviation over seeds"


def document(
    tables: Sequence[SweepTable], figures: Sequence[Sequence[Path]], left_out: Sequence[LeftOut], objects: Objects
) -> list[str]:
    """The lines of `report.md`."""
    lines = ["# Report", "", f"{counted(objects)[0].upper()}{counted(objects)[1:]}."]
    for table, files in zip(tables, figures, strict=True):
        lines += ["", f"## {title(table)}", "", *markdown(table)]
        for file in pngs(files):
            lines += ["", f"![{file.stem}]({file.name})"]
        if table.paper is not None:
            lines += ["", f"In italics the paper's own numbers ({table.paper.source}): *{table.paper.caption}*", ""]
            lines += [f"- {note}" for note in table.paper.notes]
    if left_out:
        lines += ["", "## Left out", "", *(f"- `{path}`: {reason}" for path, reason in left_out)]
    return lines
