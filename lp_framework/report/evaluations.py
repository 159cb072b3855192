"""A finished evaluation on a page: summary, pairs with the failures first, objects, errors."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lp_framework.analysis.examples import EXAMPLES, read_examples
from lp_framework.analysis.shown import words
from lp_framework.errors import UserError
from lp_framework.evaluation.tables import RESULT, summary_rows
from lp_framework.report.pairs import pairs
from lp_framework.report.parts import RunPart, configuration, packed, read_json, read_rows, section, tried
from lp_framework.report.plots import errors_plot
from lp_framework.viz.style import CLASS_COLOURS

WORST = 20  # pairs in the table of the worst


def evaluation_part(folder: Path) -> RunPart:
    """Of the folder of an `eval`."""
    try:
        result = read_json(folder / RESULT)
    except UserError as error:
        return RunPart(folder.name, f"evaluation without results: {error}", {}, [configuration(folder, {})])
    return RunPart(
        *tried(lambda: _titles(result), (folder.name, "evaluation")),
        numbers=tried(lambda: _numbers(result), {}),
        sections=[
            section("Summary", "summary", lambda: {"rows": summary_rows(result), "result": result}),
            section("Pairs, failures first", "pairs", lambda: _pairs(folder, result)),
            section("Objects", "objects", lambda: _objects(result, read_rows(folder / "pairs.csv"))),
            section("Errors", "errors", lambda: _errors(read_rows(folder / "pairs.csv"))),
            configuration(folder, result),
        ],
    )


def _titles(result: Mapping[str, Any]) -> tuple[str, str]:
    config = result["config"]
    settings = f"start={config['start']['name']}, seed {result['seed']}"
    return (
        f"{words(config['solver']['name'])} on {config['data']['name']}",
        f"evaluation of {result['pairs']} pairs ({result['protocol']}), {settings}",
    )


def _numbers(result: Mapping[str, Any]) -> dict[str, str]:
    unique = result["metrics_unique_answer"]
    metrics, over = (result["metrics"], "all objects") if unique is None else (unique, "unique answer")
    median = metrics["rotation_error"]
    return {
        **{f"{name}, {over}": f"{metrics[name]:.1%}" for name in ("R@5", "R@15", "R(R)@15")},
        f"median rotation error, {over}": "\N{INFINITY}" if median is None else f"{median:.1f}°",
        "pairs": str(result["pairs"]),
        "seconds a pair": f"{result['seconds_per_pair']:.3g}",
    }


def _pairs(folder: Path, result: Mapping[str, Any]) -> dict[str, Any]:
    if result["config"].get("pictures") is False:
        raise UserError("the run was made with pictures=false")
    return pairs(read_examples(folder / "pictures" / EXAMPLES))


def _objects(result: Mapping[str, Any], rows: Sequence[Mapping[str, str]]) -> dict[str, Any]:
    classes = {row["object"]: row["ambiguity"] for row in rows}
    found = {name: metrics for name, metrics in result["per_object"].items() if metrics is not None}
    order = sorted(found, key=lambda name: (found[name]["R(R)@15"], found[name].get("SR(R)@30", 0), name))
    return {
        "objects": {name: found[name] for name in order},
        "classes_of": {name: classes.get(name, "unlabelled") for name in order},
        "counts": Counter(row["object"] for row in rows),
    }


def _errors(rows: Sequence[Mapping[str, str]]) -> dict[str, Any]:
    rotation = np.array([float(row["rotation_error_degrees"]) for row in rows])
    classes = np.array([row["ambiguity"] for row in rows])
    figure = errors_plot({name: rotation[classes == name] for name in CLASS_COLOURS if name in classes})
    order = np.argsort(-np.nan_to_num(rotation, nan=math.inf), kind="stable")[:WORST]
    worst = [(rows[place], rotation[place], float(rows[place]["translation_error"])) for place in order]
    return {"plot": packed(figure.to_json()), "worst": worst}
