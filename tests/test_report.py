"""`report`: finding runs, grouping them by varying settings, and writing them beside the paper's numbers."""

from __future__ import annotations

import csv
import json
import math
import re
import statistics
from pathlib import Path

import numpy as np
import pytest
from result_folders import metrics, write_job, write_result
from rich.console import Console

from lp_framework.errors import UserError
from lp_framework.report.runs import checkpoint_setting, find_runs, read_run
from lp_framework.report.sweep_figures import Curve, Panel, curves_figure, sweep_figure
from lp_framework.report.sweep_tables import csv_rows, layout, sweep_tables, terminal, varying

RECALLS = {0: (0.80, 0.82, 0.90), 0.3: (0.90, 0.91, 0.95)}  # by gamma, of seeds 0, 1, 2


def gamma_sweep(folder: Path, experiment: str | None = "gamma") -> Path:
    for gamma, recalls in RECALLS.items():
        for seed, recall in enumerate(recalls):
            config = {"solver.gamma": gamma, "seed": seed, "data.seed": seed}
            write_result(folder / f"{gamma}_{seed}", config, metrics(recall), experiment)
    return folder


def tables_of(folder: Path, objects="all"):
    runs, left_out = find_runs([folder])
    tables, unlabelled = sweep_tables(runs, objects)
    return tables, [*left_out, *unlabelled]


# ---------------------------------------------------------------- finding runs


def test_runs_are_found_wherever_they_lie_below_and_each_once(tmp_path):
    gamma_sweep(tmp_path / "a" / "deep")
    runs, left_out = find_runs([tmp_path, tmp_path / "a"])
    assert len(runs) == 6 and not left_out
    assert {run.experiment for run in runs} == {"gamma"}


def test_a_run_without_hydras_folder_has_no_experiment(tmp_path):
    write_result(tmp_path / "copied", experiment="gamma")
    (tmp_path / "copied" / ".hydra" / "hydra.yaml").unlink()
    assert read_run(tmp_path / "copied").experiment is None


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "damaged: .*results.json cannot be read"),
        ('{"metrics": {"R@5": 0.', "damaged: .*results.json cannot be read"),
        ('{"weight": 3}', r"cannot be read as the result of an evaluation \(KeyError"),
        ("[1, 2]", "cannot be read as the result of an evaluation"),
        (None, "unfinished: no results.json"),
    ],
)
def test_unfinished_and_damaged_runs_are_named_and_skipped(tmp_path, content, reason):
    write_result(tmp_path / "good")
    write_job(tmp_path / "bad")
    if content is not None:
        (tmp_path / "bad" / "results.json").write_text(content)
    runs, ((folder, said),) = find_runs([tmp_path])
    assert [run.folder.name for run in runs] == ["good"] and folder.name == "bad"
    assert re.search(reason, said)


def test_runs_of_other_commands_are_not_unfinished_evaluations(tmp_path):
    write_result(tmp_path / "good")
    write_job(tmp_path / "training", command="train")
    assert find_runs([tmp_path])[1] == []


def test_the_same_settings_and_seed_count_once(tmp_path):
    write_result(tmp_path / "1")
    write_result(tmp_path / "2")
    runs, ((folder, reason),) = find_runs([tmp_path])
    assert [run.folder.name for run in runs] == ["1"]
    assert folder.name == "2" and reason == f"duplicate of {tmp_path / '1'} (same settings and seed)"


def test_a_missing_folder_is_an_error(tmp_path):
    with pytest.raises(UserError, match=r"runs=.*nowhere: there is no such folder"):
        find_runs([tmp_path / "nowhere"])


# ---------------------------------------------------------------- grouping


def test_rows_are_mean_and_sample_deviation_over_seeds(tmp_path):
    (table,), _ = tables_of(gamma_sweep(tmp_path))
    assert table.columns == ["solver.gamma"] and [row.settings["solver.gamma"] for row in table.rows] == [0, 0.3]
    for row, recalls in zip(table.rows, RECALLS.values(), strict=True):
        assert row.seeds == [0, 1, 2]
        assert row.metrics["R@30"].mean == pytest.approx(sum(recalls) / 3)
        assert row.metrics["R@30"].std == pytest.approx(statistics.stdev(recalls))
        assert row.metrics["seconds_per_pair"].mean == pytest.approx(0.1)


