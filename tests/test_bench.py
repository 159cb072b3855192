"""`bench`: the contenders do the stated work, and measurements are saved."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
import torch
import trimesh
from exact_prior import ExactPrior
from solver_problems import ExactModel, around, exact_pairs
from tiny_runs import Commands
from view_folders import write_objects

from lp_framework import registry
from lp_framework.benchmarks import batches, harness, rendering, zero123
from lp_framework.benchmarks.batches import training_loss
from lp_framework.benchmarks.harness import Section, peak_bytes
from lp_framework.benchmarks.stages import all_pairs, plain_loop, probe_energies, some_pairs
from lp_framework.benchmarks.zero123 import (
    TIMESTEP,
    Computing,
    PlainLoop,
    batched,
    encoded,
    plain_prior,
    variant,
)
from lp_framework.commands.bench import MEASUREMENTS, paper_seconds, table
from lp_framework.data.module import PairDataModule
from lp_framework.data.rendering.raycast import RaycastRenderer
from lp_framework.data.views import RenderingsData
from lp_framework.errors import UserError
from lp_framework.geometry import wrap_angle
from lp_framework.models.checkpoints import SHIPPED, load_model
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.langevin import Langevin
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.twist import IFusion
from lp_framework.solvers.two_stage import GaussNewton, TwoStage

CPU = torch.device("cpu")

NARROW = {
    "measure": "[second_stage]", "second_stage.architecture": "narrow", "second_stage.starts": "[1,2]",
    "second_stage.rounds": "1",
}  # fmt: skip
FEW = {
    "backbone.image_size": "32", "data.batch_pairs": "36", "data.block": "3", "data.validation_views": "0",
    "loader.rounds": "1", "loader.steps": "1", "encoding.rounds": "1",
    "first_stage.views": "2", "first_stage.starts": "1", "first_stage.rounds": "1",
    "pair.starts": "[1]", "pair.steps": "1",
    "precision.architecture": "narrow", "precision.starts": "1", "precision.rounds": "1",
    "adam_gauss_newton.pairs": "2", "adam_gauss_newton.starts": "1",
    "adam_gauss_newton.newton_steps": "2", "adam_gauss_newton.adam_steps": "3",
    "renderer": "raycast", "rendering.views": "2", "rendering.resolution": "8", "rendering.rounds": "1",
}  # fmt: skip


def section():
    return Section(CPU, "a", ("new", "old"))


@pytest.fixture(scope="module")
def networks():
    torch.manual_seed(0)
    return Computing("narrow").networks(CPU)


@pytest.fixture(scope="module")
def priors(networks):
    return Computing("narrow").prior(networks), plain_prior(networks)


@pytest.fixture(scope="module")
def images():
    return torch.rand(2, 3, 256, 256, generator=torch.Generator().manual_seed(0)) * 2 - 1


@pytest.fixture(scope="module")
def pairs(images):
    return Pairs(images, torch.tensor([0]), torch.tensor([1]), torch.tensor([7]))


class Passes:
    """Images and samples that have gone through the networks of a prior."""

    def __init__(self, prior) -> None:
        self.counts = {"vae": [], "clip": [], "unet": []}
        modules = {"vae": prior.vae.encoder, "clip": prior.image_encoder.vision_model, "unet": prior.unet.conv_in}
        self.hooks = [module.register_forward_hook(self.count(name)) for name, module in modules.items()]

    def count(self, name):
        def hook(module, arguments, output):
            batch = output[0] if name == "clip" else output
            self.counts[name].append(len(batch))

        return hook

    def __enter__(self):
        return self.counts

    def __exit__(self, *_):
        for hook in self.hooks:
            hook.remove()


# ---------------------------------------------------------------- the second stage's contenders


def test_both_contenders_descend_the_same_energy(priors, images, pairs):
    batch_prior, loop_prior = priors
    noise = torch.randn(2, *batch_prior.latent_shape, generator=torch.Generator().manual_seed(1))
    pose = torch.tensor([0.2, 1.3, -0.1], requires_grad=True)
    energy = PairEnergy(batch_prior, pairs, seed=0)(pose[None, None], TIMESTEP, noise[None]).squeeze()
    loss = PlainLoop(loop_prior, images, torch.zeros(3)).loss(pose, noise)
    torch.testing.assert_close(loss, energy, rtol=1e-5, atol=0)
    slopes = [torch.autograd.grad(each, pose)[0] for each in (loss, energy)]
    assert slopes[0].abs().max() > 0
    torch.testing.assert_close(slopes[0], slopes[1], rtol=0, atol=1e-4 * slopes[0].abs().max().item())


def test_a_batched_step_encodes_no_image_and_calls_the_network_once(priors, pairs):
    ready = encoded(priors[0], priors[0].encode(pairs.images))
    starts = Ring(3).make(pairs, seed=0)
    with Passes(priors[0]) as counts:
        assert batched(ready, pairs, starts, 1)() == 1
    assert counts == {"vae": [], "clip": [], "unet": [6]}  # three starts in two directions
    moved = IFusion(ready, 1).solve(pairs, starts, seed=0).poses
    assert ((moved - starts).abs().amax(dim=-1) > 0).all()


def test_a_step_of_the_plain_loop_encodes_every_image_again(priors, images):
    _, loop_prior = priors
    loop = PlainLoop(loop_prior, images, torch.tensor([0.0, torch.pi / 2, 0.0]))
    torch.testing.assert_close(loop.poses(loop.twist).detach(), torch.tensor([0.0, torch.pi / 2, 0.0]))
    with Passes(loop_prior) as counts:
        loop.step()
        loop.step()
    assert counts == {"vae": [2, 2] * 2, "clip": [2] * 2, "unet": [2] * 2}
    assert loop.twist.abs().max() > 0 and loop.total > 0


def test_the_contenders_share_memory_only_where_nothing_is_converted(networks):
    for dtype, shared in (("float32", True), ("bfloat16", False)):
        batch_prior, loop_prior = Computing("narrow", dtype).prior(networks), plain_prior(networks)
        one, other = batch_prior.unet.conv_in.weight, loop_prior.unet.conv_in.weight
        assert (one.data_ptr() == other.data_ptr()) is shared
        assert other.dtype == torch.float32 and not one.requires_grad and not other.requires_grad
        torch.testing.assert_close(one.float(), other, rtol=1e-2, atol=0)
        assert networks.unet.dtype == torch.float32 and batch_prior.cc_projection.weight.dtype == torch.float32


# ---------------------------------------------------------------- the measurement


@pytest.fixture
def steps(monkeypatch):
    """Records the work of the contenders instead of doing it."""
    done = []

    def longitude(loop):
        return round(torch.rad2deg(loop.poses(loop.twist)[1]).item())

    def solve(solver, pairs, starts, seed):
        done.append(f"{solver.steps} of {starts.shape[1]}")

    monkeypatch.setattr(IFusion, "solve", solve)
    monkeypatch.setattr(PlainLoop, "step", lambda self: done.append(f"at {longitude(self)}"))
    return done


def test_rounds_alternate_and_the_loop_takes_its_starts_in_turn(steps):
    zero123.measure_step(section(), Computing("narrow"), [1, 2], rounds=2, steps=2)
    warm_up = ["1 of 1", "1 of 2", "at 0"]
    assert steps == [*warm_up, *["2 of 1", *["at 0"] * 2, "2 of 2", *["at 0"] * 2, *["at 180"] * 2] * 2]


def test_seconds_are_those_of_one_step_of_all_starts(steps, monkeypatch):
    monkeypatch.setattr(harness, "timed", lambda work, device: (12.0, work()))
    measured = section()
    zero123.measure_step(measured, Computing("narrow"), [1, 2], rounds=1, steps=4)
    assert measured.medians() == {"1 start, seconds per step": (3, 3), "2 starts, seconds per step": (3, 3)}


# ---------------------------------------------------------------- the loaders


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("loaders")
    write_objects(folder / "views", train=6)
    return PairDataModule(RenderingsData(str(folder / "views")), str(folder / "cache"), 16, 36, 3, 0)


@pytest.fixture(scope="module")
def views(data):
    return data.data("train")


def test_a_plain_batch_has_two_images_a_pair(data, views):
    batch = next(batches.plain_pairs(data))
    assert len(batch) == data.batch_pairs and len(batch.images) == 2 * len(batch)
    for row, pair in enumerate(batch.pairs.tolist()):
        alone = views[np.array([pair])]
        for side in ("reference", "query"):
            mine, its = (each.images[getattr(each, side)[number]] for each, number in ((batch, row), (alone, 0)))
            assert torch.equal(mine, its)


def test_a_batch_in_feature_space_has_fewer_images_than_pairs(data):
    batch = next(batches.feature_space(data))
    assert len(batch.images) < len(batch)


# ---------------------------------------------------------------- what the other measurements share


def test_contenders_take_turns_after_a_warm_up(monkeypatch):
    done, seconds = [], iter([2.0, 2, 2, 4, 2, 2, 2, 2])
    monkeypatch.setattr(harness, "timed", lambda work, device: (next(seconds), work()))

    def work(name, amount):
        return harness.work_of(amount, lambda: done.append(name))

    race = section()
    race.race({"a second": (work("a", 8), work("b", 4))}, 2, rate=True)
    race.race({"seconds": (work("c", 1), work("d", 2))}, 2)
    assert done == [*"ab"] * 3 + [*"cd"] * 3
    assert [*race.medians().values()] == [(4, 1.5), (2, 1)]
    record = race.record()
    assert record["a second"]["old"] == {"median": 1.5, "min": 1, "max": 2, "rounds": [2, 1]}
    assert record["a second"]["ratio"] == pytest.approx(8 / 3) and record["seconds"]["ratio"] == 2


class Allocator:
    """A mock of the GPU allocator's statistics in `torch.cuda`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = self.most = 1000
        answers = {
            "synchronize": lambda device: None,
            "reset_peak_memory_stats": lambda device: setattr(self, "most", self.now),
            "memory_allocated": lambda device: self.now, "max_memory_allocated": lambda device: self.most,
        }  # fmt: skip
        for name, answer in answers.items():
            monkeypatch.setattr(torch.cuda, name, answer)

    def step(self) -> None:
        """Work that takes 30 bytes for a while."""
        self.most = max(self.most, self.now + 30)


