"""Solvers and commands give the same numbers on a mock GPU as on the CPU. Run by `test_mock_device.py`."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hydra.core.plugins import Plugins
from lightning import Trainer
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.strategies import SingleDeviceStrategy
from mock_device import MOCK, MockTensor, Syncs, mock_device
from PIL import Image
from solver_problems import around, exact_pairs, exact_sets
from test_bench import FEW
from test_figures import SMALL
from test_solver_contract import SOLVERS, build
from tiny_runs import Commands, undrawn

from lp_framework import api, load_prior, registry
from lp_framework.benchmarks.zero123 import NARROW, random_pair
from lp_framework.commands.eval import save_pictures
from lp_framework.data.pairs import PairData
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.priors.base import Prior
from lp_framework.priors.zero123.networks import Networks
from lp_framework.priors.zero123.prior import Zero123Prior
from lp_framework.solvers.base import Solution, Solver
from lp_framework.solvers.pair_energy import PairEnergy

Plugins.instance()  # Hydra stores the configs of its own plugins once, as conftest.py has it
ON_HOST = ("dust3r", "features", "vggt")  # matching and third-party packages compute in NumPy or on their own
FORWARD_MODE = ("gauss_newton",)  # forward-mode AD does not support a device written in Python; see its own tests
FEW_STEPS = {"steps": 6, "iterations": 6, "refinement_steps": 6, "exploration_steps": 3}  # steps are slow there
PRIOR = ("model=prior", "model.latent_dim=6", "model.width=16", "model.layers=1", "data.image_size=64")


@pytest.fixture(autouse=True)
def device(request: pytest.FixtureRequest) -> Iterator[None]:
    """The mock device; without float64, like Apple's GPUs, in tests of commands. Figures are saved as empty files."""
    with undrawn(), mock_device(double="chosen" not in request.fixturenames):
        yield


def short(name: str) -> Solver:
    """A solver with few steps, on the CPU."""
    settings = inspect.signature(registry.get("solver", name)).parameters
    return build(name, **{key: count for key, count in FEW_STEPS.items() if key in settings})


def moved(batch: Any, device: torch.device = MOCK) -> Any:
    """Copy a dataclass of tensors to a device."""
    return type(batch)(*(value if value is None else value.to(device) for value in vars(batch).values()))


# ---------------------------------------------------------------- the mock device


def test_mixing_with_cpu_tensors_raises_and_syncs_are_counted():
    here, there = torch.ones(3), torch.ones(3, device=MOCK)
    assert there.device == MOCK and type(2 * there + there.sum() * torch.tensor(2.0)) is MockTensor
    with pytest.raises(RuntimeError, match="same device"):
        here + there
    for away in (there.numpy, lambda: np.asarray(there)):
        with pytest.raises(TypeError, match="numpy"):
            away()
    Syncs.count = 0
    assert there.sum().item() == 3 and there.cpu().tolist() == [1, 1, 1]
    torch.tensor([1.0], device=MOCK)
    here.to(MOCK)
    assert Syncs.count == 4


def test_float64_can_be_disabled():
    with mock_device(double=False):
        for make in (
            lambda: torch.ones(3, dtype=torch.float64, device=MOCK),
            lambda: torch.ones(3, dtype=torch.float64).to(MOCK),
            lambda: torch.ones(3, device=MOCK).double(),
            lambda: torch.ones(3, device=MOCK) * torch.ones((), dtype=torch.float64).to(MOCK),
        ):
            with pytest.raises(TypeError, match=r"has no torch\.float64"):
                make()
        assert torch.ones(3, dtype=torch.float64).to(MOCK, torch.float32).cpu().double().sum() == 3


# ---------------------------------------------------------------- priors


@pytest.mark.parametrize("name", ["tiny", "zero123"])
def test_a_priors_energy_matches_the_cpu_and_its_gradient_does_not_synchronize(name):
    prior: Prior = Zero123Prior(Networks(NARROW)) if name == "zero123" else load_prior("tiny")
    pair = random_pair(torch.device("cpu"))
    energies = []
    for device in (torch.device("cpu"), MOCK):
        energy = PairEnergy(prior.to(device), moved(pair, device), seed=0)
        poses = torch.tensor([[[0.1, 0.2, 0.0], [-0.2, 3.0, 0.1]]]).to(device).requires_grad_()
        Syncs.count = 0
        energies.append(energy(poses, 300, energy.noise(0)[:, 0]))
        (slope,) = torch.autograd.grad(energies[-1].sum(), poses)
        energies.append(slope)
        assert Syncs.count == 0
    for here, there in zip(energies[:2], energies[2:], strict=True):
        torch.testing.assert_close(there.cpu(), here, rtol=1e-3, atol=1e-6)