def test_a_single_run_has_no_spread_and_an_infinite_median_stays_infinite(tmp_path):
    write_result(tmp_path / "one", values={**metrics(0.1), "rotation_error": None})
    write_result(tmp_path / "two", {"solver.gamma": 0}, metrics(0.1))
    write_result(tmp_path / "three", {"solver.gamma": 0, "seed": 1}, {**metrics(0.1), "rotation_error": None})
    (table,), _ = tables_of(tmp_path)
    still, noisy = table.rows
    assert math.isnan(noisy.metrics["R@30"].std) and math.isinf(noisy.metrics["rotation_error"].mean)
    assert math.isinf(still.metrics["rotation_error"].mean) and math.isnan(still.metrics["rotation_error"].std)
    assert "inf" in layout(table).lines[0][0]


@pytest.mark.parametrize("change", [{"data.name": "meshes"}, {"protocol": "per_view"}, {"data.path": "elsewhere"}])
def test_other_data_or_another_protocol_is_another_row(tmp_path, change):
    write_result(tmp_path / "a", {"seed": 0})
    write_result(tmp_path / "b", {"seed": 1, **change})
    (table,), _ = tables_of(tmp_path)
    assert len(table.rows) == 2 and set(change) <= set(table.columns)


def test_experiments_are_tables_of_their_own(tmp_path):
    gamma_sweep(tmp_path / "g")
    gamma_sweep(tmp_path / "none", experiment=None)
    write_result(tmp_path / "s", {"start.name": "random", "start.count": 2}, experiment="starts")
    tables, _ = tables_of(tmp_path)
    assert [table.experiment for table in tables] == ["gamma", "starts", None]
    assert [table.paper and table.paper.name for table in tables] == ["gamma", "starts", None]
    assert tables[1].columns == ["solver.name", "solver.gamma", "start.count"]  # the paper's, though nothing varies


def test_settings_implied_by_the_solver_are_not_columns():
    ifusion = {"solver.name": "ifusion", "solver.steps": 100, "solver.factor": 0.6}
    two_stage = {"solver.name": "two_stage", "solver.gamma": 0, "solver.factor": 0.7}
    assert varying([ifusion, two_stage]) == ["solver.name"]
    noisy = {**two_stage, "solver.gamma": 0.3}
    assert varying([ifusion, two_stage, noisy]) == ["solver.name", "solver.gamma"]
    assert varying([two_stage, noisy, {**noisy, "start.count": 2}]) == ["solver.gamma", "start.count"]
    assert varying([two_stage]) == []


def test_settings_of_some_rows_are_columns_if_only_they_distinguish_rows():
    old = {"solver.name": "two_stage"}
    assert varying([old, {**old, "solver.rescoring": 16}]) == ["solver.rescoring"]


def test_rows_are_ordered_by_number_not_by_letter(tmp_path):
    for count in (10, 2, 9):
        write_result(tmp_path / str(count), {"start.name": "random", "start.count": count})
    (table,), _ = tables_of(tmp_path)
    assert [row.settings["start.count"] for row in table.rows] == [2, 9, 10]


def test_objects_chooses_the_metrics(tmp_path):
    write_result(tmp_path / "a", values=metrics(0.4), metrics_unique_answer=metrics(0.9))
    write_result(tmp_path / "unlabelled", {"data.name": "renderings"}, metrics(0.5), metrics_unique_answer=None)
    (table,), (left,) = tables_of(tmp_path, "unique_answer")
    assert [row.metrics["R@30"].mean for row in table.rows] == [pytest.approx(0.9)]
    assert left.folder.name == "unlabelled" and "objects=all" in left.reason
    (table,), left_out = tables_of(tmp_path, "all")
    assert [row.metrics["R@30"].mean for row in table.rows] == pytest.approx([0.5, 0.4]) and not left_out


# ---------------------------------------------------------------- checkpoints


def training_run(folder: Path, model: str, seed: int, epochs: int = 10) -> str:
    folder.mkdir(parents=True)
    text = f"seed: {seed}\nmodel: {{name: {model}, seed: '${{seed}}'}}\ntrainer: {{max_epochs: {epochs}}}\n"
    (folder / "config.yaml").write_text(text)
    return str(folder / "checkpoints" / "best.ckpt")


def test_models_that_differ_in_their_seed_are_one_row_and_other_models_are_not(tmp_path):
    for name, model, seed in (("s0", "score", 0), ("s1", "score", 1), ("e0", "energy", 0)):
        checkpoint = training_run(tmp_path / "train" / name, model, seed)
        write_result(tmp_path / "runs" / name, experiment="score_energy", checkpoint=checkpoint)
    (table,), left_out = tables_of(tmp_path / "runs")
    assert table.columns == ["checkpoint"] and not left_out
    assert [(row.settings["checkpoint"], len(row.seeds)) for row in table.rows] == [("energy", 1), ("score", 2)]
    assert [row.label for row in table.paper.matching(table.rows[0].settings)] == ["Energy"]


