"""The command line: overview, composition of configs, sweeps, and a one-sentence message for every mistake."""

from __future__ import annotations

import importlib.util
import inspect
import logging
import os
import re
import subprocess
import sys
import types
from pathlib import Path
from signal import SIGTERM

import pytest
from lightning import Trainer
from omegaconf import OmegaConf

from lp_framework import cli
from lp_framework.errors import UserError

ROOT = Path(__file__).parents[1]
DEMO = ("train", "-cd", "configs", "-cn", "demo")


@pytest.fixture
def jobs(walker, monkeypatch):
    """What the command `train` was run with, `(config, argv)` per job; gamma above 1 is bad input, steps of 0 a bug."""
    jobs = []

    def run(config):
        jobs.append((config, list(sys.argv)))
        if config.solver.get("gamma", 0) > 1:
            raise UserError(f"gamma is {config.solver.gamma}, it must not exceed 1")
        if config.solver.get("steps") == 0:
            raise ZeroDivisionError("a bug")

    module = types.ModuleType("lp_framework.commands.train")
    module.run = run
    monkeypatch.setitem(sys.modules, "lp_framework.commands.train", module)
    return jobs


def config_of(finished):
    assert finished.status == 0, finished.err
    return OmegaConf.to_container(OmegaConf.create(finished.out))


# ---------------------------------------------------------------- overview


@pytest.mark.parametrize("arguments", [(), ("--help",), ("-h",)])
def test_the_overview_names_every_command(lp, arguments):
    finished = lp(*arguments)
    assert finished.status == 0
    for command, summary in cli.COMMANDS.items():
        assert command in finished.out and summary in finished.out


def test_the_version_is_printed(lp):
    finished = lp("--version")
    assert finished.status == 0 and finished.out.startswith("lp_framework ")


