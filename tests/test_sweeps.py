"""Sweeps: the experiments that make the paper's tables, continuing an interrupted sweep, launchers."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import pytest
import slurm_stand_in
import yaml
from hydra.core.hydra_config import HydraConfig
from tiny_runs import Commands, Ran

from lp_framework.commands.eval import views_fingerprint
from lp_framework.data.module import PairDataModule
from lp_framework.report.paper import paper_tables
from lp_framework.run_folders import held

pytestmark = pytest.mark.heavy
ROOT = Path(__file__).parents[1]
SWEEP = ("--multirun", "hydra.sweep.dir=sweep", "checkpoint=./score", "solver.iterations=2")


# ---------------------------------------------------------------- experiments


@pytest.fixture
def jobs(monkeypatch):
    """Config, folder, command line and mode of every job of `eval`."""
    import lp_framework.commands.eval as command

    jobs = []

    def run(config):
        jobs.append((config, HydraConfig.get().runtime.output_dir, list(sys.argv)))

    monkeypatch.setattr(command, "run", run)
    return jobs


def plain_noise(gamma):
    return gamma if gamma is None or isinstance(gamma, float) else tuple(gamma)


@pytest.mark.parametrize(
    ("experiment", "narrowed", "varies"),
    [
        ("gamma", (), {("two_stage", gamma) for gamma in (0, 0.1, 0.3, 0.5)}),
        ("starts", ("start.count=2,8",), {(solver, noise, count) for count in (2, 8) for solver, noise in (
            ("ifusion", None), ("two_stage", (0.0, 0.3, 0.0)), ("two_stage", 0.0), ("gauss_newton", 0.0))}),
        ("priors", (), {("two_stage", "tiny")}),
        ("score_energy", (), {("two_stage", "runs/score"), ("two_stage", "runs/energy")}),
        ("stages", ("views=2,8",), {(first, second, views) for first, second in ((True, True), (True, False),
                                                                                 (False, True)) for views in (2, 8)}),
        ("methods", (), {(solver, noise, "grid") for solver, noise in (
            ("langevin", (0.0, 0.3, 0.0)), ("ifusion", None), ("id_pose", None), ("two_stage", (0.0, 0.3, 0.0)),
            ("two_stage", 0.0), ("gauss_newton", 0.0), ("features", None))}),
    ],
)  # fmt: skip
def test_an_experiment_is_the_sweep_of_a_table(lp, jobs, tmp_path, experiment, narrowed, varies):
    for name in ("score", "energy"):
        (tmp_path / "runs" / name).mkdir(parents=True)
    ran = lp("eval", f"experiment={experiment}", "seed=5", *narrowed)  # the command line wins over the experiment
    assert ran.status == 0, ran.err
    keys = {
        "gamma": lambda c: (c.solver.name, c.solver.gamma),
        "starts": lambda c: (c.solver.name, plain_noise(c.solver.get("gamma")), c.start.count),
        "priors": lambda c: (c.solver.name, c.prior.name),
        "score_energy": lambda c: (c.solver.name, c.checkpoint),
        "stages": lambda c: (c.solver.first_stage, c.solver.second_stage, c.views),
        "methods": lambda c: (c.solver.name, plain_noise(c.solver.get("gamma")), c.start.name),
    }[experiment]
    assert len(jobs) == len(varies) and {keys(config) for config, _, _ in jobs} == varies
    assert {config.seed for config, _, _ in jobs} == {5} and {config.data.name for config, _, _ in jobs} == {"toy"}
    folders = {folder for _, folder, _ in jobs}
    assert len(folders) == len(varies)
    assert all(tmp_path / "runs" / "multirun" / "eval" / experiment in Path(folder).parents for folder in folders)


def test_every_table_of_the_paper_has_its_experiment_over_three_seeds():
    for experiment in (name for table in paper_tables() for name in table.experiments):
        file = ROOT / "conf" / "experiment" / f"{experiment}.yaml"
        params = yaml.safe_load(file.read_text())["hydra"]["sweeper"]["params"]
        assert params["seed"] == "0,1,2"


def test_an_experiment_is_one_run_where_asked(lp, jobs, tmp_path):
    assert lp("eval", "experiment=gamma", "hydra.mode=RUN", "hydra.run.dir=one").status == 0
    ((config, folder, _),) = jobs
    assert config.solver.name == "two_stage" and folder == str(tmp_path / "one")


def test_a_job_restarts_itself_and_not_the_sweep(lp, jobs, monkeypatch):
    assert lp("eval", "experiment=gamma", "seed=0").status == 0
    again = jobs[2][2]
    assert "hydra.mode=RUN" in again and "solver.gamma=0.3" in again
    jobs.clear()
    assert lp(*again[1:], "hydra.run.dir=again").status == 0
    assert [config.solver.gamma for config, _, _ in jobs] == [0.3]


# ---------------------------------------------------------------- continuing


@pytest.fixture(scope="module")
def commands(tmp_path_factory, trained) -> Commands:
    """A working folder with a trained model in `score`."""
    return Commands(tmp_path_factory.mktemp("sweeps"), train_views=3, test_views=2, trained=trained)


@pytest.fixture
def sweep(commands):
    """`sweep("seed=0,1")` in a folder that is new for every test; no pictures, which take most of a run's time."""
    number = sum(each.name.startswith("sweep") for each in commands.folder.iterdir())

    def run(*overrides: str) -> Ran:
        views_fingerprint.cache_clear()  # as in a process of its own
        return commands.here("unused", "eval", *SWEEP, f"hydra.sweep.dir=sweep{number}", *overrides)

    run.folder = commands.folder / f"sweep{number}"
    return run