def test_models_of_one_name_are_distinguished_by_their_paths(tmp_path):
    for name, epochs in (("short", 1), ("long", 60)):
        checkpoint = training_run(tmp_path / "train" / name, "score", 0, epochs)
        write_result(tmp_path / "runs" / name, checkpoint=checkpoint)
    (table,), _ = tables_of(tmp_path / "runs")
    assert [Path(row.settings["checkpoint"]).parts[-3] for row in table.rows] == ["long", "short"]


def test_the_last_and_the_best_of_a_training_are_two_models(tmp_path):
    best = training_run(tmp_path / "train", "score", 0)
    assert checkpoint_setting(best) != checkpoint_setting(best.replace("best", "last"))


def test_a_checkpoint_whose_training_is_gone_is_its_path():
    assert checkpoint_setting("gone/checkpoints/best.ckpt") == {"checkpoint": "gone/checkpoints/best.ckpt"}
    assert checkpoint_setting(None) == {}


# ---------------------------------------------------------------- tables in print


def test_the_papers_rows_stand_beside_those_they_are_compared_with(tmp_path):
    (table,), _ = tables_of(gamma_sweep(tmp_path))
    lines = layout(table).lines
    assert [cells[0] for cells, _ in lines] == ["0", "paper: gamma 0", "0.3", "paper: gamma 0.3", "paper: gamma 0.1",
                                                 "paper: gamma 0.5"]  # fmt: skip
    place = layout(table).headings.index("R@30")
    assert [cells[place] for cells, _ in lines[:4]] == ["0.840 ± 0.053", "0.884", "0.920 ± 0.026", "0.927"]
    assert [paper for _, paper in lines] == [False, True, False, True, True, True]


def test_every_row_and_all_of_the_papers_are_in_the_csv(tmp_path):
    columns, rows = csv_rows(tables_of(gamma_sweep(tmp_path))[0])
    named = [dict(zip(columns, row, strict=True)) for row in rows]
    assert [row["source"] for row in named] == ["runs"] * 2 + [f"paper: gamma {g}" for g in (0, 0.1, 0.3, 0.5)]
    assert named[0]["R@30"] == 0.84 and named[0]["R@30_std"] == round(statistics.stdev(RECALLS[0]), 5)
    assert (named[0]["runs"], named[0]["pairs"], named[2]["R@30"], named[2]["runs"]) == (3, 672, 0.884, None)


# ---------------------------------------------------------------- figures


def marks(figure):
    """For every panel its title and the data of its lines with marks."""
    return {
        axes.get_title(loc="left"): [
            line.get_xydata() for line in axes.lines if line.get_marker() not in ("", "None", "|", "_")
        ]
        for axes in figure.axes
    }


def test_the_figure_of_the_noise_has_our_means_and_the_papers(tmp_path):
    (table,), _ = tables_of(gamma_sweep(tmp_path))
    drawn = marks(sweep_figure(table))
    lines = drawn["Recall R (chosen start)"]
    assert len(lines) == 6  # within 5, 15 and 30 degrees, ours and the paper's
    np.testing.assert_allclose(lines[4], [[0, 0.84], [0.3, 0.92]])
    np.testing.assert_allclose(lines[5], [[0, 0.884], [0.3, 0.927]])


def test_the_figure_of_the_starts_has_time_on_its_second_axis(tmp_path):
    for count in (2, 8):
        config = {"start.name": "random", "start.count": count}
        write_result(tmp_path / str(count), config, metrics(0.5 + count / 20), None, seconds=count * 0.5)
    (table,), _ = tables_of(tmp_path)
    by_count, by_time = marks(sweep_figure(table)).values()
    np.testing.assert_allclose(by_count[0], [[2, 0.6], [8, 0.9]])
    np.testing.assert_allclose(by_time[0], [[1, 0.6], [4, 0.9]])


def test_choices_are_drawn_beside_each_other_and_one_row_is_no_figure(tmp_path):
    write_result(tmp_path / "a")
    assert sweep_figure(tables_of(tmp_path)[0][0]) is None
    write_result(tmp_path / "b", {"prior.name": "zero123"})
    figure = sweep_figure(tables_of(tmp_path)[0][0])
    assert [tick.get_text() for tick in figure.axes[0].get_yticklabels()] == ["tiny", "zero123"]