@pytest.mark.parametrize("arguments", [(), ("--help",), ("plugins",)])
def test_overview_and_listing_import_nothing_heavy(arguments, tmp_path):
    code = "import sys; from lp_framework.cli import main; main(); print(*sys.modules, file=sys.stderr)"
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, cwd=tmp_path, env={"PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    loaded = set(done.stderr.split())
    assert done.returncode == 0 and "lp_framework.cli" in loaded
    assert not loaded & {"torch", "lightning", "hydra", "numpy", "trimesh", "omegaconf"}


# ---------------------------------------------------------------- composition


def test_a_config_is_a_name_and_the_defaults_of_the_constructor_overridden_by_yaml(lp, walker):
    config = config_of(lp(*DEMO, "--cfg", "job"))
    assert config["solver"] == {
        **{"name": "walk", "gamma": 0.3, "steps": 7, "limit": None, "order": "first", "sizes": [1, 2]}
    }
    assert config["model"] == {"name": "net", "width": 3}


def test_a_yaml_with_a_name_is_one_more_choice(lp, walker, write):
    write("plugins/walker/conf/solver/slow_walk.yaml", "name: walk\ngamma: 1e-3\n")
    for choice, gamma, steps in (("long_walk", 0.3, 700), ("slow_walk", 0.001, 50)):
        solver = config_of(lp(*DEMO, f"solver={choice}", "--cfg", "job"))["solver"]
        assert (solver["name"], solver["gamma"], solver["steps"]) == ("walk", gamma, steps)


@pytest.mark.filterwarnings("error:\\s'solver")  # Hydra's, where a plugin's is there as well
def test_the_users_own_folder_wins_over_a_plugins(lp, walker, write):
    write("configs/solver/long_walk.yaml", "defaults: [walk, _self_]\nsteps: 8\n")
    write("configs/solver/stroll.yaml", "defaults: [walk, _self_]\ngamma: 0.1\n")
    assert config_of(lp(*DEMO, "solver=long_walk", "--cfg", "job"))["solver"]["steps"] == 8
    solver = config_of(lp(*DEMO, "solver=stroll", "--cfg", "job"))["solver"]
    assert (solver["name"], solver["gamma"], solver["steps"]) == ("walk", 0.1, 7)


def test_an_experiment_holds_differences(lp, walker):
    assert config_of(lp(*DEMO, "experiment=hike", "--cfg", "job"))["solver"]["steps"] == 60
    assert config_of(lp(*DEMO, "experiment=hike", "solver.steps=5", "--cfg", "job"))["solver"]["steps"] == 5


def test_every_argument_of_the_trainer_can_be_given(lp):
    ran = lp("train", "trainer.limit_train_batches=20", "trainer.max_epochs=2", "--cfg", "job")
    assert config_of(ran)["trainer"]["limit_train_batches"] == 20
    assert "did you mean 'max_epochs'" in lp("train", "trainer.max_epoch=2").error
    names = [name for name in inspect.signature(Trainer.__init__).parameters if name != "self"]
    assert {"max_steps", "min_epochs", "check_val_every_n_epoch"} <= {*names}
    trainer = config_of(lp("train", *(f"trainer.{name}=null" for name in names), "--cfg", "job"))["trainer"]
    assert {*names} <= {*trainer}


@pytest.mark.parametrize("choice", ["solver=langevin,sharp", "solver.gamma=0,1"])
def test_an_experiment_that_is_a_sweep_needs_no_option_for_further_values(lp, monkeypatch, choice):
    module = types.ModuleType("lp_framework.commands.eval")
    module.run = lambda config: print(f"{config.solver.name} {config.seed}")
    monkeypatch.setitem(sys.modules, "lp_framework.commands.eval", module)
    ran = lp("eval", "experiment=gamma", "seed=3", choice, "hydra.sweep.dir=out")
    assert ran.status == 0 and len(re.findall(r"^\w+ 3$", ran.out, re.MULTILINE)) in (2, 8)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("eval", "data=meshes"), "data.path needs a value: give data.path=VALUE"),
        (("eval", "data=meshes", "data.path=gone"), "data.path=gone: there is no such file or folder"),
        (
            ("eval", "checkpoint=runs/gone"),
            "checkpoint=runs/gone: there is no such file or folder; to train it: lp train hydra.run",
        ),
        (
            ("eval", "experiment=co3d", "hydra.mode=RUN", "checkpoint=runs/co3d", "data.path=."),
            "checkpoint=runs/co3d: there is no such file or folder; to train it: lp train experiment=paper data=co3d",
        ),
        (("estimate", "a.png", "b.png"), "images=a.png: there is no such file or folder"),
        (("report", "runs=20240101"), "runs=20240101: there is no such file or folder"),
    ],
)
def test_missing_files_are_named_before_anything_heavy_is_imported(lp, monkeypatch, arguments, sentence):
    monkeypatch.setitem(sys.modules, f"lp_framework.commands.{arguments[0]}", None)  # importing it would fail
    finished = lp(*arguments)
    assert finished.status == 1 and finished.error.startswith(sentence)


def test_an_experiment_of_another_command_says_whose_it_is(lp, write):
    for name, content in (("odd", "defaults: 3"), ("empty", "defaults:"), ("list", "[1]"), ("broken", "{")):
        write(f"odd/experiment/{name}.yaml", f"{content}\n")
    finished = lp("figure", "experiment=gamma", "--config-dir", "odd")
    assert finished.status == 2
    assert finished.error.startswith("experiment=gamma belongs to another command, not to figure (known: ")
    assert "figure_cameras, " in finished.error and "stages" not in finished.error


@pytest.mark.parametrize("folder", ["hydra.run.dir=file/run", "hydra.run.dir=file", "hydra.sweep.dir=file/sweep"])
def test_a_folder_that_cannot_be_made_is_named(lp, walker, write, jobs, folder):
    write("file", "")
    sweep = ("--multirun", "solver.steps=1,2") if "sweep" in folder else ()
    finished = lp(*DEMO, folder, *sweep)
    assert finished.status == 2 and not jobs
    assert finished.error.startswith("the folder of this run cannot be created: [Errno ")


