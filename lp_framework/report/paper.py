"""The paper's own numbers as data: `paper/*.yaml`, one file per table.

A file holds the table's `title`, `source` and `caption`, the `experiments` of this project that reproduce it, `notes`
on differences, the dotted `settings` in which its rows differ, the `columns` (named as in `results.json`), and `rows`.
Each row has a `label`, the `settings` of the runs to compare it with, the `data` set in tables with several, and
`values`, null if the paper gives none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml


@dataclass(frozen=True)
class PaperRow:
    """A row of a table; `data` is the name of its data set here, None in a table of one."""

    label: str
    settings: Mapping[str, Any]
    data: str | None
    metrics: Mapping[str, float]


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper; see the module."""

    name: str
    title: str
    experiments: Sequence[str]
    source: str
    caption: str
    notes: Sequence[str]
    settings: Sequence[str]
    columns: Sequence[str]
    rows: Sequence[PaperRow]

    def matching(self, settings: Mapping[str, Any]) -> list[PaperRow]:
        """The rows that match a run's settings; only those of its data set if the table has any."""
        rows = [row for row in self.rows if row.settings.items() <= settings.items()]
        return [row for row in rows if row.data is not None and row.data == settings.get("data.name")] or rows


def paper_table(experiment: str | None) -> PaperTable | None:
    """The paper's table that an experiment reproduces, if any."""
    return next((table for table in paper_tables() if experiment in table.experiments), None)


@cache
def paper_tables() -> tuple[PaperTable, ...]:
    """All tables, sorted by name."""
    tables = []
    for file in sorted((Path(__file__).parent / "paper").glob("*.yaml")):
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
        rows = []
        for row in content["rows"]:
            values = zip(content["columns"], row["values"], strict=True)
            metrics = {name: value for name, value in values if value is not None}
            rows.append(PaperRow(row["label"], row["settings"], row.get("data"), metrics))
        tables.append(PaperTable(file.stem, **{**content, "rows": rows}))
    return tuple(tables)
