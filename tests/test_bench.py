"""`bench`: contenders do the work that they are said to do, and what has been measured is kept."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch
import trimesh
from exact_prior import ExactPrior
from solver_problems import ExactModel, around, exact_pairs
from tiny_runs import Commands
from view_folders import write_objects
from zero123_checkpoint import state_dict, write_checkpoint

from lp_framework import registry
from lp_framework.benchmarks import arithmetic, contest, first_stage, loader, rendering, second_stage
from lp_framework.benchmarks import pair as whole_pair
from lp_framework.benchmarks.adam_gauss_newton import Encoded, followed, some_pairs
from lp_framework.benchmarks.arithmetic import Arithmetic, Peak, counted, launched
from lp_framework.benchmarks.contest import Match, compete
from lp_framework.benchmarks.encoding import loss_on, trunk_features
from lp_framework.benchmarks.first_stage import all_pairs
from lp_framework.benchmarks.memory import peak_bytes
from lp_framework.benchmarks.original_layout import original_tensors, write_original
from lp_framework.benchmarks.precision import Precision, Variant
from lp_framework.benchmarks.scaling import Scaling, exponent
from lp_framework.benchmarks.second_stage import BATCHED, LOOP, TIMESTEP, Batched, PlainLoop, SecondStage
from lp_framework.benchmarks.section import Figure, Section
from lp_framework.commands.bench import MEASUREMENTS, table
from lp_framework.data.meshes import MeshObject
from lp_framework.data.module import PairDataModule
from lp_framework.data.rendering.raycast import RaycastRenderer
from lp_framework.errors import UserError
from lp_framework.geometry import wrap_angle
from lp_framework.models.checkpoints import SHIPPED, load_model
from lp_framework.priors.zero123.networks import Networks
from lp_framework.priors.zero123.weights import load_networks
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.gauss_newton import GaussNewton
from lp_framework.solvers.langevin import Langevin
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.two_stage import TwoStage

CPU = torch.device("cpu")

NARROW = {
    "measure": "[second_stage]", "second_stage.architecture": "narrow", "second_stage.starts": "[1,2]",
    "second_stage.rounds": "1",
}  # fmt: skip
FEW = {
    "backbone.image_size": "32", "data.batch_pairs": "36", "data.block": "3", "data.validation_views": "0",
    "loader.rounds": "1", "loader.steps": "1", "encoding.rounds": "1",
    "first_stage.views": "2", "first_stage.starts": "1", "first_stage.rounds": "1",
    "pair.starts": "[1,2]", "pair.steps": "2",
    "precision.architecture": "narrow", "precision.starts": "1", "precision.rounds": "1",
    "adam_gauss_newton.pairs": "2", "adam_gauss_newton.starts": "1", "adam_gauss_newton.rounds": "1",
    "adam_gauss_newton.newton_steps": "2", "adam_gauss_newton.adam_steps": "3",
    "rendering.views": "2", "rendering.resolution": "8", "rendering.rounds": "1",
    "checkpoint.rounds": "1",
    "scaling.pairs": "[1,2]", "scaling.starts": "[1,2]", "scaling.views": "[1,2]", "scaling.steps": "1",
    "scaling.rounds": "1", "scaling.fixed": "{pairs: 1, starts: 1, sets: 1}",
}  # fmt: skip


def narrow(**settings) -> SecondStage:
    plain = {"rounds": 2, "steps": 1, "dtype": "float32", "channels_last": False, "compile": False, "cuda_graph": False}
    plain |= {"architecture": "narrow", "starts": [1, 2], "attention": "sdpa", "max_batch": None, **settings}
    return SecondStage(CPU, **plain)


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
    batched = Batched(PairEnergy(batch_prior, pairs, seed=0), Ring(3).make(pairs, seed=0))
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


@pytest.fixture
def uncounted(monkeypatch):
    """Operations are not counted anew."""
    work = {BATCHED: Arithmetic(600, Peak(100.0, "told")), LOOP: Arithmetic(900, Peak(100.0, "told"))}
    monkeypatch.setattr(SecondStage, "work", lambda self: work)


def test_the_section_grows_with_every_stretch(monkeypatch, uncounted):
    seconds = iter(np.random.default_rng(0).uniform(1, 2, 100).tolist())
    monkeypatch.setattr(SecondStage, "run", lambda self, runner, prior, steps: (next(seconds), 0))
    sections = list(narrow().measure())
    shares = [section.done for section in sections]
    assert shares == sorted(shares) and shares[-1] == 1
    assert not sections[0].figures and sections[0].record["starts"] == {}
    first = next(section for section in sections if section.figures)
    assert list(first.record["starts"]) == ["1"]  # of the first round, when two starts have not been looked at
    last = sections[-1]
    rows = [f"{starts}, {what}" for starts in ("1 start", "2 starts") for what in ("seconds a step", "share of peak")]
    assert [figure.label for figure in last.figures] == rows
    for figure, entry in zip(last.figures[::2], last.record["starts"].values(), strict=True):
        assert all(len(entry[name]["rounds"]) == 2 for name in (BATCHED, LOOP))
        assert figure.first == entry[BATCHED]["seconds_per_step"] == pytest.approx(sum(entry[BATCHED]["rounds"]) / 2)
        assert entry["ratio"]["seconds_per_step"] == pytest.approx(figure.first / figure.second)


def test_rounds_alternate_and_the_loop_takes_its_starts_in_turn(monkeypatch, uncounted):
    steps = []

    def longitude(loop):
        return round(torch.rad2deg(loop.poses(loop.twist)[1]).item())

    monkeypatch.setattr(Batched, "step", lambda self: steps.append(self.poses.shape[1]))
    monkeypatch.setattr(PlainLoop, "step", lambda self: steps.append(f"at {longitude(self)}"))
    list(narrow(steps=2).measure())
    warm_up = [1, "at 0"]
    assert steps == [*warm_up, *[1, 1, "at 0", "at 0", 2, 2, "at 0", "at 0", "at 180", "at 180"] * 2]


def test_seconds_are_those_of_one_step_of_all_starts(monkeypatch, uncounted):
    monkeypatch.setattr(SecondStage, "run", lambda self, runner, prior, steps: (3.0 * steps, 1000))
    *_, last = narrow(steps=4).measure()
    seconds = {figure.label: (figure.first, figure.second) for figure in last.figures}
    assert seconds["2 starts, seconds a step"] == (3, 6)
    assert seconds["2 starts, peak memory, GB"] == (1e-6, 1e-6)
    assert seconds["2 starts, share of peak"] == (2 * 6 / 3, 2 * 9 / 6)
    assert last.record["arithmetic_per_start"][BATCHED]["operations"] == 600
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


# ---------------------------------------------------------------- what the other measurements share


def test_contenders_take_turns_after_a_warm_up(monkeypatch):
    done = []
    monkeypatch.setattr(contest, "timed", lambda work, device: (2.0, work()))

    def work(name, amount):
        return lambda: (done.append(name), amount)[1]

    matches = [
        Match("quick", "a second", work("a", 8), work("b", 4)),
        Match("slow", "seconds", work("c", 1), work("d", 2), rate=False),
    ]
    sections = list(compete("race", ("new", "old"), matches, 2, CPU, "as ever"))
    assert done == [*"abcd"] * 3
    assert [section.done for section in sections] == [stretch / 8 for stretch in range(1, 9)]
    assert not sections[0].figures and not sections[0].record
    last = sections[-1]
    assert last.figures == [Figure("a second", 4, 2), Figure("seconds", 2, 1)] and last.note == "as ever"
    assert last.record["quick"] == {
        "new": {"median": 4, "rounds": [4, 4]}, "old": {"median": 2, "rounds": [2, 2]}, "ratio": 2,
    }  # fmt: skip


def test_operations_are_those_of_matrix_products_and_convolutions():
    left, right = torch.zeros(3, 4, device="meta", requires_grad=True), torch.zeros(4, 5, device="meta")
    assert counted(lambda: left @ right) == 2 * 3 * 4 * 5
    assert counted(lambda: (left @ right).sum().backward()) == 2 * 2 * 3 * 4 * 5  # and the gradient of the left alone
    image, kernel = torch.zeros(2, 3, 8, 8, device="meta"), torch.zeros(6, 3, 3, 3, device="meta")
    assert counted(lambda: torch.nn.functional.conv2d(image, kernel, padding=1)) == 2 * 2 * 8 * 8 * 6 * 3 * 9


def test_launches_are_what_computes():
    matrix = torch.rand(4, 4)
    assert launched(lambda: torch.empty(4, 4).copy_(matrix.t()[1:].reshape(12).sum() + matrix.view(2, 8)[0, 0])) == 4


def test_a_batched_step_has_as_many_launches_from_few_starts_as_from_many(priors, pairs):
    energy = PairEnergy(priors[0], pairs, seed=0)
    two, four = (launched(Batched(energy, Ring(count).make(pairs, seed=0)).step) for count in (2, 4))
    assert two == four > 300


def test_a_step_has_as_many_operations_as_starts():
    work = narrow().work()
    assert Precision(CPU, "narrow", [], 3, 1, 1, None).operations() == 3 * work[BATCHED].operations
    assert work[LOOP].operations > 2 * work[BATCHED].operations  # it encodes, too


@pytest.mark.parametrize(
    ("name", "half", "single"),
    [("NVIDIA H100 80GB HBM3", 989, 495), ("NVIDIA H100 PCIe", 756, 378), ("NVIDIA RTX 6000 Ada Generation", 364, 182),
     ("NVIDIA L4", 121, 60), ("NVIDIA L40S", 362, 183), ("NVIDIA A100-SXM4-80GB", 312, 156)],
)  # fmt: skip
def test_peaks_of_known_devices_are_those_of_their_data_sheets(monkeypatch, name, half, single):
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: name)
    for dtype, rate in ((torch.bfloat16, half), (torch.float16, half), (torch.float32, single)):
        assert arithmetic.peak(torch.device("cuda"), dtype) == (rate * 1e12, "data sheet")


def test_an_unknown_device_is_measured(monkeypatch):
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "Another GPU")
    monkeypatch.setattr(arithmetic, "matmul_rate", lambda device, dtype: 7.0)
    assert arithmetic.peak(torch.device("cuda"), torch.float16) == (7.0, "matrix product")
    work = Arithmetic(14, arithmetic.peak(CPU, torch.float32))
    assert work.share(seconds=4.0) == 0.5 and work.record()["peak_source"] == "matrix product"


def test_the_rate_of_a_matrix_product_is_positive():
    assert arithmetic.matmul_rate(CPU, torch.float32) > 1e8


def test_peak_memory_is_that_of_tensors_alive_at_once():
    ones = torch.ones(1000)

    def chain():
        first = ones + 1
        second = first * 2
        first.mul_(3)  # in place: nothing new
        del first
        third = second.view(10, 100).exp()
        return third.sum()

    assert peak_bytes(chain, CPU) == pytest.approx(2 * 4000, abs=16)
    variable = torch.ones(1000, requires_grad=True)
    kept = peak_bytes(lambda: variable.exp().exp().exp().sum().backward(), CPU)
    assert 3 * 4000 <= kept <= 6 * 4000  # three results are kept for the backward pass


class Allocator:
    """A GPU's, of which this machine has none: what `torch.cuda` says of it."""

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