@pytest.mark.parametrize("command", ["train", "eval"])
def test_an_experiment_with_settings_of_another_command_names_it(lp, command):
    """`train` has a backbone without the setting, `eval` none at all."""
    finished = lp(command, "experiment=gpu")
    assert finished.status == 2
    assert finished.error.startswith(f"experiment=gpu belongs to another command, not to {command} (known: ")


def test_a_yaml_may_choose_a_member_of_another_group(lp, walker, write):
    write("configs/solver/pair.yaml", "defaults: [walk, {/model@_global_.second: net}, _self_]\nsteps: 9\n")
    config = config_of(lp(*DEMO, "solver=pair", "--cfg", "job"))
    assert config["second"] == {"name": "net", "width": 3}
    assert config["solver"]["steps"] == 9 and "defaults" not in config["solver"]


def test_the_help_of_a_command_lists_choices_and_settings(lp, walker):
    finished = lp(*DEMO, "--help")
    assert finished.status == 0 and "A demo of the help." in finished.out
    assert "solver: " in finished.out and "jump, " in finished.out and "long_walk" in finished.out
    experiments = re.search(r"experiment: (.+)", finished.out)
    assert experiments is not None and {"broken", "hike"} <= set(experiments[1].split(", "))
    assert "solver.gamma: 0.3" in finished.out and "seed: 0 # of every draw" in finished.out
    assert "solver.steps: 700" in lp(*DEMO, "solver=long_walk", "--help").out
    assert "--multirun" in finished.out and "trainer" not in finished.out


@pytest.mark.parametrize("command", [command for command in cli.COMMANDS if command != "plugins"])
def test_every_command_has_a_module_a_config_and_a_help(lp, command):
    assert importlib.util.find_spec(f"lp_framework.commands.{command}") is not None
    config_of(lp(command, "--cfg", "job"))
    assert f"Usage: lp {command} " in lp(command, "--help").out


# ---------------------------------------------------------------- running


def test_a_run_keeps_its_config_and_log_in_its_folder(lp, jobs, walker):
    finished = lp(*DEMO, "solver.gamma=1")
    assert (finished.status, finished.out, finished.err) == (0, "", "")
    (config, argv), = jobs  # fmt: skip
    assert config.solver.gamma == 1
    (folder,) = (walker / "runs" / "demo").iterdir()
    assert OmegaConf.load(folder / ".hydra" / "config.yaml") == config
    assert (folder / "train.log").exists()
    assert argv == ["lp", "train", "--config-dir", "configs", "--config-name", "demo", "solver.gamma=1"]


def test_a_saved_config_holds_names_and_numbers_only(lp, jobs, walker):
    lp(*DEMO)
    (folder,) = (walker / "runs" / "demo").iterdir()
    text = (folder / ".hydra" / "config.yaml").read_text()
    assert "_target_" not in text and "tmp_walker" not in text and "!!" not in text


def test_bad_input_at_run_time_is_one_sentence_and_leaves_no_empty_folder(lp, jobs, walker):
    finished = lp(*DEMO, "solver.gamma=2")
    assert finished.status == 1 and finished.error == "gamma is 2, it must not exceed 1"
    assert list((walker / "runs" / "demo").iterdir()) == []
    (walker / "mine").mkdir()
    (walker / "mine" / "notes.txt").write_text("precious")
    lp(*DEMO, "solver.gamma=2", "hydra.run.dir=mine")
    assert (walker / "mine" / "notes.txt").exists()
    assert "gamma is 2, it must not exceed 1" in (walker / "mine" / "train.log").read_text()


def test_commands_started_in_the_same_second_have_separate_folders(lp, jobs, walker):
    for _ in range(5):
        lp(*DEMO)
    assert len(list((walker / "runs" / "demo").iterdir())) == 5