def test_gpu_memory_is_that_of_the_allocator(monkeypatch):
    allocator, gpu = Allocator(monkeypatch), torch.device("cuda")
    allocator.most = 5000  # of what was before
    assert peak_bytes(allocator.step, torch.nn.Linear(3, 2), gpu) == 30 + 4 * (6 + 2)


# ---------------------------------------------------------------- encoding and the first stage


@pytest.fixture(scope="module")
def pose_model():
    torch.manual_seed(0)
    backbone = registry.build("backbone", {"name": "resnet", "arch": "resnet18", "pretrained": False, "image_size": 32})
    return registry.build("model", {"name": "score", "hidden": 16}, backbone=backbone).eval()


def test_training_on_cached_features_equals_training_on_the_images(views, pose_model):
    pairs = views.table.pairs("ordered")[::5]
    once = views[pairs]
    batches = [views[pair[None]] for pair in pairs]
    losses = []
    for batch in (once, *batches):
        with torch.no_grad():
            features = pose_model.backbone.trunk(batch.images)
        features = pose_model.backbone.head(features)
        losses.append(training_loss(pose_model, batch, features))
        torch.testing.assert_close(losses[-1], training_loss(pose_model, batch))
    whole, apart = losses[0], torch.stack(losses[1:]).mean()
    torch.testing.assert_close(whole, apart)
    parameters = [*pose_model.network.parameters()]
    for one, other in zip(*(torch.autograd.grad(each, parameters) for each in (whole, apart)), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    assert len(once.images) < 2 * len(pairs)


def test_the_plain_loop_of_the_first_stage_matches_the_batch(pose_model):
    solver = Langevin(pose_model, gamma=0.0, iterations=5)
    pairs = all_pairs(32, 3, CPU)
    assert len(pairs) == 6 and len(pairs.images) == 3
    starts = Ring(2).make(pairs, seed=0)
    batched = solver.solve(pairs, starts, seed=0).poses
    loop = plain_loop(solver, pairs, starts)
    loop[..., 1] = wrap_angle(loop[..., 1]) % (2 * torch.pi)
    torch.testing.assert_close(loop, batched, rtol=1e-4, atol=1e-4)


# ---------------------------------------------------------------- Adam and Gauss-Newton


def test_a_prior_with_precomputed_codes_has_the_same_energy_and_gradient():
    pairs, true = exact_pairs(3)
    prior = ExactPrior([0.0, 2.0], [0.0, 0.3], noisy=0.3)
    found = []
    for each in (prior, encoded(prior, prior.encode(pairs.images))):
        energy = PairEnergy(each, pairs, seed=0)
        assert len(energy.codes) == len(pairs.images)
        poses = around(true, 0.3, -0.4).requires_grad_()
        values = energy(poses, 100, energy.noise(0)[:, 0])
        found.append((values.detach(), torch.autograd.grad(values.sum(), poses)[0]))
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)


