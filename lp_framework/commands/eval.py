"""`eval`: a solver on a data set's test views, as a table in the paper's layout, JSON and CSV.

A run that was stopped is resumed by `resume=RUN_FOLDER`, or by the same command in the same folder.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.callbacks import RichProgressBar
from omegaconf import DictConfig
from rich.console import Console

from lp_framework.commands.building import (
    Components,
    build_trainer,
    plain,
    run_folder,
    seed_run,
    versions,
    warn_of_unused,
    weights_fingerprint,
)
from lp_framework.commands.eval_pictures import save_pictures
from lp_framework.commands.finished import is_finished, unfinished_evaluation
from lp_framework.data.module import EVALUATION_PAIRS
from lp_framework.data.pairs import PairData
from lp_framework.errors import UserError
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.evaluation.journal import Journal, goes_on, unfinished
from lp_framework.evaluation.tables import summary_rows, terminal_table, write_result
from lp_framework.models.checkpoints import find_checkpoint
from lp_framework.report.page import write_run_page
from lp_framework.solvers.base import Solver
from lp_framework.solvers.starts import Starts

LARGE = 100_000_000  # parameters; a few pairs of Zero123's size fill a GPU, and many would be long unsaved
LARGE_SAMPLES = 72  # of networks that are large, in a pass: 4 pairs from 9 starts, 18 from 2


def run(config: DictConfig) -> None:
    """Evaluate and write `results.json`, `results.csv`, `pairs.csv` and pictures into this run's folder.

    With `resume` it is the folder of an evaluation that was stopped.
    """
    folder, checkpoint = run_folder(), None
    if config.resume is not None:
        folder = Path(config.resume)
        config, checkpoint = unfinished_evaluation(folder, config, HydraConfig.get().overrides.task)
    settings = plain(config)
    if settings["trainer"].get("precision", "32-true") != "32-true":
        raise UserError("trainer.precision: poses are computed in float32; prior.dtype=bfloat16 is Zero123's own")
    if not isinstance(settings["pictures"], bool):
        raise UserError(f"pictures must be true or false, got {settings['pictures']}")
    seed_run(settings["seed"])
    components = Components(settings, checkpoint)
    if "model" in components.needs("solver") and checkpoint is None:
        components.checkpoint = find_checkpoint(settings["checkpoint"])
    if settings["resume"] is None and is_finished(folder, settings, components.checkpoint):
        return
    warn_of_unused(components)
    solver, starts, data = components["solver"], components["start"], components["data"]
    subject = {
        "config": json.loads(json.dumps(settings)),
        "checkpoint": str(components.checkpoint) if components.checkpoint else None,
        "weights": weights_fingerprint(solver.networks()),
        "versions": versions(),
    }
    before = unfinished(folder) if goes_on(folder, subject) else None
    journal = Journal(folder, subject)
    trainer = build_trainer(settings["trainer"], folder, [RichProgressBar(leave=False)], logger=[])
    batch_pairs = pairs_at_once(settings["batch_pairs"], solver, starts)
    seed, views, protocol = settings["seed"], settings["views"], settings["protocol"]
    evaluation = Evaluation(solver, starts, seed, journal, views)
    if views is None:
        data.evaluate_on(protocol, seed, batch_pairs)
    elif protocol != "ordered":
        raise UserError(f"protocol={protocol} is for pairs; views={views} has a protocol of its own, leave it out")
    else:
        data.evaluate_on_sets(views, batch_pairs)
    trainer.test(evaluation, datamodule=data, verbose=False)
    evaluation.to(trainer.strategy.root_device)  # Lightning has put it on the CPU, where GPUs' processes cannot gather
    result = {
        **evaluation.metrics.compute(),
        "protocol": protocol if views is None else "view_sets",
        "seed": seed,
        "checkpoint": subject["checkpoint"],
        "fingerprints": {"weights": subject["weights"], "views": data.fingerprint(data.evaluation_split())},
        "config": settings,
        "versions": subject["versions"],
    }
    if before is not None and before["versions"] != result["versions"]:
        result["versions_before"] = before["versions"]  # of what was solved before it was stopped
    if trainer.is_global_zero:
        write_all(folder, result, evaluation, data.data(data.evaluation_split()), journal)


def pairs_at_once(batch_pairs: object, solver: Solver, starts: Starts) -> int:
    """Pairs in a batch: the setting `batch_pairs`, or by default what suits the size of the solver's networks.

    A batch is saved when it is solved.
    """
    if batch_pairs is None:
        parameters = sum(each.numel() for network in solver.networks() for each in network.parameters())
        if parameters <= LARGE:
            return EVALUATION_PAIRS
        return max(1, LARGE_SAMPLES // solver.samples_per_pair(starts.count))
    if not isinstance(batch_pairs, int) or batch_pairs < 1:
        raise UserError(f"batch_pairs must be a number of pairs, or null; got {batch_pairs}")
    return batch_pairs


def write_all(folder: Path, result: dict[str, Any], evaluation: Evaluation, views: PairData, journal: Journal) -> None:
    """Results, and pictures and page unless they are not wanted, once the results are those of all processes."""
    write_result(folder, result, evaluation.metrics, evaluation.table)
    journal.finish()
    wanted = result["config"]["pictures"]
    print_results(folder, result, save_pictures(folder / "pictures", evaluation, views, result) if wanted else [])


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
    if result["unanswered"]:
        console.print(f"no answer for {result['unanswered']:.1%} of the pairs")
    console.print(f"results:  {folder / 'results.json'}", soft_wrap=True)
    if pictures:
        names = ", ".join(picture.name for picture in pictures)
        console.print(f"pictures: {folder / 'pictures'} ({names})", soft_wrap=True)
        console.print(f"page:     {write_run_page(folder, 'eval')}", soft_wrap=True)