def test_a_bug_keeps_its_traceback(lp, jobs, walker):
    with pytest.raises(ZeroDivisionError, match="a bug"):
        lp(*DEMO, "solver.steps=0")
    (folder,) = (walker / "runs" / "demo").iterdir()
    assert "Traceback" in (folder / "train.log").read_text()


def test_full_errors_on_request(lp, jobs, monkeypatch):
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(UserError, match="must not exceed"):
        lp(*DEMO, "solver.gamma=2")


def test_a_sweep_runs_every_combination_in_a_folder_each(lp, jobs, walker):
    assert lp(*DEMO, "--multirun", "solver.gamma=0,0.5", "solver.steps=1,2").status == 0
    assert [(config.solver.gamma, config.solver.steps) for config, _ in jobs] == [(0, 1), (0, 2), (0.5, 1), (0.5, 2)]
    (sweep,) = (walker / "runs" / "multirun" / "demo").iterdir()
    assert sorted(each.name for each in sweep.iterdir() if each.is_dir()) == ["0", "1", "2", "3"]
    assert jobs[1][1][-2:] == ["solver.gamma=0", "solver.steps=2"]  # a job's own command line, not the sweep's


@pytest.mark.parametrize(("bad", "status"), [("solver.gamma=0,2,1", 1), ("solver.steps=1,0,2", None)])
def test_a_job_that_fails_does_not_stop_a_sweep(lp, jobs, bad, status):
    if status is None:
        with pytest.raises(ZeroDivisionError):
            lp(*DEMO, "--multirun", bad)
    else:
        finished = lp(*DEMO, "--multirun", bad)
        assert finished.status == status
        assert "job 1 (solver.gamma=2): gamma is 2" in finished.err and "Traceback" not in finished.err
    assert len(jobs) == 3


def test_an_interrupted_command_leaves_no_empty_folder(lp, jobs, walker, monkeypatch):
    monkeypatch.setattr(sys.modules["lp_framework.commands.train"], "run", lambda _: os.kill(os.getpid(), SIGTERM))
    assert (lp(*DEMO).status, list((walker / "runs" / "demo").iterdir())) == (143, [])


def test_warnings_of_the_hub_are_printed_once(lp, jobs, monkeypatch):
    hub = logging.getLogger("huggingface_hub")
    monkeypatch.setattr(hub, "propagate", True)

    def run(config):
        monkeypatch.setattr(hub, "handlers", [logging.StreamHandler()])  # as the hub's package does when imported
        hub.warning("Retrying in 1s")

    monkeypatch.setattr(sys.modules["lp_framework.commands.train"], "run", run)
    assert lp(*DEMO).err.count("Retrying in 1s") == 1


def test_a_job_of_a_sweep_does_not_inherit_the_ranks_of_the_previous_one(lp, jobs, monkeypatch):
    seen = []

    def run(config):
        seen.append(os.environ.get("LOCAL_RANK"))
        os.environ["LOCAL_RANK"] = "1"  # as Lightning does when it starts several processes

    monkeypatch.setattr(sys.modules["lp_framework.commands.train"], "run", run)
    assert lp(*DEMO, "--multirun", "seed=1,2").status == 0
    assert seen == [None, None]


