"""The model card of a training run: what the model is, its training data, its results and how it was made."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import yaml

from lp_framework.errors import UserError
from lp_framework.evaluation.tables import COLUMNS, ERRORS, RESULT, summary_rows
from lp_framework.report.page import BROKEN, read_record, render
from lp_framework.report.runs import saved_config

CARD = "README.md"
OVERRIDES = Path(".hydra") / "overrides.yaml"  # the command line's overrides, saved by Hydra
NAMED = 40  # objects listed in a card


def model_card(run: Path, name: str, license: str | None, results: str | None) -> str:
    """Build a card in Markdown, starting with the metadata for the Hugging Face hub.

    `name` is what the model is loaded by; `results` is the folder of its evaluation. `UserError` if a file of either
    run is missing or damaged.
    """
    try:
        training, config = read_record(run / "training.json"), saved_config(run / "config.yaml")
        evaluation = None if results is None else read_record(Path(results) / RESULT)
        rows = [] if evaluation is None else _rows(evaluation)
        given = yaml.safe_load((run / OVERRIDES).read_text(encoding="utf-8"))
    except BROKEN as error:
        raise UserError(f"the model card cannot be written: {error}") from error
    metadata = {"library_name": "lp_framework", "tags": ["camera-pose-estimation", training["model"]["name"]]}
    return render(
        "model_card.md.j2",
        metadata=yaml.safe_dump({**metadata, **({"license": license} if license else {})}, sort_keys=False),
        name=name,
        training=training,
        data=config["data"]["name"],
        objects=training["objects"][:NAMED],
        command=shlex.join(["python", "-m", "lp_framework", "train", *given]),
        columns=[*COLUMNS, *ERRORS],
        rows=rows,
        evaluated=evaluation and evaluation["config"]["data"]["name"],
        solver=evaluation and evaluation["config"]["solver"]["name"],
    )


def _rows(evaluation: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """The rows of an evaluation's metrics."""
    keys = [*COLUMNS, *ERRORS]
    return [
        (name.strip(), [f"{row[key]:.3f}" if key in row else "" for key in keys])
        for name, row in summary_rows(evaluation)
    ]
