"""A training run on a page: its losses over the steps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from lp_framework.errors import UserError
from lp_framework.viz.html.elements import Cell, Html, facts, joined, plot, sentence
from lp_framework.viz.html.page import Data
from lp_framework.viz.html.parts import BROKEN, RunPart, configuration, guarded, read_json
from lp_framework.viz.training import LOSSES, Curve, read_curves, running_mean

POINTS = 2000  # of a curve


def training_part(folder: Path, data: Data) -> RunPart:
    """Of the folder of a `train`."""
    try:
        report: Mapping[str, Any] = read_json(folder / "training.json")
    except UserError as error:
        report = {}
        subtitle = f"training that has not finished: {error}"
    else:
        subtitle = f"training over {report.get('epochs')} epochs, seed {report.get('seed')}"
    config = _config(folder)
    return RunPart(
        _title(folder, config),
        subtitle,
        _numbers(folder, report),
        [
            guarded("Losses", lambda: _losses(folder, data)),
            guarded("Last values", lambda: _last(report)),
            configuration(folder, config, report.get("versions")),
        ],
    )


def _config(folder: Path) -> dict[str, Any] | None:
    try:
        content: Any = OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"), resolve=True)
        return dict(content)
    except (OSError, ValueError, TypeError, YAMLError, OmegaConfBaseException, RecursionError):
        return None


def _title(folder: Path, config: Mapping[str, Any] | None) -> str:
    try:
        assert config is not None
        return f"{config['model']['name'].replace('_', ' ')} model, trained on {config['data']['name']}"
    except (AssertionError, *BROKEN):
        return folder.name


def _numbers(folder: Path, report: Mapping[str, Any]) -> dict[str, Cell]:
    try:
        curves = read_curves(folder / "metrics.csv")
        numbers = {}
        if "val/loss" in curves:
            numbers["best validation loss"] = Cell(f"{np.nanmin(curves['val/loss'].value):.4g}")
        return numbers | {key: Cell(str(report[key])) for key in ("epochs", "steps") if key in report}
    except BROKEN:
        return {}


def _losses(folder: Path, data: Data) -> Html:
    file = folder / "metrics.csv"
    if not file.is_file():
        raise UserError("there is no metrics.csv")
    curves = read_curves(file)
    losses = {name: curves[name] for name in LOSSES if name in curves}
    if not losses:
        raise UserError("no loss was logged")
    rate = next((curve for name, curve in curves.items() if name.startswith("lr-")), None)
    content = {
        "losses": [_loss(LOSSES[name][1], curve) for name, curve in losses.items()],
        "rate": None if rate is None else _plain(rate),
    }
    return joined(
        plot(data.add(content), "curves", "training and validation loss over the training steps"),
        sentence("Where single records scatter they are pale, and their running mean is drawn over them."),
    )


def _loss(label: str, curve: Curve) -> dict[str, Any]:
    window = len(curve.step) // 20
    mean = running_mean(curve.value, window) if window > 1 else None
    return {"label": label, **_plain(curve), "mean": None if mean is None else _thinned(mean)}


def _plain(curve: Curve) -> dict[str, Any]:
    return {"step": _thinned(curve.step), "value": _thinned(curve.value)}


def _thinned(values: NDArray) -> list[float]:
    every = -(-len(values) // POINTS)
    return [float(f"{value:.5g}") for value in values[::every]]


def _last(report: Mapping[str, Any]) -> Html:
    if "final" not in report:
        raise UserError("the run is not finished")
    return facts({name: "none" if value is None else f"{value:.5g}" for name, value in sorted(report["final"].items())})