def test_a_gpus_memory_is_what_its_allocator_says(monkeypatch):
    allocator, gpu = Allocator(monkeypatch), torch.device("cuda")
    allocator.most = 5000  # of what was before
    assert peak_bytes(allocator.step, gpu) == 30
    allocator.most = 5000
    prior = torch.nn.Linear(3, 2)
    seconds, peak = dataclasses.replace(narrow(), device=gpu).run(allocator, prior, steps=1)
    assert peak == 30 + 4 * (6 + 2) and seconds >= 0


# ---------------------------------------------------------------- encoding and the first stage


@pytest.fixture(scope="module")
def pose_model():
    torch.manual_seed(0)
    backbone = registry.build("backbone", {"name": "resnet", "arch": "resnet18", "pretrained": False, "image_size": 32})
    return registry.build("model", {"name": "score", "hidden": 16}, backbone=backbone).eval()


def test_training_on_features_kept_is_training_on_both_images_of_every_pair(views, pose_model):
    pairs = views.table.pairs("ordered")[::5]
    once = views[pairs]
    batches = [views[pair[None]] for pair in pairs]
    losses = [loss_on(pose_model, batch, trunk_features(pose_model, batch.images)) for batch in (once, *batches)]
    whole, apart = losses[0], torch.stack(losses[1:]).mean()
    torch.testing.assert_close(whole, apart)
    parameters = [*pose_model.network.parameters()]
    for one, other in zip(*(torch.autograd.grad(each, parameters) for each in (whole, apart)), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    assert len(once.images) < 2 * len(pairs)


def test_the_first_stage_as_a_loop_ends_where_the_batch_does(pose_model):
    solver = Langevin(pose_model, gamma=0.0, iterations=5)
    pairs = all_pairs(32, 3, CPU)
    assert len(pairs) == 6 and len(pairs.images) == 3
    starts = Ring(2).make(pairs, seed=0)
    batched = solver.solve(pairs, starts, seed=0).poses
    loop = first_stage.PlainLoop(solver).solve(pairs, starts)
    loop[..., 1] = wrap_angle(loop[..., 1]) % (2 * torch.pi)
    torch.testing.assert_close(loop, batched, rtol=1e-4, atol=1e-4)


# ---------------------------------------------------------------- Adam and Gauss-Newton


def test_a_prior_whose_images_are_encoded_has_the_same_energy_and_gradient():
    pairs, true = exact_pairs(3)
    prior = ExactPrior([0.0, 2.0], [0.0, 0.3], noisy=0.3)
    found = []
    for each in (prior, Encoded(prior, pairs.images)):
        energy = PairEnergy(each, pairs, seed=0)
        poses = around(true, 0.3, -0.4).requires_grad_()
        values = energy(poses, 100, energy.noise(0)[:, 0])
        found.append((values.detach(), torch.autograd.grad(values.sum(), poses)[0]))
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)