def test_curves_of_one_label_share_a_colour_and_nothing_is_outside_the_axes():
    x, nan = np.array([0.0, 1.0]), np.full(2, np.nan)
    own, paper = Curve("a", x, np.array([0.13, 0.5]), nan), Curve("a", x, np.array([0.4, 0.6]), nan, paper=True)
    other = Curve("b", x, np.array([0.7, 0.9]), np.array([0.1, 0.1]))
    axes = curves_figure([Panel("p", "x", [own, paper, other])]).axes[0]
    first, second, third = (line for line in axes.lines if line.get_marker() not in ("_", "|"))
    assert first.get_color() == second.get_color() != third.get_color()
    assert second.get_markerfacecolor() == "white" and axes.get_ylim()[0] <= 0.13


# ---------------------------------------------------------------- the command


def test_the_command_writes_tables_and_figures_and_names_skipped_runs(lp, tmp_path):
    gamma_sweep(tmp_path / "sweep")
    write_job(tmp_path / "sweep" / "stopped")
    ran = lp("report", "runs=sweep", "hydra.run.dir=out")
    assert ran.status == 0, ran.err
    assert "skipped: sweep/stopped: unfinished" in ran.out and "paper: gamma 0.3" in ran.out
    assert "6 runs; metrics over objects with a unique answer" in ran.out
    out = tmp_path / "out"
    assert {"report.md", "report.csv", "report.json", "gamma.png", "gamma.pdf"} <= {each.name for each in out.iterdir()}
    content = json.loads((out / "report.json").read_text())
    (table,) = content["tables"]
    assert table["experiment"] == "gamma" and table["figures"] == ["gamma.png", "gamma.pdf"]
    assert table["rows"][0]["settings"] == {"solver.gamma": 0} and len(table["rows"][0]["runs"]) == 3
    assert table["paper"]["rows"][0]["metrics"]["R@5"] == 0.593 and table["paper"]["notes"]
    assert content["left_out"] == [{"folder": "sweep/stopped", "reason": "unfinished: no results.json"}]
    with (out / "report.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 6
    text = (out / "report.md").read_text()
    assert "![gamma](gamma.png)" in text and "*0.884*" in text and "0.840 ± 0.053" in text
    assert "- `sweep/stopped`: unfinished" in text


@pytest.mark.parametrize("width", [60, 80, 110, 300])
def test_a_terminal_of_any_width_shows_every_number_with_its_label(tmp_path, capsys, width):
    ((table,), _) = tables_of(gamma_sweep(tmp_path), "unique_answer")
    content, console = layout(table), Console(width=width)
    parts = terminal(content, console.width)
    for part in parts:
        console.print(part)
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= width and "\N{HORIZONTAL ELLIPSIS}" not in shown
    assert shown.count("solver.gamma") == len(parts)  # the labels, beside each part of the numbers
    numbers = len(content.headings) - content.labels
    assert sum(len(part.columns) for part in parts) == numbers + len(parts) * content.labels
    assert len(parts) == (1 if width == 300 else len(parts)) and (width == 300 or len(parts) > 1)


def test_several_folders_are_one_report(lp, tmp_path):
    write_result(tmp_path / "a" / "x")
    write_result(tmp_path / "b" / "y", {"seed": 1})
    assert lp("report", "runs=[a,b]", "hydra.run.dir=out").status == 0
    ((row,),) = [table["rows"] for table in json.loads((tmp_path / "out" / "report.json").read_text())["tables"]]
    assert row["seeds"] == [0, 1]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("runs=nowhere",), "runs=nowhere: there is no such file or folder"),
        (("runs=empty",), "runs=empty: contains no finished run to report"),
        (("runs=stopped",), "runs=stopped: contains no finished run to report (stopped/a: unfinished: no res"),
        (
            ("runs=good", "objects=unique"),
            "objects=unique does not fit; expected one of unique_answer, all; did you mean 'un",
        ),
        ((), "runs needs a value: give runs=VALUE"),
    ],
)
def test_a_mistake_is_one_sentence(lp, tmp_path, arguments, sentence):
    (tmp_path / "empty").mkdir()
    write_job(tmp_path / "stopped" / "a")
    write_result(tmp_path / "good" / "a")
    ran = lp("report", *arguments, "hydra.run.dir=out")
    assert ran.status == 1 and ran.error.startswith(sentence)


def test_settings_that_do_not_affect_results_are_ignored(lp, tmp_path):
    for seed, batch_pairs in ((0, None), (1, 20)):
        write_result(tmp_path / "runs" / str(seed), {"seed": seed, "batch_pairs": batch_pairs, "resume": None})
    assert lp("report", "runs=runs", "hydra.run.dir=report").status == 0
    (table,) = json.loads((tmp_path / "report" / "report.json").read_text())["tables"]
    (row,) = table["rows"]
    assert sorted(row["seeds"]) == [0, 1] and not any("batch_pairs" in column for column in table["columns"])
