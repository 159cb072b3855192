"""`eval`: evaluate a solver on a data set's test views; `resume=RUN_FOLDER` resumes a stopped run."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch.callbacks import RichProgressBar
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from lp_framework.analysis.examples import EXAMPLES, gather_examples, save_examples
from lp_framework.commands import building
from lp_framework.data.files import read_record
from lp_framework.data.module import EVALUATION_PAIRS
from lp_framework.data.pairs import PairData
from lp_framework.errors import UserError
from lp_framework.evaluation import journal
from lp_framework.evaluation.breakdown import breakdown, lines
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.evaluation.tables import RESULT, summary_rows, terminal_tables, write_result
from lp_framework.models.checkpoints import find_checkpoint
from lp_framework.report.page import write_run_page
from lp_framework.solvers.base import Solver
from lp_framework.solvers.starts import Starts
from lp_framework.viz.curves import calibration_figure, errors_figure
from lp_framework.viz.maps import pair_figure
from lp_framework.viz.sheets import ObjectCard, objects_figure
from lp_framework.viz.style import save_figure

LARGE = 100_000_000  # parameters; at Zero123's size, a few pairs fill a GPU, and more would delay saving
LARGE_SAMPLES = 72  # per pass of a large network: 4 pairs from 9 starts, 18 from 2


def run(config: DictConfig) -> None:
    """Evaluate and write `results.json`, `results.csv`, `pairs.csv` and pictures into this run's folder."""
    folder, checkpoint = building.run_folder(), None
    if config.resume is not None:
        folder = Path(config.resume)
        config, checkpoint = unfinished_evaluation(folder, config)
    settings = building.plain(config)
    if settings["trainer"].get("precision", "32-true") != "32-true":
        raise UserError(
            "trainer.precision must be 32-true, as poses are computed in float32; for Zero123 set prior.dtype"
        )
    if not isinstance(settings["pictures"], bool):
        raise UserError(f"pictures must be true or false, got {settings['pictures']}")
    building.seed_run(settings["seed"])
    components = building.Components(settings, checkpoint)
    if "model" in components.needs("solver") and checkpoint is None:
        components.checkpoint = find_checkpoint(settings["checkpoint"])
    subject: dict[str, Any] = {
        "config": settings,
        "checkpoint": str(components.checkpoint) if components.checkpoint else None,
    }
    if settings["resume"] is None and is_finished(folder, subject):
        return
    building.warn_of_unused(components)
    solver, starts, data = components["solver"], components["start"], components["data"]
    subject |= {"weights": building.weights_fingerprint(solver.networks()), "versions": building.versions()}
    before = journal.to_resume(folder, subject)
    kept = journal.Journal(folder, subject)
    trainer = building.build_trainer(settings["trainer"], folder, [RichProgressBar(leave=False)], logger=[])
    batch_pairs = pairs_at_once(settings["batch_pairs"], solver, starts)
    seed, views, protocol = settings["seed"], settings["views"], settings["protocol"]
    evaluation = Evaluation(solver, starts, seed, kept, views)
    data.evaluate_on(protocol, seed, batch_pairs, views)
    with building.resumable(folder, journal.FOLDER):
        trainer.test(evaluation, datamodule=data, verbose=False)
    evaluation.to(trainer.strategy.root_device)  # Lightning moved it to the CPU, where processes of GPUs cannot gather
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
        result["versions_before"] = before["versions"]  # for the pairs solved before the run was stopped
    if trainer.is_global_zero:
        result["breakdown"] = breakdown(evaluation.metrics.rows(), evaluation.table)
        with building.resumable(folder, journal.FOLDER):
            write_result(folder, result, evaluation.metrics, evaluation.table)
            pictures = []
            if settings["pictures"]:
                shown = data.data(data.evaluation_split())
                with Console(stderr=True).status("drawing pictures"):
                    pictures = save_pictures(folder / "pictures", evaluation, shown, result)
            print_results(folder, result, pictures)
        kept.finish()


def is_finished(folder: Path, subject: Mapping[str, Any]) -> bool:
    """Whether `folder` already has the results of this job of a sweep, for the same views and not older than its
    checkpoint; if so, prints it.

    Raises `UserError` rather than overwrite other results. A job whose results are unreadable runs again.
    """
    file, checkpoint = folder / RESULT, subject["checkpoint"]
    result = read_record(file)
    if HydraConfig.get().mode != RunMode.MULTIRUN or not {"config", "checkpoint", "fingerprints"} <= {*result}:
        return False
    chosen = {key: value for key, value in subject["config"].items() if key in ("data", "renderer", "protocol")}
    before = {"config": result["config"], "checkpoint": result["checkpoint"], **result["fingerprints"]}
    changed = journal.changes(before, {**subject, "views": views_fingerprint(json.dumps(chosen))})
    if not changed and checkpoint is not None and Path(checkpoint).stat().st_mtime > file.stat().st_mtime:
        changed = f"{checkpoint} is newer"
    if changed:
        raise UserError(f"{folder}: contains other results ({changed}); choose another hydra.sweep.dir or remove it")
    print(f"skipped (already finished): {folder}")
    return True


