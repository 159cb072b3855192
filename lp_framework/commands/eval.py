"""`eval`: a solver on a data set's test views, as a table in the paper's layout, JSON and CSV.

A run that was stopped goes on with `resume=RUN_FOLDER`, or where the same command is given the same folder.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from lightning import Trainer
from lightning.pytorch.callbacks import RichProgressBar
from omegaconf import DictConfig
from rich.console import Console

from lp_framework import registry
from lp_framework.commands.building import (
    build_data,
    build_solver,
    build_trainer,
    model_origin,
    orderly_console,
    plain,
    run_folder,
    seed_run,
    versions,
    warn_of_other_objects,
    warn_of_unused,
    weights_fingerprint,
)
from lp_framework.commands.finished import is_finished, unfinished_evaluation
from lp_framework.data.module import EVALUATION_PAIRS, PairDataModule
from lp_framework.data.pairs import PairData
from lp_framework.errors import UserError
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.evaluation.journal import Journal, goes_on, unfinished
from lp_framework.evaluation.tables import summary_rows, terminal_table, write_result
from lp_framework.evaluation.view_sets import ViewSetEvaluation
from lp_framework.solvers.base import Solver
from lp_framework.solvers.starts import Starts
from lp_framework.viz.html.run_page import write_run_page
from lp_framework.viz.pictures import save_pictures, save_summaries

LARGE = 100_000_000  # parameters; a few pairs of Zero123's size fill a GPU, and many would be long unsaved
LARGE_SAMPLES = 72  # of networks that are large, in a pass: 4 pairs from 9 starts, 18 from 2


@orderly_console()
def run(config: DictConfig) -> None:
    """Evaluate and write `results.json`, `results.csv`, `pairs.csv` and pictures into this run's folder.

    With `resume` it is the folder of an evaluation that was stopped.
    """
    folder, known = run_folder(), None
    if config.resume is not None:
        folder = Path(config.resume)
        config, known = unfinished_evaluation(folder, config, HydraConfig.get().overrides.task)
    elif is_finished(folder, config):
        return
    if config.trainer.get("precision", "32-true") != "32-true":
        raise UserError("trainer.precision: poses are computed in float32; prior.dtype=bfloat16 is Zero123's own")
    seed_run(config.seed)
    warn_of_unused(config)
    solver, checkpoint = build_solver(config, known)
    subject = {
        "config": json.loads(json.dumps(plain(config))),
        "checkpoint": str(checkpoint) if checkpoint else None,
        "weights": weights_fingerprint(solver.networks()),
        "versions": versions(),
    }
    before = unfinished(folder) if goes_on(folder, subject) else None
    journal = Journal(folder, subject)
    data = build_data(config)
    trainer = build_trainer(config, folder, [RichProgressBar(leave=False)], logger=[])
    evaluation = build_evaluation(config, solver, data, journal)
    trainer.test(evaluation, datamodule=data, verbose=False)
    if checkpoint is not None and config.checkpoint is None:
        warn_of_other_objects(checkpoint, evaluation.table.names)
    evaluation.to(trainer.strategy.root_device)  # Lightning has put it on the CPU, where GPUs' processes cannot gather
    result = {
        **evaluation.result(),
        "protocol": config.protocol if config.views is None else "view_sets",
        "seed": config.seed,
        "checkpoint": subject["checkpoint"],
        "fingerprints": {"weights": subject["weights"], "views": data.fingerprint(data.evaluation_split())},
        "config": plain(config),
        "versions": subject["versions"],
    }
    if before is not None and before["versions"] != result["versions"]:
        result["versions_before"] = before["versions"]  # of what was solved before it was stopped
    write_all(folder, result, trainer, evaluation, data.data(data.evaluation_split()), journal)


def build_evaluation(config: DictConfig, solver: Solver, data: PairDataModule, journal: Journal) -> Evaluation:
    """The evaluation of a config, on pairs or on sets of views, with the data set to it."""
    starts = registry.build("start", config.start)
    batch_pairs = pairs_at_once(config, solver, starts)
    if config.views is None:
        data.evaluate_on(config.protocol, config.seed, batch_pairs)
        return Evaluation(solver, starts, config.seed, journal)
    if config.protocol != "ordered":
        raise UserError(f"protocol={config.protocol} is one of pairs; views={config.views} has its own, leave it out")
    data.evaluate_on_sets(config.views, batch_pairs)
    return ViewSetEvaluation(solver, starts, config.seed, config.views, journal)


def pairs_at_once(config: DictConfig, solver: Solver, starts: Starts) -> int:
    """Pairs a batch: `batch_pairs`, else by the size of the solver's networks. A batch is saved when it is solved."""
    if config.batch_pairs is None:
        parameters = sum(each.numel() for network in solver.networks() for each in network.parameters())
        if parameters <= LARGE:
            return EVALUATION_PAIRS
        count = starts.make(torch.zeros(1, dtype=torch.int64), config.seed).shape[1]
        return max(1, LARGE_SAMPLES // solver.samples_per_pair(count))
    if not isinstance(config.batch_pairs, int) or config.batch_pairs < 1:
        raise UserError(f"batch_pairs must be a number of pairs, or null; got {config.batch_pairs}")
    return config.batch_pairs


def write_all(
    folder: Path, result: dict[str, Any], trainer: Trainer, evaluation: Evaluation, views: PairData, journal: Journal
) -> None:
    """Results, pictures and page; the first process writes them, once the results are those of all."""
    save = save_summaries if isinstance(evaluation, ViewSetEvaluation) else save_pictures
    divided = evaluation.device_mesh is not None  # a prior that needs every process, for the pictures too
    if trainer.is_global_zero:
        write_result(folder, result, evaluation.metrics, evaluation.table)
        journal.finish()
        pictures = save(folder / "pictures", evaluation, views)
        print_results(folder, result, pictures)
    elif divided:
        with TemporaryDirectory() as aside:
            save(Path(aside), evaluation, views)
    if divided:
        trainer.strategy.barrier()


def print_results(folder: Path, result: dict[str, Any], pictures: Sequence[Path]) -> None:
    """The table, the cost, and where the rest is."""
    config = result["config"]
    console = Console(width=110 if not Console().is_terminal else None, highlight=False)
    choices = f"{config['data']['name']}, {config['solver']['name']}, start={config['start']['name']}"
    sets = config["views"] is not None
    counted = f"poses in sets of {config['views']} images" if sets else f"pairs ({config['protocol']})"
    title = f"{choices}, {result['pairs']} {counted}"
    console.print(terminal_table(title, summary_rows(result)))
    console.print(f"seconds per pair {result['seconds_per_pair']:.4f}")
    if result["checkpoint"] is not None:
        origin = model_origin(Path(result["checkpoint"]), config["checkpoint"])
        console.print(f"model:    {origin}", soft_wrap=True)
    if result["unanswered"]:
        console.print(f"no answer for {result['unanswered']:.1%} of the pairs")
    console.print(f"results:  {folder / 'results.json'}", soft_wrap=True)
    names = ", ".join(picture.name for picture in pictures)
    console.print(f"pictures: {folder / 'pictures'} ({names})", soft_wrap=True)
    console.print(f"page:     {write_run_page(folder, 'eval')}", soft_wrap=True)