def result(folder: Path) -> dict:
    return json.loads((folder / "results.json").read_text())


def test_a_sweep_resumes_with_the_unfinished_jobs(sweep):
    assert sweep("seed=0,1,2").status == 0
    whole = {number: result(sweep.folder / number) for number in "012"}
    when = {number: (sweep.folder / number / "results.json").stat().st_mtime_ns for number in "02"}
    (sweep.folder / "1" / "results.json").unlink()
    (sweep.folder / "2" / "results.json").write_text("")  # what a power cut may leave
    again = sweep("seed=0,1,2")
    assert again.status == 0
    skipped = [line for line in again.out.splitlines() if line.startswith("skipped (already finished): ")]
    assert skipped == [f"skipped (already finished): {sweep.folder.name}/0"]
    for number in "012":
        assert result(sweep.folder / number)["metrics"] == whole[number]["metrics"]
    assert (sweep.folder / "0" / "results.json").stat().st_mtime_ns == when["0"]


def test_a_sweep_that_is_started_twice_is_shared(sweep):
    (sweep.folder / "1").mkdir(parents=True)
    with held(sweep.folder / "1"):  # by the other
        ran = sweep("seed=0,1,2")
    assert ran.status == 0, ran.err
    assert f"skipped (in use by another command): {sweep.folder.name}/1" in ran.out.splitlines()
    assert [(sweep.folder / number / "results.json").is_file() for number in "012"] == [True, False, True]
    again = sweep("seed=0,1,2")
    assert again.out.count("skipped (already finished): ") == 2 and (sweep.folder / "1" / "results.json").is_file()


def test_the_views_of_finished_jobs_are_checked_once(sweep, monkeypatch):
    assert sweep("seed=0,1,2").status == 0
    fingerprint, looked = PairDataModule.fingerprint, []
    monkeypatch.setattr(PairDataModule, "fingerprint", lambda *of: looked.append(of) or fingerprint(*of))
    assert sweep("seed=0,1,2").out.count("skipped (already finished): ") == 3 and len(looked) == 1