def test_a_descent_is_evaluated_on_separate_probe_noise():
    pairs, true = exact_pairs(3)
    starts, prior = around(true, 0.3, -0.4), ExactPrior()
    newton = GaussNewton(ExactModel(), prior, refinement_steps=4, trajectory=True)
    energies, passes = probe_energies(prior, pairs, newton.refine(pairs, starts, seed=0), extra_steps=1)
    energy = PairEnergy(prior, pairs, seed=0)  # this prior's energy does not depend on the noise
    expected = energy(starts, 100, energy.noise(0)[:, 0]).mean().item()
    assert energies[0] == pytest.approx(expected) and len(energies) == len(passes) == 5
    assert passes == pytest.approx([8, 16, 24, 32, 40])  # two directions, plainly and along three numbers
    adam = TwoStage(ExactModel(), prior, refinement_steps=4, trajectory=True).second
    _, passes = probe_energies(prior, pairs, adam.solve(pairs, starts, seed=0), extra_steps=0)
    assert passes == pytest.approx([0, 2, 4, 6, 8])


def test_pairs_are_spread_over_the_objects(views):
    pairs = some_pairs(views, 6, CPU)
    assert len(pairs) == 6 and len(pairs.ids.unique()) == 6
    assert len(some_pairs(views, 10**6, CPU)) == len(views.table.pairs("ordered"))


