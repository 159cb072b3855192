"""A finished evaluation on a page: summary, pairs with the failures first, objects, errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lp_framework.analysis.examples import EXAMPLES, read_examples
from lp_framework.errors import UserError
from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS
from lp_framework.evaluation.tables import COLUMNS, ERRORS, summary_rows
from lp_framework.report.printed_tables import HEADINGS, number
from lp_framework.report.runs import RESULT
from lp_framework.viz.errors_plot import cumulative
from lp_framework.viz.html.elements import Cell, Html, folded, joined, plot, sentence, table
from lp_framework.viz.html.page import Data
from lp_framework.viz.html.parts import BROKEN, RunPart, configuration, guarded, read_json, read_rows
from lp_framework.viz.html.viewer import class_of, viewer
from lp_framework.viz.style import CLASS_COLOURS

KEYS = [*COLUMNS, *ERRORS]
WORST = 20  # pairs in the table of the worst
POINTS = 400  # of a curve


def evaluation_part(folder: Path, data: Data) -> RunPart:
    """Of the folder of an `eval`."""
    try:
        result = read_json(folder / RESULT)
    except UserError as error:
        return RunPart(folder.name, f"evaluation without results: {error}", {}, [configuration(folder, None, None)])
    config = result.get("config")
    examples = folder / "pictures" / EXAMPLES
    return RunPart(
        *_titles(folder, result),
        numbers=_numbers(result),
        sections=[
            guarded("Summary", lambda: _summary(result)),
            guarded("Pairs, failures first", lambda: viewer(read_examples(examples), data)),
            guarded("Objects", lambda: _objects(result, read_rows(folder / "pairs.csv"))),
            guarded("Errors", lambda: _errors(read_rows(folder / "pairs.csv"), data)),
            configuration(folder, config if isinstance(config, Mapping) else None, result.get("versions")),
        ],
    )


def _titles(folder: Path, result: Mapping[str, Any]) -> tuple[str, str]:
    try:
        config = result["config"]
        title = f"{config['solver']['name'].replace('_', ' ')} on {config['data']['name']}"
        settings = [f"start={config['start']['name']}", f"seed {result['seed']}"]
        return title, ", ".join([f"evaluation of {result['pairs']} pairs ({result['protocol']})", *settings])
    except BROKEN:
        return folder.name, "evaluation"


def _numbers(result: Mapping[str, Any]) -> dict[str, Cell]:
    try:
        unique = result["metrics_unique_answer"]
        metrics, over = (result["metrics"], "all objects") if unique is None else (unique, "unique answer")
        median, seconds = metrics["rotation_error"], result["seconds_per_pair"]
        return {
            **{f"{name}, {over}": Cell(f"{metrics[name]:.1%}", metrics[name]) for name in ("R@5", "R@15", "R(R)@15")},
            f"median rotation error, {over}": Cell("\N{INFINITY}", 1e9)
            if median is None
            else Cell(f"{median:.1f}°", median),
            "pairs": Cell(str(result["pairs"])),
            "seconds a pair": Cell(f"{seconds:.3g}"),
        }
    except BROKEN:
        return {}


def _summary(result: Mapping[str, Any]) -> Html:
    rows = []
    for name, metrics in summary_rows(result):
        label: str = class_of(name.strip()) if name.strip() in CLASS_COLOURS else name
        rows.append([Cell(label), *_metric_cells(metrics)])
    notes = [
        sentence(
            "R: share of pairs whose chosen start is within so many degrees and 0.2 object sizes; (R): by rotation "
            "alone; SR: the same over all starts. Errors are medians over the chosen starts."
        )
    ]
    if result.get("unanswered"):
        notes.append(sentence(f"For {result['unanswered']:.1%} of the pairs the solver had no answer."))
    return joined(table(["", *(HEADINGS.get(key, key) for key in KEYS)], rows, caption="summary"), *notes)


def _objects(result: Mapping[str, Any], pairs: Sequence[Mapping[str, str]]) -> Html:
    classes = {row["object"]: row["ambiguity"] for row in pairs}
    counts: dict[str, int] = {}
    for row in pairs:
        counts[row["object"]] = counts.get(row["object"], 0) + 1
    found = {name: metrics for name, metrics in result["per_object"].items() if metrics is not None}
    order = sorted(found, key=lambda name: (found[name]["R(R)@15"], found[name].get("SR(R)@30", 0), name))
    rows = []
    for name in order:
        kind = classes.get(name, "unlabelled")
        cells = [Cell(name.replace("_", " ")), Cell(class_of(kind), kind), Cell(str(counts.get(name, 0)))]
        rows.append([*cells, *_metric_cells(found[name])])
    headings = ["object", "class", "pairs", *(HEADINGS.get(key, key) for key in KEYS)]
    return joined(
        sentence("The worst first; a click on a heading sorts by it."),
        table(headings, rows, labels=2, sorts=True, caption="objects"),
    )


def _metric_cells(metrics: Mapping[str, float | None]) -> list[Cell]:
    cells = []
    for key in KEYS:
        if key not in metrics:  # success rates of a solver with one answer
            cells.append(Cell("-", -1))
            continue
        given = metrics[key]
        value = math.inf if given is None else given
        bad = key == "rotation_error" and not value <= ROTATION_THRESHOLDS[-1]
        cells.append(Cell(number(key, value), min(value, 1e9), "bad" if bad else ""))
    return cells


def _errors(pairs: Sequence[Mapping[str, str]], data: Data) -> Html:
    errors = {name: np.array([_error(row) for row in pairs if row["ambiguity"] == name]) for name in CLASS_COLOURS}
    curves = []
    for name, values in errors.items():
        if len(values):
            error, share = cumulative(values, 180.0)
            kept = np.unique(np.linspace(0, len(error) - 1, POINTS).round().astype(int))
            curves.append(
                {"name": name, "label": f"{name} ({len(values)} pairs)", "error": error[kept].round(3).tolist(),
                 "share": share[kept].round(5).tolist()}
            )  # fmt: skip
    worst = sorted(pairs, key=lambda row: -_error(row))[:WORST]
    rows = [
        [Cell(row["object"].replace("_", " ")), Cell(class_of(row["ambiguity"]), row["ambiguity"]),
         Cell(row["reference"]), Cell(row["query"]), _cell(_error(row), 1, "°"),
         _cell(float(row["translation_error"]), 2)]
        for row in worst
    ]  # fmt: skip
    headings = ["object", "class", "reference", "query", "rotation error", "translation error"]
    return joined(
        plot(data.add(curves), "errors", "share of pairs within a rotation error, a curve a class of objects"),
        folded(f"The {len(rows)} worst pairs", table(headings, rows, labels=4, sorts=True, caption="worst pairs")),
    )


def _cell(value: float, digits: int, unit: str = "") -> Cell:
    finite = math.isfinite(value)
    return Cell(f"{value:.{digits}f}{unit}" if finite else "none", value if finite else 1e9)


def _error(row: Mapping[str, str]) -> float:
    """The rotation error of a pair (degrees), infinite where there was no answer."""
    value = float(row["rotation_error_degrees"])
    return math.inf if math.isnan(value) else value