def test_a_descent_is_followed_on_a_probe_of_its_own():
    pairs, true = exact_pairs(3)
    starts, prior = around(true, 0.3, -0.4), ExactPrior()
    newton = GaussNewton(ExactModel(), prior, refinement_steps=4, trajectory=True)
    descent = followed(prior, pairs, newton.refine(pairs, starts, seed=0), looks=1)
    energy = PairEnergy(prior, pairs, seed=0)  # this prior's energy does not depend on the noise
    expected = energy(starts, 100, energy.noise(0)[:, 0]).mean().item()
    assert descent.energies[0] == pytest.approx(expected) and len(descent.energies) == len(descent.passes) == 5
    assert descent.passes == pytest.approx([8, 16, 24, 32, 40])  # two directions, plainly and along three numbers
    assert descent.reached(descent.energies[2]) == 2 and descent.reached(expected) == 0
    adam = TwoStage(ExactModel(), prior, refinement_steps=4, trajectory=True).second
    descent = followed(prior, pairs, adam.solve(pairs, starts, seed=0), looks=0)
    assert descent.passes == pytest.approx([0, 2, 4, 6, 8])


def test_pairs_are_spread_over_the_objects(views):
    pairs = some_pairs(views, 6, CPU)
    assert len(pairs) == 6 and len(pairs.ids.unique()) == 6
    assert len(some_pairs(views, 10**6, CPU)) == len(views.table.pairs("ordered"))