def test_results_of_another_configuration_are_kept_and_reported(sweep):
    assert sweep("solver.gamma=0,0.1").status == 0
    before = (sweep.folder / "1" / "results.json").read_bytes()
    again = sweep("solver.gamma=0,0.3,0.5")
    assert again.status == 1
    assert (
        f"{sweep.folder.name}/1: contains other results (solver.gamma was 0.1, is 0.3); "
        "choose another hydra.sweep.dir or remove it"
    ) in again.err
    assert (sweep.folder / "1" / "results.json").read_bytes() == before
    assert result(sweep.folder / "2")["config"]["solver"]["gamma"] == 0.5


def test_another_seed_or_another_model_is_another_configuration(sweep, commands):
    assert sweep("seed=3").status == 0
    assert "seed was 3, is 4" in sweep("seed=4").err
    os.makedirs(commands.folder / "copy", exist_ok=True)
    copy = commands.folder / "copy" / "best.ckpt"
    copy.write_bytes((commands.folder / "score" / "checkpoints" / "best.ckpt").read_bytes())
    assert "checkpoint was score/checkpoints/best.ckpt, is copy/best.ckpt" in sweep("seed=3", "checkpoint=copy").err


def test_a_model_that_was_trained_again_is_another_model(sweep, commands):
    assert sweep("seed=0").status == 0
    checkpoint = commands.folder / "score" / "checkpoints" / "best.ckpt"
    kept = checkpoint.stat()
    os.utime(checkpoint, (time.time() + 60, time.time() + 60))
    try:
        assert "contains other results (score/checkpoints/best.ckpt is newer)" in sweep("seed=0").err
    finally:
        os.utime(checkpoint, (kept.st_atime, kept.st_mtime))
    assert "skipped" in sweep("seed=0").out


def test_results_of_other_views_are_not_reused(sweep, commands):
    assert sweep("seed=0").status == 0
    image = commands.folder / "views" / "cup" / "test" / "rgb" / "000.png"
    kept = image.read_bytes()
    image.write_bytes((image.parent / "001.png").read_bytes())
    try:
        assert f"{sweep.folder.name}/0: contains other results (different views); choose another" in sweep("seed=0").err
    finally:
        image.write_bytes(kept)
    assert "skipped" in sweep("seed=0").out


def test_a_single_run_is_repeated(commands):
    for _ in range(2):
        ran = commands.here("single", "eval", "checkpoint=./score", "solver.iterations=2")
        assert ran.status == 0 and "skipped" not in ran.out


def test_an_experiment_resumes_in_its_own_folder(commands):
    first = ("experiment=gamma", "solver=langevin", "checkpoint=./score", "seed=0", "solver.gamma=0,0.3")
    assert commands.here("unused", "eval", *first).status == 0
    more = commands.here("unused", "eval", *first[:-2], "seed=0,1", "solver.gamma=0,0.3")
    assert more.status == 0 and more.out.count("skipped (already finished): ") == 2
    below = commands.folder / "runs" / "multirun" / "eval" / "gamma"
    assert len(list(below.rglob("results.json"))) == 4


# ---------------------------------------------------------------- launchers


@pytest.fixture
def elsewhere(commands, monkeypatch) -> str:
    """A plugin of a solver, as an argument; and a Slurm that runs its jobs here."""
    if not (commands.folder / "slurm").exists():
        slurm_stand_in.install(commands.folder / "slurm")
        (commands.folder / "elsewhere").mkdir()
        (commands.folder / "elsewhere" / "tmp_tiny_quick.py").write_text(QUICK)
    monkeypatch.setenv("PATH", f"{commands.folder / 'slurm'}{os.pathsep}{os.environ['PATH']}")
    return "plugins=[elsewhere]"