# ---------------------------------------------------------------- rendering


def coloured_box():
    box = trimesh.creation.box()
    box.visual.vertex_colors = [200, 100, 50, 255]
    return box


def test_reloading_the_mesh_gives_the_same_views(tmp_path):
    coloured_box().export(tmp_path / "box.glb")
    cameras = rendering.around(3)
    one, other = (
        draw(RaycastRenderer(), tmp_path / "box.glb", cameras, 8)
        for draw in (rendering.drawn, rendering.drawn_one_by_one)
    )
    assert one.shape == (3, 8, 8, 4) and one[..., 3].any() and np.array_equal(one, other)


# ---------------------------------------------------------------- a pair


def test_a_pair_is_encoded_once_when_batched_and_at_every_step_of_the_loop(priors, monkeypatch):
    monkeypatch.setattr(Computing, "networks", lambda computing, device: None)
    monkeypatch.setattr(Computing, "prior", lambda computing, networks: priors[0])
    monkeypatch.setattr(zero123, "plain_prior", lambda networks: priors[1])
    with Passes(priors[0]) as batched, Passes(priors[1]) as loop:
        model = load_model(SHIPPED / "score")
        measured = section()
        zero123.measure_pair(measured, Computing("narrow"), model, paper_seconds(), [2], steps=2, rounds=1)
    assert batched == {"vae": [2] * 2, "clip": [2] * 2, "unet": [4] * 2 * 2}  # the first pair, and one more
    steps = 1 + 2 * 2  # to warm up, and of either start
    assert loop == {"vae": [2] * 2 * steps, "clip": [2] * steps, "unet": [2] * steps}
    assert [*measured.rows] == ["2 starts, seconds per pair"] and "on an RTX 6000 Ada" in measured.note
    assert "12.86 s from 2" in measured.note


