"""The figure of accuracy over time: its solvers and their positions."""

import pytest
from result_folders import metrics, write_result

from lp_framework.report.runs import find_runs
from lp_framework.report.sweep_figures import cost_figure
from lp_framework.report.sweep_tables import sweep_tables


def table_of(folder):
    tables, _ = sweep_tables(find_runs([folder])[0], "unique_answer")
    return tables[0]


def test_each_solver_is_marked_at_its_seconds_and_recall(tmp_path):
    for number, (solver, recall, seconds) in enumerate(
        [("ifusion", 0.6, 20.0), ("two_stage", 0.9, 5.0), ("features", 0.1, 0.02)]
    ):
        write_result(
            tmp_path / str(number), {"solver.name": solver}, metrics(recall), experiment="methods", seconds=seconds
        )
    figure = cost_figure(table_of(tmp_path))
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["R(R)@5", "R(R)@15", "R(R)@30"]
    for axes, factor in zip(figure.axes, (0.7, 0.95, 1.0), strict=True):
        marks = sorted(bars.lines[0].get_xydata()[0].tolist() for bars in axes.containers)
        expected = [(0.02, 0.1), (5.0, 0.9), (20.0, 0.6)]
        for (seconds, recall), (true_seconds, true_recall) in zip(marks, expected, strict=True):
            assert (seconds, recall) == pytest.approx((true_seconds, true_recall * factor + 0.01))
        assert axes.get_xscale() == "log"


def test_one_solver_or_a_sweep_of_starts_has_none(tmp_path):
    for gamma in (0, 0.3):
        write_result(tmp_path / "gamma" / str(gamma), {"solver.gamma": gamma}, experiment="gamma")
    assert cost_figure(table_of(tmp_path / "gamma")) is None
    for solver in ("ifusion", "two_stage"):
        for count in (2, 4):
            config = {"solver.name": solver, "start.name": "random", "start.count": count}
            write_result(tmp_path / "starts" / f"{solver}_{count}", config, experiment="starts")
    assert cost_figure(table_of(tmp_path / "starts")) is None