# ---------------------------------------------------------------- rendering, checkpoints


def coloured_box():
    box = trimesh.creation.box()
    box.visual.vertex_colors = [200, 100, 50, 255]
    return box


def test_a_mesh_that_is_loaded_each_time_looks_the_same(tmp_path):
    coloured_box().export(tmp_path / "box.glb")
    cameras = rendering.around(3)
    one, other = (
        draw(RaycastRenderer(), tmp_path / "box.glb", cameras, 8)
        for draw in (rendering.views_once, rendering.views_each_time)
    )
    assert one.shape == (3, 8, 8, 4) and one[..., 3].any() and np.array_equal(one, other)


def test_a_renderer_that_cannot_work_here_is_named():
    class Broken(RaycastRenderer):
        def views(self, *arguments):
            raise UserError("no light")

    box = MeshObject("box", "unique", lambda: trimesh.Scene(coloured_box()))
    both = {"broken": Broken(), "raycast": RaycastRenderer()}
    *_, last = rendering.measure(box, both, 2, 8, 1, CPU)
    assert [figure.label for figure in last.figures] == ["raycast, views a second"] and last.note.endswith("no light")
    with pytest.raises(UserError, match="nothing to render with here: no light"):
        list(rendering.measure(box, {"broken": Broken()}, 2, 8, 1, CPU))


@pytest.mark.parametrize("weights", ["ema", "raw"])
def test_a_checkpoint_in_the_original_layout_is_read_back(priors, tmp_path, weights):
    networks = Networks(second_stage.ARCHITECTURES["narrow"])
    write_original(networks, tmp_path / "original.ckpt")
    read = load_networks(str(tmp_path / "original.ckpt"), None, weights, "float32")
    before, after = networks.state_dict(), read.state_dict()
    assert before.keys() == after.keys() and all(torch.equal(before[name], after[name]) for name in before)
    assert read.unet.config.block_out_channels == networks.unet.config.block_out_channels


