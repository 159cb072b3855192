"""`eval`: a solver on a data set's test views, as a table in the paper's layout, JSON and CSV."""

from __future__ import annotations

from lightning.pytorch.callbacks import RichProgressBar
from omegaconf import DictConfig
from rich.console import Console

from lp_framework import registry
from lp_framework.commands.building import (
    build_data,
    build_solver,
    build_trainer,
    orderly_console,
    plain,
    run_folder,
    seed_run,
    versions,
)
from lp_framework.commands.finished import is_finished
from lp_framework.errors import UserError
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.evaluation.tables import summary_rows, terminal_table, write_result
from lp_framework.evaluation.view_sets import ViewSetEvaluation
from lp_framework.viz.pictures import save_pictures, save_summaries


@orderly_console()
def run(config: DictConfig) -> None:
    """Evaluate and write `results.json`, `results.csv`, `pairs.csv` and pictures into this run's folder."""
    folder = run_folder()
    if is_finished(folder, config):
        return
    seed_run(config.seed)
    solver, checkpoint = build_solver(config)
    starts = registry.build("start", config.start)
    data = build_data(config)
    trainer = build_trainer(config, folder, [RichProgressBar(leave=False)], logger=[])
    protocol, saved = config.protocol, save_pictures
    if config.views is None:
        data.evaluate_on(protocol, config.seed)
        evaluation = Evaluation(solver, starts, config.seed)
    else:
        if protocol != "ordered":
            raise UserError(f"protocol={protocol} is one of pairs; views={config.views} has its own, leave it out")
        protocol, saved = "view_sets", save_summaries
        data.evaluate_on_sets(config.views)
        evaluation = ViewSetEvaluation(solver, starts, config.seed, config.views)
    trainer.test(evaluation, datamodule=data, verbose=False)
    result = {
        **evaluation.result(),
        "protocol": protocol,
        "seed": config.seed,
        "checkpoint": str(checkpoint) if checkpoint else None,
        "config": plain(config),
        "versions": versions(),
    }
    if not trainer.is_global_zero:
        return
    write_result(folder, result, evaluation.metrics, evaluation.table)
    pictures = saved(folder / "pictures", evaluation, data.data(data.evaluation_split()))
    console = Console(width=110 if not Console().is_terminal else None, highlight=False)
    choices = f"{config.data.name}, {config.solver.name}, start={config.start.name}"
    counted = f"pairs ({protocol})" if config.views is None else f"poses in sets of {config.views} images"
    title = f"{choices}, {result['pairs']} {counted}"
    console.print(terminal_table(title, summary_rows(result)))
    console.print(f"seconds per pair {result['seconds_per_pair']:.4f}")
    if result["unanswered"]:
        console.print(f"no answer for {result['unanswered']:.1%} of the pairs")
    console.print(f"results:  {folder / 'results.json'}", soft_wrap=True)
    names = ", ".join(picture.name for picture in pictures)
    console.print(f"pictures: {folder / 'pictures'} ({names})", soft_wrap=True)