@functools.cache
def views_fingerprint(settings: str) -> str:
    """Fingerprint of the views chosen by settings (as JSON); computed once for all jobs of a sweep."""
    chosen = json.loads(settings)
    data = building.Components(chosen).test_views(chosen["protocol"])
    return data.fingerprint(data.evaluation_split())


def unfinished_evaluation(folder: Path, config: DictConfig) -> tuple[DictConfig, Path | None]:
    """The config and checkpoint of the stopped `eval` in `folder`; `UserError` if there is none."""
    subject = journal.unfinished(folder)
    if subject is None and (folder / RESULT).is_file():
        raise UserError(f"resume={folder}: that run is finished; its results are in {folder / RESULT}")
    if subject is None:
        raise UserError(f"resume={folder}: contains no {journal.FOLDER} evaluation to resume")
    previous = OmegaConf.create(subject["config"])
    checkpoint = Path(subject["checkpoint"]) if subject["checkpoint"] else None
    return building.with_overrides(previous, config, journal.MOVABLE, folder / journal.FOLDER), checkpoint


def pairs_at_once(batch_pairs: object, solver: Solver, starts: Starts) -> int:
    """Pairs per batch: the setting `batch_pairs`, or a default that fits the size of the solver's networks."""
    if batch_pairs is None:
        parameters = sum(each.numel() for network in solver.networks() for each in network.parameters())
        if parameters <= LARGE:
            return EVALUATION_PAIRS
        return max(1, LARGE_SAMPLES // solver.samples_per_pair(starts.count))
    if not isinstance(batch_pairs, int) or batch_pairs < 1:
        raise UserError(f"batch_pairs must be a number of pairs, or null; got {batch_pairs}")
    return batch_pairs


def print_results(folder: Path, result: dict[str, Any], pictures: Sequence[Path]) -> None:
    """Print the table, the cost, and where the output is."""
    config, views = result["config"], result["config"]["views"]
    console = Console(width=110 if not Console().is_terminal else None, highlight=False)
    choices = f"{config['data']['name']}, {config['solver']['name']}, start={config['start']['name']}"
    counted = f"pairs ({config['protocol']})" if views is None else f"poses in sets of {views} images"
    title = f"{choices}, {result['pairs']} {counted}"
    for table in terminal_tables(title, summary_rows(result), console.width):
        console.print(table)
    console.print(f"seconds per pair {result['seconds_per_pair']:.4f}")
    details = result["breakdown"]
    if details and details["calibration"]:  # of a model with probabilities
        for line in lines(details):
            console.print(line, soft_wrap=True)
    if result["unanswered"]:
        console.print(f"no answer for {result['unanswered']:.1%} of the pairs")
    console.print(f"results:  {folder / 'results.json'}", soft_wrap=True)
    if pictures:
        names = ", ".join(picture.name for picture in pictures)
        console.print(f"pictures: {folder / 'pictures'} ({names})", soft_wrap=True)
        console.print(f"page:     {write_run_page(folder, 'eval')}", soft_wrap=True)


def save_pictures(folder: Path, evaluation: Evaluation, data: PairData, result: Mapping[str, Any]) -> list[Path]:
    """After `Trainer.test`, save maps of some pairs (failures first), cumulative errors, and the objects in `folder`.

    Returns the PNG files. The pairs themselves go to the subfolder `EXAMPLES`, for the page of the run.
    """
    examples = gather_examples(evaluation, data)
    save_examples(folder / EXAMPLES, examples)
    rows, table = evaluation.metrics.rows(), evaluation.table
    rotation, translation, chosen = (rows[name].numpy() for name in ("rotation", "translation", "chosen"))
    figures = {}
    for number, pair in enumerate(examples):
        if pair.maps:
            degrees, distance = pair.rotation_errors[pair.chosen], pair.translation_errors[pair.chosen]
            off = f"rotation error {degrees:.1f}°, translation error {distance:.2f}"
            note = f"{pair.reason}: {'no answer' if np.isnan(degrees) else off}"
            figures[f"field_{number}"] = pair_figure(pair, pair.maps, f"{pair.title} ({pair.ambiguity})", note)
    classes = [table.ambiguities[index] for index in rows["object"].tolist()]
    figures["errors"] = errors_figure(rotation, translation, chosen, classes)
    assert data.images is not None  # evaluation never caches features
    cards = []
    for index, name in enumerate(data.table.names):
        if (metrics := result["per_object"][name]) is not None:  # no success rate if a pair has one answer
            view = np.asarray(data.images[data.table.views_of(index)[0]])
            rates = metrics["R(R)@15"], metrics.get("SR(R)@30")
            cards.append(ObjectCard(name, data.table.ambiguities[index], view, *rates))
    figures["objects"] = objects_figure(cards)
    if calibration := result["breakdown"].get("calibration"):
        figures["calibration"] = calibration_figure(calibration["bins"], f"{rows['object'].unique().numel()} objects")
    return [save_figure(figure, folder / name)[0] for name, figure in figures.items()]
