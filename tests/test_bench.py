"""`bench`: contenders do the work that they are said to do, and what has been measured is kept."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from tiny_runs import Commands
from view_folders import write_objects

from lp_framework.benchmarks import loader, second_stage
from lp_framework.benchmarks.second_stage import BATCHED, LOOP, TIMESTEP, Batched, PlainLoop, SecondStage
from lp_framework.benchmarks.section import Figure, Section
from lp_framework.commands.bench import table
from lp_framework.data.module import PairDataModule
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.starts import Ring

NARROW = {
    "measure": "[second_stage]", "second_stage.architecture": "narrow", "second_stage.starts": "[1,2]",
    "second_stage.rounds": "1",
}  # fmt: skip


def narrow(**settings) -> SecondStage:
    plain = {"rounds": 2, "steps": 1, "dtype": "float32", "channels_last": False, "compile": False}
    plain |= {"architecture": "narrow", "starts": [1, 2], "attention": "sdpa", "max_batch": None, **settings}
    return SecondStage(torch.device("cpu"), **plain)


@pytest.fixture(scope="module")
def priors():
    torch.manual_seed(0)
    return narrow().priors()


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


def test_a_batched_step_encodes_nothing_and_passes_the_network_once(priors, pairs):
    batch_prior, _ = priors
    batched = Batched(PairEnergy(batch_prior, pairs, seed=0), Ring(3).make(pairs.ids, seed=0))
    before = batched.poses.detach().clone()
    with Passes(batch_prior) as counts:
        batched.step()
    assert counts == {"vae": [], "clip": [], "unet": [6]}  # three starts in two directions
    assert ((batched.poses.detach() - before).abs().amax(dim=-1) > 0).all()


def test_a_step_of_the_plain_loop_encodes_every_image_anew(priors, images):
    _, loop_prior = priors
    loop = PlainLoop(loop_prior, images, torch.tensor([0.0, torch.pi / 2, 0.0]))
    torch.testing.assert_close(loop.poses(loop.twist).detach(), torch.tensor([0.0, torch.pi / 2, 0.0]))
    with Passes(loop_prior) as counts:
        loop.step()
        loop.step()
    assert counts == {"vae": [2, 2] * 2, "clip": [2] * 2, "unet": [2] * 2}
    assert loop.twist.abs().max() > 0 and loop.total > 0


def test_the_contenders_share_memory_only_where_nothing_is_converted():
    for dtype, shared in (("float32", True), ("bfloat16", False)):
        batch_prior, loop_prior = narrow(dtype=dtype).priors()
        one, other = batch_prior.unet.conv_in.weight, loop_prior.unet.conv_in.weight
        assert (one.data_ptr() == other.data_ptr()) is shared
        assert other.dtype == torch.float32 and not one.requires_grad and not other.requires_grad
        torch.testing.assert_close(one.float(), other, rtol=1e-2, atol=0)


# ---------------------------------------------------------------- the measurement


def test_the_section_grows_with_every_stretch(monkeypatch):
    seconds = iter(np.random.default_rng(0).uniform(1, 2, 100).tolist())
    monkeypatch.setattr(SecondStage, "run", lambda self, runner, prior: (next(seconds), 0))
    sections = list(narrow().measure())
    shares = [section.done for section in sections]
    assert shares == sorted(shares) and shares[-1] == 1
    assert not sections[0].figures and sections[0].record["starts"] == {}
    first = next(section for section in sections if section.figures)
    assert list(first.record["starts"]) == ["1"]  # of the first round, when two starts have not been looked at
    last = sections[-1]
    assert [figure.label for figure in last.figures] == ["1 start, seconds a step", "2 starts, seconds a step"]
    for figure, entry in zip(last.figures, last.record["starts"].values(), strict=True):
        assert all(len(entry[name]["rounds"]) == 2 for name in (BATCHED, LOOP))
        assert figure.first == entry[BATCHED]["seconds_per_step"] == pytest.approx(sum(entry[BATCHED]["rounds"]) / 2)
        assert entry["ratio"]["seconds_per_step"] == pytest.approx(figure.first / figure.second)


def test_rounds_alternate_and_the_loop_takes_its_starts_in_turn(monkeypatch):
    steps = []

    def longitude(loop):
        return round(torch.rad2deg(loop.poses(loop.twist)[1]).item())

    monkeypatch.setattr(Batched, "step", lambda self: steps.append(self.poses.shape[1]))
    monkeypatch.setattr(PlainLoop, "step", lambda self: steps.append(f"at {longitude(self)}"))
    list(narrow(steps=2).measure())
    warm_up = [1, "at 0"]
    assert steps == [*warm_up, *[1, 1, "at 0", "at 0", 2, 2, "at 0", "at 0", "at 180", "at 180"] * 2]


def test_seconds_are_those_of_one_step_of_all_starts(monkeypatch):
    monkeypatch.setattr(SecondStage, "run", lambda self, runner, prior: (3.0 * self.steps, 1000))
    *_, last = narrow(steps=4).measure()
    seconds = {figure.label: (figure.first, figure.second) for figure in last.figures}
    assert seconds["2 starts, seconds a step"] == (3, 6)
    assert seconds["2 starts, peak memory, GB"] == (1e-6, 1e-6)
    assert last.record["starts"]["2"]["ratio"] == {"seconds_per_step": 0.5, "peak_bytes": 1}


# ---------------------------------------------------------------- the loaders


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    folder = tmp_path_factory.mktemp("loaders")
    write_objects(folder / "views", train=6)
    data = PairDataModule(str(folder / "views"), str(folder / "cache"), 16, 36, 3, 0, 0)
    return data.data("train")


def test_a_plain_batch_has_two_images_a_pair(views):
    batch = next(loader.plain_pairs(views, 5))
    assert len(batch) == 5 and len(batch.images) == 10
    for row, pair in enumerate(batch.pairs.tolist()):
        alone = views[np.array([divmod(pair, len(views.table))])]
        for side in ("reference", "query"):
            mine, its = (each.images[getattr(each, side)[number]] for each, number in ((batch, row), (alone, 0)))
            assert torch.equal(mine, its)


def test_a_batch_in_feature_space_has_fewer_images_than_pairs(views):
    batch = next(loader.feature_space(views, 36, 3))
    assert len(batch.images) < len(batch)


# ---------------------------------------------------------------- the command


def overrides(**changed):
    return [f"{key}={value}" for key, value in {**NARROW, **changed}.items()]


def test_the_command_measures_what_is_named(lp, tmp_path):
    ran = lp("bench", *overrides(), "hydra.run.dir=run")
    assert ran.status == 0, ran.err
    kept = json.loads((tmp_path / "run" / "bench.json").read_text())
    assert list(kept) == ["second_stage", "device", "threads", "config", "versions"]
    assert list(kept["second_stage"]["starts"]) == ["1", "2"]
    assert "2 starts, seconds a step" in ran.out and "results: run/bench.json" in ran.out


def test_a_run_that_is_stopped_keeps_what_it_has(lp, tmp_path, monkeypatch):
    run = SecondStage.run

    def stopped(self, runner, prior):
        if isinstance(runner, Batched) and runner.poses.shape[1] == 2:
            raise KeyboardInterrupt
        return run(self, runner, prior)

    monkeypatch.setattr(SecondStage, "run", stopped)
    assert lp("bench", *overrides(), "hydra.run.dir=run").status == 130
    kept = json.loads((tmp_path / "run" / "bench.json").read_text())
    assert list(kept["second_stage"]["starts"]) == ["1"] and kept["second_stage"]["starts"]["1"]["ratio"]


def test_both_measurements_in_one_table(tmp_path):
    commands = Commands(tmp_path, train_views=6)
    settings = overrides(measure="[loader,second_stage]", **{"second_stage.starts": "[1]"})
    tiny = ("backbone.image_size=32", "data.batch_pairs=36", "data.block=3", "data.validation_views=0")
    ran = commands.here("both", "bench", *settings, *tiny, "loader.rounds=1", "loader.steps=1")
    assert ran.status == 0, ran.err
    kept = ran.json("bench.json")
    pairs = {name: kept["loader"][name] for name in (loader.FEATURE_SPACE, loader.PLAIN)}
    for key, ratio in kept["loader"]["ratio"].items():
        assert ratio == pytest.approx(pairs[loader.FEATURE_SPACE][key] / pairs[loader.PLAIN][key])
    assert kept["loader"]["ratio"]["bytes_for_backward_per_pair"] < 1
    assert ran.out.index("pairs a second") < ran.out.index("1 start, seconds a step")
    assert "loader: resnet18 at 32 px, 36 pairs a batch" in ran.out


def test_the_table_gives_ratios_of_the_first_to_the_second():
    section = Section("a", ("new", "old"), [Figure("seconds", 2.0, 8.0), Figure("pairs", 1809.4, 150.2)], {}, 1.0)
    rows = list(zip(*(column.cells for column in table([section]).columns), strict=True))
    assert rows == [("a", "new", "old", "ratio"), ("seconds", "2", "8", "0.25 x"), ("pairs", "1809", "150", "12 x")]


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        (
            "measure=[second_stag]",
            "measure=second_stag is none of its values; did you mean 'second_stage'? (known: loa",
        ),
        (
            "second_stage.architecture=narow",
            "second_stage.architecture=narow is none of its values; did you mean 'narr",
        ),
        ("second_stage.dtype=float64", "second_stage.dtype=float64 is none of its values; did you mean 'float16'?"),
        ("second_stage.attention=fused", "second_stage.attention=fused is none of its values (known: sdpa, math)"),
        ("second_stage.starts=[2,0]", "second_stage.starts must list numbers of starts, at least 1 each, got [2, 0]"),
        ("second_stage.starts=4", "second_stage.starts must list numbers of starts, at least 1 each, got 4"),
        ("second_stage.rounds=0", "second_stage.rounds must be at least 1, got 0"),
        ("second_stage.max_batch=0", "second_stage.max_batch must be at least 1 or null, got 0"),
        ("accelerator=tpu", "accelerator=tpu cannot be had here; choose auto or cpu"),
    ],
)
def test_mistakes(lp, setting, sentence):
    ran = lp("bench", *overrides(), setting)
    assert ran.status == 1 and ran.error.startswith(sentence)


def test_a_missing_package_is_one_sentence(lp, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    ran = lp("bench", *overrides())
    assert ran.status == 1 and ran.error.startswith("Zero123 needs the Python package 'diffusers'")


def test_the_published_size_is_what_is_measured_by_default():
    assert second_stage.ARCHITECTURES["published"] is second_stage.PUBLISHED
