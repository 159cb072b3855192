"""`eval`: a solver on a data set's test views, as a table in the paper's layout, JSON and CSV."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lightning.pytorch.callbacks import RichProgressBar
from omegaconf import DictConfig
from rich.console import Console

from lp_framework import registry
from lp_framework.commands.building import (
    build_data,
    build_trainer,
    orderly_console,
    plain,
    run_folder,
    seed_run,
    versions,
)
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.evaluation.tables import summary_rows, terminal_table, write_result
from lp_framework.models.checkpoints import find_checkpoint, load_model, newest_checkpoint
from lp_framework.viz.pictures import save_pictures


@orderly_console()
def run(config: DictConfig) -> None:
    """Evaluate and write `results.json`, `results.csv`, `pairs.csv` and pictures into this run's folder."""
    folder = run_folder()
    seed_run(config.seed)
    components: dict[str, Any] = {}
    checkpoint: Path | None = None
    if "model" in registry.component_names(registry.get("solver", config.solver.name)):
        checkpoint = newest_checkpoint() if config.checkpoint is None else find_checkpoint(config.checkpoint)
        components["model"] = load_model(checkpoint)
    solver = registry.build("solver", config.solver, **components)
    starts = registry.build("start", config.start)
    data = build_data(config)
    trainer = build_trainer(config, folder, [RichProgressBar(leave=False)], logger=[])
    data.evaluate_on(config.protocol, config.seed)
    evaluation = Evaluation(solver, starts, config.seed)
    trainer.test(evaluation, datamodule=data, verbose=False)
    result = {
        **evaluation.result(),
        "protocol": config.protocol,
        "seed": config.seed,
        "checkpoint": str(checkpoint) if checkpoint else None,
        "config": plain(config),
        "versions": versions(),
    }
    if not trainer.is_global_zero:
        return
    write_result(folder, result, evaluation.metrics, evaluation.table)
    pictures = save_pictures(folder / "pictures", evaluation, data.data(data.evaluation_split()))
    console = Console(width=110 if not Console().is_terminal else None, highlight=False)
    choices = f"{config.data.name}, {config.solver.name}, start={config.start.name}"
    title = f"{choices}, {result['pairs']} pairs ({config.protocol})"
    console.print(terminal_table(title, summary_rows(result)))
    console.print(f"seconds per pair {result['seconds_per_pair']:.4f}")
    console.print(f"results:  {folder / 'results.json'}", soft_wrap=True)
    names = ", ".join(picture.name for picture in pictures)
    console.print(f"pictures: {folder / 'pictures'} ({names})", soft_wrap=True)
