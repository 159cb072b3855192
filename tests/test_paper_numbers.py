"""The paper's numbers as data: as printed, and the rows that runs are compared with."""

from __future__ import annotations

from pathlib import Path

import pytest

from lp_framework.report.paper import paper_table, paper_tables
from lp_framework.report.sweep_tables import METRICS

TABLES = Path(__file__).parent / "data" / "paper_tables.txt"


def printed_tables() -> dict[str, list[list[float | None]]]:
    """The rows of numbers of each table as the paper prints them, None for a dash."""
    tables: dict[str, list[list[float | None]]] = {}
    for line in TABLES.read_text().splitlines():
        if line.startswith("["):
            rows = tables.setdefault(line.strip("[]"), [])
        elif line and not line.startswith("#"):
            rows.append([None if cell == "-" else float(cell) for cell in line.split()])
    return tables


PRINTED = printed_tables()


def values(name: str) -> list[list[float | None]]:
    table = paper_table(name)
    assert table is not None
    return [[row.metrics.get(column) for column in table.columns] for row in table.rows]


def test_every_table_of_the_paper_is_here():
    assert {table.name for table in paper_tables()} == set(PRINTED)
    assert all(table.name == table.experiments[0] for table in paper_tables())


@pytest.mark.parametrize("name", ["co3d", "hopev2", "methods", "priors", "score_energy", "unseen"])
def test_tables_with_one_row_per_line_match_the_paper(name):
    assert values(name) == PRINTED[name]


def test_the_table_of_noise_scales_is_the_papers():
    settings = [row.settings["solver.gamma"] for row in paper_table("gamma").rows]
    assert [[gamma, *row] for gamma, row in zip(settings, values("gamma"), strict=True)] == PRINTED["gamma"]


def test_the_table_of_inference_time_is_the_papers():
    recall, time = PRINTED["starts"]
    assert values("starts") == [list(pair) for pair in zip(recall, time, strict=True)]
    rows = paper_table("starts").rows
    assert [row.settings["start.count"] for row in rows] == [2, 4, 6, 8] * 2
    assert [row.settings["solver.name"] for row in rows] == ["ifusion"] * 4 + ["two_stage"] * 4


def test_the_multi_view_table_is_the_papers():
    rows = PRINTED["stages"]
    assert len(rows) == 6
    within_15, within_30 = [*rows[0], *rows[1], *rows[2]], [*rows[3], *rows[4], *rows[5]]
    assert values("stages") == [list(pair) for pair in zip(within_15, within_30, strict=True)]
    stages = [tuple(row.settings.values()) for row in paper_table("stages").rows]
    assert stages == [(first, second, views) for first, second in ((False, True), (True, False), (True, True))
                      for views in range(2, 9)]  # fmt: skip


@pytest.mark.parametrize("table", paper_tables(), ids=lambda table: table.name)
def test_a_table_names_what_runs_have(table):
    assert set(table.columns) <= set(METRICS)
    assert all(set(row.settings) <= set(table.settings) for row in table.rows)
    assert table.source and table.caption and table.notes
    assert all(0 <= value <= 1 for row in table.rows for name, value in row.metrics.items() if "R" in name)


def test_the_main_table_has_the_recalls_of_gamma_03_and_the_success_rates_of_no_gamma():
    published = next(row for row in paper_table("methods").rows if row.label == "GSO, Ours").metrics
    scales = {row.settings["solver.gamma"]: row.metrics for row in paper_table("gamma").rows}
    assert all(published[f"R@{degrees}"] == scales[0.3][f"R@{degrees}"] for degrees in (5, 15, 30))
    success = [f"SR@{degrees}" for degrees in (5, 15, 30)]
    assert not any([published[name] for name in success] == [row[name] for name in success] for row in scales.values())
    nearest = min(scales, key=lambda gamma: sum(abs(published[name] - scales[gamma][name]) for name in success))
    assert nearest == 0.1


@pytest.mark.parametrize(
    ("name", "labels", "pairs"),
    [
        ("methods", ("GSO, iFusion", "GSO, Ours", "OO3D, iFusion", "OO3D, Ours"), 70 * 8),
        ("gamma", ("gamma 0", "gamma 0.1", "gamma 0.3", "gamma 0.5"), 70 * 8),
        ("score_energy", ("Score", "Energy"), 10 * 8),
        ("hopev2", ("iFusion", "Ours"), 28 * 6),
        ("unseen", ("Ours",), 11 * 8),
        ("co3d", ("iFusion", "Ours"), 29 * 8),
        ("stages", ("w/o Stage 1, 2", "w/o Stage 2, 2", "Stage 1 & 2, 2"), 100 * 1),
        ("stages", ("w/o Stage 1, 3", "w/o Stage 2, 3", "Stage 1 & 2, 3"), 100 * 3),
        ("stages", ("w/o Stage 1, 4", "w/o Stage 2, 4", "Stage 1 & 2, 4"), 100 * 6),
        ("stages", ("w/o Stage 1, 8", "w/o Stage 2, 8", "Stage 1 & 2, 8"), 10 * 28),
    ],
)
def test_recalls_are_consistent_with_the_numbers_of_pairs_in_the_notes(name, labels, pairs):
    """Each is a whole number over `pairs`, to the three digits printed; of 0.0625, either neighbour may be printed."""
    shares = {count / pairs for count in range(pairs + 1)}
    rows = [row for row in paper_table(name).rows if row.label in labels]
    assert len(rows) == len(labels)
    recalls = [value for row in rows for key, value in row.metrics.items() if key.startswith("R")]
    assert recalls and all(min(abs(share - value) for share in shares) < 5.001e-4 for value in recalls)


def test_a_run_is_compared_with_the_rows_whose_settings_it_has():
    table = paper_table("methods")
    matching = table.matching({"solver.name": "ifusion", "data.name": "toy"})
    assert [row.label for row in matching] == ["GSO, iFusion", "OO3D, iFusion"]
    on_oo3d = table.matching({"solver.name": "ifusion", "data.name": "oo3d"})
    assert [row.label for row in on_oo3d] == ["OO3D, iFusion"]
    assert paper_table("main") is table
    assert table.matching({"solver.name": "langevin"}) == [] == table.matching({})
    assert paper_table("nothing") is None and paper_table(None) is None
