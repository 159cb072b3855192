"""A training run on a page: its losses over the steps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lp_framework.analysis.shown import words
from lp_framework.errors import UserError
from lp_framework.report.parts import RunPart, configuration, packed, read_json, section, tried
from lp_framework.report.plots import losses_plot
from lp_framework.report.runs import saved_config
from lp_framework.viz.training import LOSSES, read_curves


def training_part(folder: Path) -> RunPart:
    """Of the folder of a `train`."""
    report: Mapping[str, Any] = {}
    try:
        report = read_json(folder / "training.json")
        subtitle = f"training over {report.get('epochs')} epochs, seed {report.get('seed')}"
    except UserError as error:
        subtitle = f"training that has not finished: {error}"
    config: Mapping[str, Any] = tried(lambda: saved_config(folder / "config.yaml"), {})
    return RunPart(
        tried(lambda: f"{words(config['model']['name'])} model, trained on {config['data']['name']}", folder.name),
        subtitle,
        tried(lambda: _numbers(folder, report), {}),
        [
            section("Losses", "losses", lambda: _losses(folder / "metrics.csv")),
            section("Last values", "last", lambda: _last(report)),
            configuration(folder, {"config": config or None, "versions": report.get("versions")}),
        ],
    )


def _numbers(folder: Path, report: Mapping[str, Any]) -> dict[str, str]:
    curves = read_curves(folder / "metrics.csv")
    best = {"best validation loss": f"{np.nanmin(curves['val/loss'].value):.4g}"} if "val/loss" in curves else {}
    return best | {key: str(report[key]) for key in ("epochs", "steps") if key in report}


def _losses(file: Path) -> dict[str, Any]:
    if not file.is_file():
        raise UserError("there is no metrics.csv")
    curves = read_curves(file)
    losses = {name: curves[name] for name in LOSSES if name in curves}
    if not losses:
        raise UserError("no loss was logged")
    rate = next((curve for name, curve in curves.items() if name.startswith("lr-")), None)
    return {"plot": packed(losses_plot(losses, rate).to_json())}


def _last(report: Mapping[str, Any]) -> dict[str, Any]:
    if "final" not in report:
        raise UserError("the run is not finished")
    values = sorted(report["final"].items())
    return {"values": {name: "none" if value is None else f"{value:.5g}" for name, value in values}}
