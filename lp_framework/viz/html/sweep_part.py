"""Sets of evaluations on a page: tables as the paper prints them, beside its own numbers, and their figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lp_framework.report.printed_tables import layout
from lp_framework.report.sweep_tables import SweepTable
from lp_framework.viz.html.elements import Cell, Html, joined, section, sentence, sheet, table, tag


def sweep_part(content: SweepTable, title: str, figures: Sequence[Path]) -> Html:
    """A section: the table, the paper's rows in italics, and the figures (PNG files)."""
    printed = layout(content)
    rows = []
    for line in printed.lines:
        cells = []
        for cell, spread in zip(line.cells, line.spreads, strict=True):
            shown = joined(cell, tag("span", {"class": "spread"}, f" ±{spread}")) if spread else cell
            cells.append(Cell(shown, cell, "paper" if line.paper else ""))
        rows.append(cells)
    parts: list[Html] = [table(printed.headings, rows, printed.labels, sorts=True, caption=title)]
    parts += [sheet(figure, f"figure of {title}") for figure in figures]
    if content.paper is not None:
        parts.append(sentence(f"In italics the paper's own numbers ({content.paper.source}): {content.paper.caption}"))
        parts.append(tag("ul", {"class": "note"}, *(tag("li", {}, note) for note in content.paper.notes)))
    return section(title, *parts)


def left_out_part(left_out: Sequence[tuple[Path, str]]) -> Html:
    """The runs that are not counted in the tables, and why."""
    return section(
        "Left out",
        tag("ul", {}, *(tag("li", {}, tag("code", {}, str(path)), f": {reason}") for path, reason in left_out)),
    )