def test_the_original_layout_is_the_published_one(tmp_path):
    """Names and tensors of the synthetic checkpoint that the published code has read, but for the averages."""
    wanted = state_dict()
    ours = original_tensors(load_networks(str(write_checkpoint(tmp_path)), None, "raw", "float32"))
    assert ours.keys() <= wanted.keys() and len(ours) > 1500
    for key, tensor in ours.items():
        assert tensor.shape == wanted[key].shape
        assert key.startswith("model_ema.") or torch.equal(tensor, wanted[key])


# ---------------------------------------------------------------- a pair, growth, precision


def test_a_pair_is_encoded_once_here_and_at_every_step_of_the_loop(priors, monkeypatch):
    monkeypatch.setattr(SecondStage, "priors", lambda stage: priors)
    with Passes(priors[0]) as ours, Passes(priors[1]) as loop:
        *_, last = whole_pair.measure(narrow(), load_model(SHIPPED / "score"), [2], steps=3, rounds=1)
    assert ours == {"vae": [2] * 2, "clip": [2] * 2, "unet": [4] * 2 * 3}  # the first pair, and one more
    steps = 1 + 2 * 3  # to warm up, and of either start
    assert loop == {"vae": [2] * 2 * steps, "clip": [2] * steps, "unet": [2] * steps}
    assert [figure.label for figure in last.figures] == ["2 starts, seconds a pair"] and last.done == 1


def test_the_papers_seconds_stand_beside_those_of_the_same_work():
    measured = {"2": {BATCHED: {"median": 1.286}, LOOP: {"median": 9.0}}, "3": {BATCHED: {"median": 1.0}}}
    section = Section("pair", (BATCHED, LOOP), [], measured, 1.0)
    assert whole_pair.beside(section) == "The paper's on an RTX 6000 Ada: 12.86 s from 2 (here 0.1 of that)"


# ---------------------------------------------------------------- growth, precision


def test_exponents():
    assert exponent({20: 5.0, 60: 15.0, 200: 50.0}) == pytest.approx(1)
    assert exponent({1: 2.0, 10: 200.0}) == pytest.approx(2)
    assert exponent({1: 2.0, 10: 2.0}) == pytest.approx(0)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"pairs": [3]}, "pairs must list two or more"),
        ({"views": [3, 2]}, "views must"),
        ({"starts": [0, 2]}, "starts"),
    ],
)
def test_sizes_that_give_no_exponent(settings, words):
    sizes = {"pairs": [1, 2], "starts": [1, 2], "views": [1, 2], **settings}
    with pytest.raises(UserError, match=words):
        Scaling(CPU, None, None, **sizes, fixed={}, steps=1, rounds=1)


@pytest.mark.parametrize(
    ("words", "variant"),
    [
        ("bfloat16", Variant("bfloat16")),
        ("channels_last", Variant(channels_last=True)),
        ("compile float16 channels_last", Variant("float16", True, True)),
        ("cuda_graph bfloat16", Variant("bfloat16", recorded=True)),
    ],
)
def test_variants_by_name(words, variant):
    assert Variant.named(words) == variant


@pytest.mark.parametrize("words", ["", "bfloat8", "bfloat16 float16", "compile compile"])
def test_variants_that_are_none(words):
    with pytest.raises(UserError, match=f"precision.variants: '{words}' is none; give one or more of float32, bfl"):
        Variant.named(words)


def test_variants_share_what_they_do_not_change():
    measurement = Precision(CPU, "narrow", [], 1, 1, 1, None)
    networks = Networks(second_stage.ARCHITECTURES["narrow"])
    prior = measurement.prior(networks, Variant("bfloat16", channels_last=True))
    assert prior.vae is networks.vae and prior.image_encoder is networks.image_encoder
    assert prior.unet.dtype == torch.bfloat16 and networks.unet.dtype == torch.float32


