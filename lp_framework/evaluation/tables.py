"""Tables of results: in the terminal in the paper's layout, and on disk as JSON and CSV."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.table import Table

from lp_framework.atomic import written
from lp_framework.data.pairs import ViewTable
from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS, STATES, PoseMetrics

RESULT = "results.json"  # of a finished evaluation
COLUMNS = [f"{prefix}@{degrees}" for prefix in ("R", "R(R)", "SR", "SR(R)") for degrees in ROTATION_THRESHOLDS]
ERRORS = ["rotation_error", "translation_error"]
WIDE = 100  # terminal columns needed for the whole table


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with written(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON atomically; non-finite numbers become null."""
    write_text(path, json.dumps(finite(content), indent=2) + "\n")


def finite(value: Any) -> Any:
    """Replace non-finite numbers by None, as JSON needs, in nested mappings, lists and plain values."""
    if isinstance(value, Mapping):
        return {str(key): finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_arrays(path: Path, arrays: Mapping[str, NDArray]) -> None:
    """Write named arrays to `.npz` atomically."""
    with written(path) as partial, partial.open("wb") as file:  # given a path, NumPy would append a suffix
        np.savez(file, **arrays)  # type: ignore[arg-type]  # of the stub


def write_csv(path: Path, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Write CSV atomically."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    write_text(path, text.getvalue())


def summary_rows(result: Mapping[str, Any]) -> list[tuple[str, Mapping[str, float]]]:
    """The non-empty rows of the summary: all objects, those with a unique answer, and each ambiguity class."""
    rows = [("all objects", result["metrics"]), ("unique answer", result["metrics_unique_answer"])]
    if len(result["per_ambiguity"]) > 1:
        rows += [(f"  {name}", metrics) for name, metrics in result["per_ambiguity"].items()]
    return [(name, metrics) for name, metrics in rows if metrics is not None]


def terminal_tables(title: str, rows: Sequence[tuple[str, Mapping[str, float]]], width: int) -> list[Table]:
    """The paper's layout: R and R(R) at each threshold, then SR and SR(R), then the median errors.

    If that exceeds `width` columns, the success rates get their own table.
    """
    parts = [("R", "SR")] if width >= WIDE else [("R",), ("SR",)]
    return [_terminal_table(title if part is parts[0] else "", rows, part) for part in parts]


def _terminal_table(title: str, rows: Sequence[tuple[str, Mapping[str, float]]], prefixes: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, padding=0)
    table.add_column("", no_wrap=True)
    order, errors = [], "R" in prefixes
    for prefix in prefixes:
        for degrees in ROTATION_THRESHOLDS:
            order += [f"{prefix}@{degrees}", f"{prefix}(R)@{degrees}"]
            for label in (f"@{degrees}\n{prefix}", f"\n{prefix}(R)"):
                table.add_column(label, justify="right", min_width=5, no_wrap=True)
    for label in ("Rot.\n(deg)", "Trans.") if errors else ():
        table.add_column(label, justify="right", min_width=6)
    for name, metrics in rows:
        shares = [metrics.get(key) for key in order]
        cells = ["-" if each is None else f"{each:.2f}".removeprefix("0") for each in shares]
        cells = ["1.0" if cell == "1.00" else cell for cell in cells]
        cells += [f"{metrics['rotation_error']:.1f}", f"{metrics['translation_error']:.2f}"] if errors else []
        table.add_row(name, *cells)
    return table


def write_result(folder: Path, result: Mapping[str, Any], metrics: PoseMetrics, table: ViewTable) -> None:
    """Write `results.csv` (objects and summary rows), `pairs.csv` (one row per pair) and, last, `results.json`."""
    rows = [*summary_rows(result), *((name, row) for name, row in result["per_object"].items() if row is not None)]
    keys = [*COLUMNS, *ERRORS]
    lines = [[name.strip(), *(round(row[key], 5) if key in row else "" for key in keys)] for name, row in rows]
    write_csv(folder / "results.csv", ["name", *keys], lines)
    write_csv(folder / "pairs.csv", PAIR_COLUMNS, pair_rows(metrics, table))
    write_json(folder / RESULT, result)


PAIR_COLUMNS = (
    "object", "ambiguity", "reference", "query", "rotation_error_degrees", "translation_error", "chosen_start",
    "latitude_degrees", "longitude_degrees", "relative_radius", "probability",
)  # fmt: skip


def pair_rows(metrics: PoseMetrics, table: ViewTable) -> list[list[object]]:
    """One row per pair with the answer (relative pose, degrees) and its errors."""
    rows = metrics.rows()
    lines: list[list[object]] = []
    for solved in zip(*(rows[state].tolist() for state in STATES), strict=True):
        views, index, rotation, translation, chosen, (latitude, longitude, radius), probability = solved
        files = [table.files[view].name for view in views]
        errors = [round(each[chosen], 5) for each in (rotation, translation)]
        pose = [round(math.degrees(latitude), 4), round(math.degrees(longitude), 4), round(radius, 5)]
        sure = "" if math.isnan(probability) else round(probability, 4)
        lines.append([table.names[index], table.ambiguities[index], *files, *errors, chosen, *pose, sure])
    return lines