# ---------------------------------------------------------------- solvers


@pytest.mark.parametrize("name", [name for name in SOLVERS if name not in FORWARD_MODE])
def test_solvers_match_the_cpu(name):
    pairs, true = exact_pairs(3)
    starts = around(true, 0.3, -0.4, 1.0)
    here = short(name).solve(pairs, starts, seed=0)
    solver = short(name)
    api.move(solver, MOCK)
    there: Solution = solver.solve(moved(pairs), starts.to(MOCK), seed=0)
    for quantity in ("poses", "energies", "valid", "chosen"):
        assert isinstance(getattr(there, quantity), MockTensor), quantity
    torch.testing.assert_close(there.poses.cpu(), here.poses, rtol=0, atol=1e-3)
    assert torch.equal(there.chosen.cpu(), here.chosen)


@pytest.mark.parametrize("name", [name for name in SOLVERS if name not in FORWARD_MODE])
def test_solvers_of_image_sets_match_the_cpu(name):
    sets, _ = exact_sets(2, 3)
    starts = torch.rand(2, 2, 3, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.3, 6.0, 0.0])
    here = short(name).solve_views(sets, starts, seed=0)
    solver = short(name)
    api.move(solver, MOCK)
    there = solver.solve_views(moved(sets), starts.to(MOCK), seed=0)
    torch.testing.assert_close(there.poses.cpu(), here.poses, rtol=0, atol=1e-3)


@pytest.mark.parametrize("name", [name for name in SOLVERS if name not in FORWARD_MODE + ON_HOST])
def test_no_step_of_a_solver_synchronizes(name):
    """The number of synchronizations does not depend on the number of steps."""
    (pairs, true), solver = exact_pairs(2), registry.get("solver", name)
    starts = around(true, 0.3, -0.4).to(MOCK)
    counted = [
        key for key in ("iterations", "steps", "refinement_steps") if key in inspect.signature(solver).parameters
    ]
    assert counted
    syncs = []
    for steps in (4, 8):
        few = build(name, **dict.fromkeys(counted, steps))
        api.move(few, MOCK)
        Syncs.count = 0
        few.solve(moved(pairs), starts, seed=0)
        syncs.append(Syncs.count)
    assert syncs[0] == syncs[1]


# ---------------------------------------------------------------- commands


class MockAccelerator(CPUAccelerator):
    """Lightning's accelerator for the mock device."""

    def setup_device(self, device: torch.device) -> None:
        assert device == MOCK


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory) -> Commands:
    """Runs of a prior, a score model and an energy model trained for one epoch on the CPU."""
    commands = Commands(tmp_path_factory.mktemp("mock"), train_views=6, test_views=3)
    energy = ("model=energy", "data.image_size=64")
    for name, settings in (("prior", PRIOR), ("score", ("data.image_size=64",)), ("energy", energy)):
        trained = commands.here(name, "train", "trainer.max_epochs=1", *settings)
        assert trained.status == 0, trained.err
    return commands