# ---------------------------------------------------------------- precision


@pytest.mark.parametrize(
    ("words", "settings"),
    [
        ("bfloat16", {"dtype": "bfloat16"}),
        ("channels_last", {"channels_last": True}),
        ("compile float16 channels_last", {"dtype": "float16", "compile": True, "channels_last": True}),
        ("cuda_graph bfloat16", {"dtype": "bfloat16", "cuda_graph": True}),
    ],
)
def test_variants_by_name(words, settings):
    assert variant(words, "narrow", 3) == Computing("narrow", max_batch=3, **settings)


@pytest.mark.parametrize("words", ["", "bfloat8", "bfloat16 float16"])
def test_invalid_variants(words):
    with pytest.raises(UserError, match=f"precision.variants: '{words}' is not one; give one or more of float32, bfl"):
        variant(words, "narrow", None)


def test_layout_keeps_the_gradient_and_reduced_precision_nearly():
    variants = ["channels_last", "bfloat16"]
    measured = section()
    zero123.measure_precision(measured, "narrow", variants, starts=2, rounds=1, steps=1, max_batch=None)
    off = {words: facts["gradient_deviation"] for words, facts in measured.facts.items()}
    assert list(off) == variants and off["channels_last"] < 1e-4 and 0 < off["bfloat16"] < 0.2
    assert [*measured.rows] == [f"{words}: seconds per step" for words in off]


# ---------------------------------------------------------------- the command


def overrides(**changed):
    return [f"{key}={value}" for key, value in {**NARROW, **changed}.items()]


def test_an_interrupted_run_keeps_its_results(lp, tmp_path, monkeypatch):
    solve, twos = IFusion.solve, []

    def stopped(self, pairs, starts, seed):
        if starts.shape[1] == 2:
            twos.append(starts)
            if len(twos) == 2:  # after the warm-up
                raise KeyboardInterrupt
        return solve(self, pairs, starts, seed)

    monkeypatch.setattr(IFusion, "solve", stopped)
    ran = lp("bench", *overrides(), "hydra.run.dir=run")
    assert ran.status == 130 and "1 start, seconds per step" in ran.out and "2 starts" not in ran.out
    kept = json.loads((tmp_path / "run" / "bench.json").read_text())["second_stage"]
    assert "2 starts, seconds per step" not in kept and kept["1 start, seconds per step"]["ratio"]


