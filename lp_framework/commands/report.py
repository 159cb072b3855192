"""`report`: finished runs on one page; evaluations also as tables and figures beside the paper's numbers."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, ListConfig
from rich.console import Console
from rich.text import Text

from lp_framework import registry
from lp_framework.commands.building import plain, run_folder, versions
from lp_framework.errors import UserError
from lp_framework.report.page import PAGE, write_report_page
from lp_framework.report.runs import find_runs, run_folders
from lp_framework.report.sweep_figures import draw_sweep
from lp_framework.report.sweep_tables import Objects, metrics_note, sweep_sections, sweep_tables, terminal, write_sweeps


def run(config: DictConfig) -> None:
    """Gather the runs and write `report.html` and, for evaluations, `report.md`, `.csv`, `.json` and figures."""
    objects: Objects = registry.checked(sweep_tables, {"objects": config.objects}, "")["objects"]
    folders = [Path(str(each)) for each in (config.runs if isinstance(config.runs, ListConfig) else [config.runs])]
    found, left_out = find_runs(folders)
    finished = {each.folder for each in found}
    runs = [(path, kind) for path, kind in run_folders(folders) if kind != "eval" or path in finished]
    tables, unlabelled = sweep_tables(found, objects)
    left_out += unlabelled
    if not tables and all(kind == "eval" for _, kind in runs):
        reason = f" ({left_out[0].folder}: {left_out[0].reason})" if left_out else ""
        raise UserError(f"runs={', '.join(map(str, folders))}: contains no finished run to report{reason}")
    folder = run_folder()
    console = Console(width=10_000 if not Console().is_terminal else None, highlight=False)
    console.print(f"{len(runs)} runs" + (f"; {metrics_note(objects)}" if tables else ""))
    sweeps = [draw_sweep(table, folder) for table in tables]
    for sweep in sweeps:
        console.print()
        console.print(Text(sweep.title, style="bold"), soft_wrap=True)
        for table in terminal(sweep.layout, console.width):
            console.print(table)
        for note in sweep.table.paper.notes if sweep.table.paper is not None else []:
            console.print(f"paper: {note}", style="dim", soft_wrap=True)
    console.print()
    for path, reason in left_out:
        console.print(f"skipped: {path}: {reason}", style="yellow", soft_wrap=True)
    page = write_report_page(folder / PAGE, runs, sweep_sections(sweeps, left_out))
    if sweeps:
        write_sweeps(folder, sweeps, left_out, objects, {"config": plain(config), "versions": versions()})
        console.print(f"report:  {folder / 'report.md'} (report.csv, report.json)", soft_wrap=True)
    for file in [file for sweep in sweeps for file in sweep.pictures]:
        console.print(f"figure:  {file}", soft_wrap=True)
    console.print(f"page:    {page}", soft_wrap=True)