# ---------------------------------------------------------------- mistakes


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("trian",), "there is no command 'trian'; did you mean 'train'? (known: train, eval, "),
        (("train", "experiment=papre"), "there is no experiment 'papre'; did you mean 'paper'? (known: "),
        (("train", "trainer.max_epoch=3"), "trainer has no 'max_epoch'; did you mean 'max_epochs'? (known: "),
        (("train", "model=scor"), "model=scor: there is no model 'scor'; did you mean 'score'? (known: "),
        (("eval", "solver.gama=0"), "solver.gama: solver has no 'gama'; did you mean 'gamma'? (known: name, "),
        (("eval", "start=rnig"), "start=rnig: there is no start 'rnig'; did you mean 'ring'? (known: "),
        ((*DEMO, "solver=wlak"), "solver=wlak: there is no solver 'wlak'; did you mean 'walk'? (known: "),
        ((*DEMO, "experiment=hiek"), "there is no experiment 'hiek'; did you mean 'hike'? (known: "),
        ((*DEMO, "slver=walk"), "slver: the configuration has no 'slver'; did you mean 'solver'?"),
        ((*DEMO, "experimnt=hike"), "experimnt: the configuration has no 'experimnt'; did you mean 'experiment'?"),
        (
            (*DEMO, "solver.gama=1"),
            "solver.gama: solver has no 'gama'; did you mean 'gamma'? (known: name, gamma",
        ),
        ((*DEMO, "gamma=1"), "gamma: the configuration has no 'gamma'; did you mean 'solver.gamma'?"),
        ((*DEMO, "sed=1"), "sed: the configuration has no 'sed'; did you mean 'seed'?"),
        ((*DEMO, "solver=walk,jump"), "'solver=walk,jump' has several values: add --multirun to run each"),
        ((*DEMO, "seed=1,2"), "'seed=1,2' has several values: add --multirun to run each, or write a list, seed=[1,2]"),
        (
            (*DEMO, "solver.gamma=[1"),
            "cannot read 'solver.gamma=[1': write text with special characters as \"solver.gamma='[1'\", a list as",
        ),
        ((*DEMO, "walk"), "cannot read 'walk': write KEY=VALUE"),
        ((*DEMO, "model=3"), "Config group override must be a string or a list. Got int"),
        ((*DEMO, "hydra.run.dir=${nowhere}"), "Interpolation key 'nowhere' not found"),
        ((*DEMO, "--cfg", "job", "--multirun"), "Only one of --run, --multirun, --cfg, "),
        ((*DEMO, "--mutirun"), "there is no option '--mutirun'; did you mean '--multirun'?"),
        (("train", "-cd", "nowhere"), "Additional config directory '"),
    ],
)
def test_invalid_command_lines(lp, jobs, arguments, sentence):
    finished = lp(*arguments)
    assert finished.status == 2
    assert finished.error.startswith(sentence) or sentence in finished.error
    assert not jobs


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("steps: [1\n", "walk.yaml: while parsing a flow sequence"),
        ("- steps\n", "walk.yaml: a configuration is a mapping 'key: value', not a list"),
    ],
)
def test_a_plugins_file_with_a_mistake_is_named_and_left_out(lp, walker, write, text, sentence):
    write("plugins/walker/conf/solver/walk.yaml", text)
    finished = lp(*DEMO, "solver=long_walk", "--cfg", "job")
    assert finished.err.startswith("warning: a plugin's configuration is left out: ") and sentence in finished.err
    assert config_of(finished)["solver"]["steps"] == 700


def test_the_users_file_with_a_mistake_is_named(lp, walker, write):
    write("configs/solver/mine.yaml", "steps: [1\n")
    finished = lp(*DEMO, "solver=mine")
    assert finished.status == 2 and "mine.yaml" in finished.error


def test_a_setting_without_a_default_has_to_be_given(lp, jobs, walker, monkeypatch):
    def run(config):
        return config.solver.height

    monkeypatch.setattr(sys.modules["lp_framework.commands.train"], "run", run)
    finished = lp(*DEMO, "solver=jump")
    assert finished.status == 1 and finished.error == "solver.height needs a value: give solver.height=VALUE"
    assert lp(*DEMO, "solver=jump", "solver.height=2").status == 0


@pytest.mark.heavy
def test_a_mistake_in_a_subprocess_prints_no_traceback(lp_process, walker):
    finished = lp_process(*DEMO, "solver.gama=1")
    assert finished.status == 2 and "did you mean 'gamma'" in finished.error


def test_options_may_stand_between_overrides(lp):
    ran = lp("train", "model=energy", "--cfg", "job", "seed=3")
    assert ran.status == 0 and "name: energy" in ran.out and "seed: 3" in ran.out