@pytest.fixture
def chosen(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """A function that makes commands choose the mock device, as they would a GPU."""

    def choose() -> None:
        monkeypatch.setattr("lp_framework.commands.building.best_device", lambda: MOCK)
        strategy = SingleDeviceStrategy(device=MOCK, accelerator=MockAccelerator())
        trainer = functools.partial(Trainer, strategy=strategy)

        def on_device(**settings: Any) -> Trainer:
            return trainer(**{key: value for key, value in settings.items() if key != "strategy"})

        monkeypatch.setattr("lp_framework.commands.building.Trainer", on_device)

    return choose


EVALUATION = ("checkpoint=./score", "prior.path=prior", "data.image_size=64", "start=ring", "start.count=3")
SHORT = {
    "two_stage": ("solver=two_stage", "solver.iterations=3", "solver.refinement_steps=3"),
    "id_pose": ("solver=id_pose", "solver.exploration_steps=2", "solver.refinement_steps=2"),
    "multiview": ("solver=multiview", "views=3", "solver.refinement_steps=3"),
}


@pytest.mark.parametrize("solver", SHORT)
def test_eval_and_its_pictures(commands, chosen, solver, monkeypatch):
    here = commands.here(f"{solver}_here", "eval", *EVALUATION, *SHORT[solver])
    assert here.status == 0, here.err
    chosen()
    gathered_on, drawn_on = [], []

    def save(folder: Path, evaluation: Evaluation, data: PairData, result: dict[str, Any]) -> list[Path]:
        gathered_on.extend(each.device for each in (*evaluation.metrics.pair, *evaluation.metrics.cost))
        drawn_on.append(next(evaluation.parameters()).device)
        return save_pictures(folder, evaluation, data, result)

    monkeypatch.setattr("lp_framework.commands.eval.save_pictures", save)
    monkeypatch.setattr("lp_framework.analysis.examples.MOST", 2)
    there = commands.here(f"{solver}_there", "eval", *EVALUATION, *SHORT[solver], "pictures=true")
    assert there.status == 0, there.err
    assert there.json()["metrics"] == pytest.approx(here.json()["metrics"], abs=1e-3)
    assert {*gathered_on} == {torch.device("cpu")}  # it is float64
    assert drawn_on == [MOCK]


@pytest.mark.parametrize(("name", "settings"), [("score", ("data.image_size=64",)), ("prior", PRIOR)])
def test_training_gives_the_same_weights(commands, chosen, name, settings):
    chosen()
    there = commands.here(f"{name}_there", "train", "trainer.max_epochs=1", *settings)
    assert there.status == 0, there.err
    here = torch.load(commands.folder / name / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
    for key, value in there.checkpoint()["state_dict"].items():
        torch.testing.assert_close(value, here[key], rtol=1e-3, atol=1e-4, msg=lambda text, key=key: f"{key}: {text}")


def test_landscapes(commands, chosen):
    grid = ("longitude_step_degrees=60", "latitude_step_degrees=30", "noises=1", "timesteps=[500]")
    settings = (*grid, "checkpoint=./score", "prior.path=prior", "data.image_size=64")
    found = []
    for place in ("here", "there"):
        pair = commands.here(f"pair_{place}", "landscape", "object=cup", "query=1", "solver.steps=3", *settings)
        every = commands.here(f"every_{place}", "landscape", *settings)
        assert (pair.err, every.err) == ("", "")
        found.append(np.load(pair.folder / "landscape.npz"))
        chosen()
    for key, value in found[0].items():
        np.testing.assert_allclose(found[1][key], value, rtol=1e-3, atol=1e-3)


def test_estimate_and_views(commands, chosen):
    files = sorted((commands.folder / "views" / "cup" / "test" / "rgb").glob("*.png"))[:2]
    found = []
    for place in ("here", "there"):
        settings = ("prior.path=prior", "crop=false")
        images = (f"images=[{files[0]},{files[1]}]", "checkpoint=./score", "solver.refinement_steps=3")
        chosen_solver = ("solver=two_stage", "start=grid")
        estimated = commands.here(f"estimate_{place}", "estimate", *images, *settings, *chosen_solver)
        views = commands.here(f"views_{place}", "views", f"image={files[0]}", "longitudes=2", "steps=3", *settings)
        assert (estimated.status, views.status) == (0, 0), (estimated.err, views.err)
        drawn = sorted((views.folder / "views").glob("*.png"))
        found.append(np.stack([np.asarray(Image.open(file), float) for file in drawn]))
        chosen()
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1)


AS_SMALL = {"cameras": ("figure.objects=[cup]", "figure.targets=1", "figure.starts=1", "figure.methods=[langevin]")}


@pytest.mark.parametrize("name", [name for name in SMALL if name != "recall"])  # which solves nothing
def test_figures(commands, chosen, name):
    chosen()
    drawn = commands.here(
        f"figure_{name}",
        "figure",
        f"experiment=figure_{name}",
        "prior.path=prior",
        "data.image_size=64",
        *SMALL[name],
        *AS_SMALL.get(name, ()),
    )
    assert drawn.status == 0, drawn.err


@pytest.mark.parametrize("measure", ["first_stage", "second_stage", "pair"])
def test_bench(tmp_path, chosen, measure):
    chosen()
    narrow = {"second_stage.architecture": "narrow", "second_stage.starts": "[1]", "second_stage.rounds": "1"}
    settings = {**FEW, **narrow}
    small = (f"{key}={value}" for key, value in settings.items())
    ran = Commands(tmp_path, train_views=6).here("bench", "bench", f"measure=[{measure}]", *small)
    assert ran.status == 0, ran.err