def test_the_layout_leaves_the_gradient_and_reduced_precision_nearly():
    *_, last = Precision(CPU, "narrow", ["channels_last", "bfloat16"], 2, 1, 1, None).measure()
    assert list(last.record) == ["channels_last", "bfloat16"]
    off = {words: entry["gradient_deviation"] for words, entry in last.record.items()}
    assert off["channels_last"] < 1e-4 and 0 < off["bfloat16"] < 0.2
    labels = [figure.label for figure in last.figures]
    assert labels == [f"{words}: {what}" for words in off for what in ("seconds a step", "share of peak")]


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

    def stopped(self, runner, prior, steps):
        if isinstance(runner, Batched) and runner.poses.shape[1] == 2:
            raise KeyboardInterrupt
        return run(self, runner, prior, steps)

    monkeypatch.setattr(SecondStage, "run", stopped)
    ran = lp("bench", *overrides(), "hydra.run.dir=run")
    assert ran.status == 130 and "1 start, seconds a step" in ran.out and "2 starts" not in ran.out
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


def test_every_measurement_is_in_the_table_and_in_the_file(tmp_path):
    commands = Commands(tmp_path, train_views=6)
    everything = f"measure=[{','.join(MEASUREMENTS)}]"
    settings = overrides(**{"second_stage.starts": "[1]"})
    ran = commands.here("all", "bench", *settings, everything, *(f"{key}={value}" for key, value in FEW.items()))
    assert ran.status == 0, ran.err
    kept = ran.json("bench.json")
    assert list(kept) == [*MEASUREMENTS, "device", "threads", "config", "versions"]
    for name in ("encoding", "first_stage", "rendering"):
        for entry in kept[name].values():
            one, other = (each["median"] for each in entry.values() if isinstance(each, dict))
            assert entry["ratio"] == pytest.approx(one / other)
    assert list(kept["encoding"]) == ["backbone", "prior", "frozen_training"]
    assert list(kept["first_stage"]) == ["1_pairs", "2_pairs"] and "raycast" in kept["rendering"]
    assert list(kept["pair"]) == ["1", "2", "first_pair_seconds"] and "of that" not in ran.out  # 2 steps are not 50
    assert list(kept["checkpoint"]) == ["float32", "bfloat16"]
    assert kept["checkpoint"]["bfloat16"]["gigabytes"]["converted folder"] < 0.01
    for entry in kept["adam_gauss_newton"].values():
        assert entry["energy"]["equal"] <= entry["energy"]["start"] and len(entry["energies"]["Adam"]) == 4
        assert entry["passes_per_start"]["Gauss-Newton"] == 8 * (entry["steps"]["Gauss-Newton"] + 1)
        assert entry["passes_per_start"]["Adam"] == 2 * entry["steps"]["Adam"]
    for name in ("pairs", "starts", "views"):
        sizes = kept["scaling"][name]["sizes"]
        assert list(sizes) == ["1", "2"] and sizes["2"]["peak_bytes"] > sizes["1"]["peak_bytes"] > 0
        assert f"1 to 2 {name}: seconds, exponent {kept['scaling'][name]['exponent']['seconds']:.2f}" in ran.out
    assert not list(ran.folder.glob("tmp*"))  # the checkpoints are gone


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
        ("measure=[pair] pair.starts=[]", "pair.starts must list numbers of starts, at least 1 each, got []"),
        ("second_stage.starts=4", "second_stage.starts must list numbers of starts, at least 1 each, got 4"),
        ("measure=[first_stage] first_stage.views=1", "first_stage.views must be at least 2, got 1"),
        (
            "measure=[rendering] rendering.object=duk",
            "rendering.object=duk is none of its values; did you mean 'duck'?",
        ),
        (
            "measure=[checkpoint] checkpoint.dtypes=[half]",
            "checkpoint.dtypes=half is none of its values (known: float3",
        ),
        (
            "measure=[precision] precision.architecture=tiny",
            "precision.architecture=tiny is none of its values (known: pu",
        ),
        ("second_stage.rounds=0", "second_stage.rounds must be at least 1, got 0"),
        ("second_stage.max_batch=0", "second_stage.max_batch must be at least 1 or null, got 0"),
        ("accelerator=tpu", "accelerator=tpu is not available on this machine; choose auto or cpu"),
    ],
)
def test_mistakes(lp, setting, sentence):
    ran = lp("bench", *overrides(), *setting.split())
    assert ran.status == 1 and ran.error.startswith(sentence)


def test_a_missing_package_is_one_sentence(lp, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    ran = lp("bench", *overrides())
    assert ran.status == 1 and ran.error.startswith("Zero123 needs the Python package 'diffusers'")


def test_the_published_size_is_what_is_measured_by_default():
    assert second_stage.ARCHITECTURES["published"] is second_stage.PUBLISHED