def test_every_measurement_is_in_the_table_and_in_the_file(tmp_path):
    commands = Commands(tmp_path, train_views=6)
    everything = f"measure=[{','.join(MEASUREMENTS)}]"
    ran = commands.here("all", "bench", *overrides(), everything, *(f"{key}={value}" for key, value in FEW.items()))
    assert ran.status == 0, ran.err
    kept = ran.json("bench.json")
    assert list(kept) == [*MEASUREMENTS, "device", "threads", "config", "versions"]
    for row in ("pairs per second", "memory for backward, kB a pair"):
        one, other = (kept["loader"][row][name]["median"] for name in ("pairs in feature space", "plain pair loader"))
        assert kept["loader"][row]["ratio"] == pytest.approx(one / other)
    assert kept["loader"]["memory for backward, kB a pair"]["ratio"] < 1
    assert ran.out.index("pairs per second") < ran.out.index("1 start, seconds per step")
    assert "loader: images of 32 px, 36 pairs per batch" in ran.out
    labels = {name: list(kept[name]) for name in MEASUREMENTS}
    steps = [f"{count}, seconds per step" for count in ("1 start", "2 starts")]
    assert labels["second_stage"] == [*steps, "encoding_seconds"]
    assert "2 starts, seconds per step" in ran.out and "bench.json" in ran.out
    assert labels["encoding"] == [
        f"pairs per second, {what}" for what in ("backbone", "prior", "training on a frozen backbone")
    ]
    assert labels["first_stage"] == ["1 pair, starts per second", "2 pairs of 2 images, starts per second"]
    assert labels["rendering"] == ["raycast, views per second"]
    assert labels["pair"] == ["1 start, seconds per pair", "first_pair_seconds"]
    for gamma in ("gamma 0", "gamma 0.3"):
        facts = kept["adam_gauss_newton"][gamma]
        assert facts["energy"]["equal"] <= facts["energy"]["start"] and len(facts["energies"]["Adam"]) == 4
        passes = kept["adam_gauss_newton"][f"{gamma} before, to equal energy: passes per start"]
        assert passes["Gauss-Newton"]["median"] == 8 * (facts["steps"]["Gauss-Newton"] + 1)
        assert passes["Adam"]["median"] == 2 * facts["steps"]["Adam"]


def test_the_table_gives_ratios_of_the_first_to_the_second():
    measured = section()
    measured.add("seconds", 2.0, 8.0)
    measured.add("pairs", 1809.4, 150.2)
    rows = list(zip(*(column.cells for column in table([measured]).columns), strict=True))
    assert rows == [("a", "new", "old", "ratio"), ("seconds", "2", "8", "0.25 x"), ("pairs", "1809", "150", "12 x")]


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        (
            "measure=[second_stag]",
            "measure=second_stag is not a measurement; did you mean 'second_stage'? (known: loa",
        ),
        (
            "second_stage.architecture=narow",
            "second_stage.architecture=narow does not fit; expected one of published, narrow; did you mean 'narrow'?",
        ),
        ("second_stage.dtype=float64", "second_stage.dtype=float64 does not fit; expected one of float32, bfloat16, "),
        ("second_stage.attention=fused", "second_stage.attention=fused does not fit; expected one of sdpa, math"),
        ("second_stage.starts=[2,0]", "second_stage.starts must be at least 1, got [2, 0]"),
        ("measure=[pair] pair.starts=[]", "pair.starts must not be empty"),
        ("second_stage.starts=4", "second_stage.starts=4 does not fit; expected Sequence[int]"),
        (
            "measure=[rendering] rendering.object=duk",
            "rendering.object=duk is not one of the embedded objects; did you mean 'duck'?",
        ),
        (
            "measure=[precision] precision.architecture=tiny",
            "precision.architecture=tiny does not fit; expected one of",
        ),
        ("second_stage.rounds=0", "second_stage.rounds must be at least 1, got 0"),
        ("second_stage.max_batch=0", "second_stage.max_batch must be at least 1, got 0"),
        ("accelerator=tpu", "accelerator=tpu is not available on this machine; choose auto"),
    ],
)
def test_mistakes(lp, setting, sentence):
    ran = lp("bench", *overrides(), *setting.split())
    assert ran.status == 1 and ran.error.startswith(sentence)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_measurements_that_need_a_gpu_are_refused_without_one(lp, tmp_path):
    ran = lp("bench", "experiment=gpu", "hydra.run.dir=run")
    assert ran.status == 1 and ran.error.startswith("accelerator=cuda is not available on this machine")
    assert not (tmp_path / "run" / "bench.json").exists()


def test_a_missing_package_is_one_sentence(lp, monkeypatch):
    monkeypatch.setitem(sys.modules, "diffusers", None)  # importing it fails as where it is not installed
    ran = lp("bench", *overrides())
    assert ran.status == 1 and ran.error.startswith("Zero123 needs the Python package 'diffusers'")


def test_the_published_size_is_what_is_measured_by_default():
    assert zero123.ARCHITECTURES["published"] is zero123.PUBLISHED