@pytest.mark.parametrize(
    ("package", "launcher"),
    [
        ("joblib", ("hydra/launcher=side_by_side",)),
        ("submitit", ("hydra/launcher=slurm", "hydra.launcher.gpus_per_node=null")),
        ("ray", ("hydra/launcher=ray_cluster", "hydra.launcher.ray.remote.num_cpus=1")),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_jobs_in_other_processes_know_plugins_and_configs_and_are_not_done_twice(
    commands, elsewhere, package, launcher
):
    pytest.importorskip(f"hydra_plugins.hydra_{package}_launcher", reason="the launchers are in extras, sweeps and ray")
    sweep = ("experiment=gamma", f"hydra.sweep.dir={package}", elsewhere, "solver=tmp_tiny_quick",
             "checkpoint=./score", "seed=0")  # fmt: skip
    gammas = "0,-1,0.3" if package == "joblib" else "0,0.3"  # a job that fails does not stop the others
    run = commands.process if package == "joblib" else commands.here  # what joblib's workers print is not caught here
    ran = run("unused", "eval", *sweep, f"solver.gamma={gammas}", *launcher)
    if package == "joblib":
        assert ran.status == 1 and "job 1 (" in ran.err and "gamma must" in ran.err and "Traceback" not in ran.err
    else:
        assert ran.status == 0, ran.err
    folders = sorted(file.parent for file in (commands.folder / package).rglob("results.json"))
    assert tuple(result(folder)["config"]["solver"]["gamma"] for folder in folders) == (0, 0.3)
    again = commands.here("unused", "eval", *sweep, "solver.gamma=0,0.3")  # in this process, but the same sweep
    assert again.status == 0 and again.out.count("skipped (already finished): ") == 2


def test_slurm_settings(tmp_path, monkeypatch):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher", reason="the launchers are in the extra sweeps")
    from submitit.slurm.slurm import SlurmExecutor

    monkeypatch.setenv("PATH", str(slurm_stand_in.install(tmp_path / "slurm")))
    config = yaml.safe_load((ROOT / "conf" / "hydra" / "launcher" / "slurm.yaml").read_text())
    names = SlurmExecutor._equivalence_dict()
    script = SlurmExecutor("folder")
    script.update_parameters(
        **{
            names.get(key, key): f"{value}GB" if key == "mem_gb" else value
            for key, value in config.items()
            if key not in ("defaults", "max_num_timeout", "partition")
        }
    )
    asked = script._make_submission_file_text("command", "uid")
    for line in ("--gpus-per-node=1", "--cpus-per-task=4", "--mem=24GB", "--time=240"):
        assert f"#SBATCH {line}\n" in asked


@pytest.mark.parametrize(("launcher", "extra"), [("joblib", "sweeps"), ("slurm", "sweeps"), ("ray_cluster", "ray")])
def test_a_launcher_that_is_not_installed(lp, monkeypatch, launcher, extra):
    from hydra.core.config_store import ConfigStore
    from hydra.core.plugins import Plugins

    Plugins.instance()  # the launchers put their configs there
    monkeypatch.setitem(ConfigStore.instance().repo["hydra"], "launcher", {})
    ran = lp("eval", f"hydra/launcher={launcher}", "--cfg", "job")
    name = {"slurm": "submitit_slurm", "ray_cluster": "ray"}.get(launcher, launcher)
    assert ran.error.startswith(f"hydra/launcher={name}: there is no hydra/launcher '{name}'")
    assert ran.error.endswith(f"; for more: pip install 'lp_framework[{extra}]'")


# A solver of a plugin.
QUICK = '''
from lp_framework.errors import UserError
from lp_framework.models.pose_model import PoseModel
from lp_framework.registry import register
from lp_framework.solvers.langevin import Langevin


@register("solver", "tmp_tiny_quick")
class Quick(Langevin):
    """Two steps of langevin."""

    def __init__(self, model: PoseModel, gamma: float = 0.0) -> None:
        if gamma < 0:
            raise UserError("gamma must not be negative")
        super().__init__(model, gamma=gamma, iterations=2)
'''
