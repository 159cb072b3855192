"""The pose network, the two models as fields, and the backbones."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from urllib.error import URLError

import pytest
import torch
from lightning import Trainer
from torch import Tensor, nn
from torch.utils.data import DataLoader

from lp_framework import registry, torchvision_ops
from lp_framework.data.pairs import PairBatch, PairData, ViewTable
from lp_framework.data.views import ObjectViews
from lp_framework.errors import UserError
from lp_framework.geometry import camera_to_world
from lp_framework.models.backbones import Backbone, EfficientNetLite0, ResNet, Standardise
from lp_framework.models.networks import PoseEmbedding, PoseNetwork
from lp_framework.models.pose_model import EnergyModel, ScoreModel

pytestmark = pytest.mark.filterwarnings("ignore:You are trying to `self.log")  # steps are called without a trainer


class Colors(Backbone):
    """A frozen trunk with weights and a state of its own, and a linear head."""

    def __init__(self, features: int = 6) -> None:
        super().__init__()
        self.image_size, self.trunk_dim, self.feature_dim, self.frozen = 8, 12, features, True
        self.net = nn.Sequential(nn.Conv2d(3, 12, 3), nn.BatchNorm2d(12), nn.AdaptiveAvgPool2d(1), nn.Flatten())
        self.net.eval().requires_grad_(False)
        self.head = nn.Linear(12, features)

    def trunk_module(self) -> nn.Module:
        return self.net

    def trunk_features(self, images: Tensor) -> Tensor:
        return self.net(images)


def batch(views: int = 4, seed: int = 0) -> PairBatch:
    """All ordered pairs among random views of one object."""
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand(views, 3, generator=generator, dtype=torch.float64)
    poses = torch.stack([unit[:, 0] - 0.5, unit[:, 1] * 2 * math.pi, 1.2 + 0.8 * unit[:, 2]], dim=-1)
    first, second = torch.meshgrid(torch.arange(views), torch.arange(views), indexing="ij")
    reference, query = first[first != second], second[first != second]
    return PairBatch(
        pixels=torch.randint(256, (views, 8, 8, 3), generator=generator, dtype=torch.uint8), features=None,
        names=[f"cup/{view}" for view in range(views)], poses=poses,
        cameras=camera_to_world(poses), objects=torch.zeros(views, dtype=torch.long),
        reference=reference, query=query, pairs=torch.stack([reference, query], dim=1),
    )  # fmt: skip


# ---------------------------------------------------------------- the network


def test_the_networks_size_is_the_papers():
    network = ScoreModel(Colors(2048)).network
    assert len(network.residual) == 3
    assert network.output(torch.zeros(5, 256)).shape == (5, 3)
    for layer in (network.reference, network.query, network.pose):
        assert layer.weight.shape == (256, layer.in_features)
    assert network.reference.in_features == network.query.in_features == 2048
    assert network.pose.in_features == network.embedding.dim
    widths = {tuple(each.weight.shape) for each in network.residual.modules() if isinstance(each, nn.Linear)}
    assert widths == {(256, 256)}
    assert {type(each) for each in network.residual.modules()} >= {nn.LayerNorm, nn.ReLU}


def test_the_energy_model_has_one_output():
    condition, pose = torch.zeros(2, 1, 256), torch.zeros(2, 5, 3)
    assert EnergyModel(Colors()).energy(condition, pose).shape == (2, 5)


def test_the_first_layer_is_a_linear_map_of_the_concatenated_input():
    network = PoseNetwork(5, 3, 16, 2, 4, True, 0.0)
    joint = nn.Linear(5 + 5 + network.embedding.dim, 16)
    with torch.no_grad():
        weights = (network.reference.weight, network.query.weight, network.pose.weight)
        joint.weight.copy_(torch.cat(weights, dim=1))
        joint.bias.copy_(network.reference.bias)
    reference, query, pose = torch.randn(7, 5), torch.randn(7, 5), torch.randn(7, 3)
    concatenated = torch.cat([reference, query, network.embedding(pose)], dim=-1)
    expected = network.output(network.residual(joint(concatenated)))
    torch.testing.assert_close(network(network.project(reference, query), pose), expected, rtol=1e-5, atol=1e-5)


def test_the_network_broadcasts_pairs_over_poses():
    network = PoseNetwork(5, 3, 16, 2, 4, True, 0.0)
    images, pose = torch.randn(4, 1, 16), torch.randn(4, 6, 3)
    every = torch.stack([network(images[:, 0], pose[:, each]) for each in range(6)], dim=1)
    torch.testing.assert_close(network(images, pose), every)


def turned(longitude: float) -> Tensor:
    return torch.tensor([0.1, longitude, -0.2], dtype=torch.float64)


@pytest.mark.parametrize("longitude", [0.0, 0.6, 3.0])
def test_a_periodic_embedding_repeats_after_a_turn_and_the_lines_does_not(longitude):
    periodic, line = PoseEmbedding(4, periodic=True).double(), PoseEmbedding(4, periodic=False).double()
    here, around = turned(longitude), turned(longitude + 2 * math.pi)
    torch.testing.assert_close(periodic(here), periodic(around), rtol=0, atol=1e-9)
    assert (line(here) - line(around)).abs().max() > 0.5


@pytest.mark.parametrize("periodic", [True, False])
def test_an_embedding_distinguishes_poses(periodic):
    embedding = PoseEmbedding(4, periodic)
    longitudes = torch.arange(0, 6.2, 0.1)
    embedded = embedding(torch.stack([torch.zeros_like(longitudes), longitudes, torch.zeros_like(longitudes)], -1))
    assert embedded.shape == (len(longitudes), embedding.dim)
    distance = torch.cdist(embedded, embedded) + torch.eye(len(longitudes))
    assert distance.min() > 0.05


@pytest.mark.parametrize("model", [ScoreModel, EnergyModel])
def test_the_field_repeats_after_a_turn_with_the_periodic_target_alone(model):
    condition, pose = torch.randn(3, 256), torch.randn(3, 3)
    around = pose + torch.tensor([0.0, 2 * math.pi, 0.0])
    torch.manual_seed(0)
    periodic, line = (model(Colors(), target=target).eval() for target in ("periodic", "line"))
    scores = [periodic.field(condition, each).score.detach() for each in (pose, around)]
    torch.testing.assert_close(*scores, rtol=1e-3, atol=1e-4)
    scores = [line.field(condition, each).score.detach() for each in (pose, around)]
    assert (scores[0] - scores[1]).abs().max() > 1e-2


# ---------------------------------------------------------------- the energy model's field


def test_the_energy_models_score_is_minus_the_gradient_of_its_energy():
    torch.manual_seed(0)
    model = EnergyModel(Colors()).double().eval()
    condition, pose = torch.randn(4, 1, 256, dtype=torch.float64), torch.randn(4, 5, 3, dtype=torch.float64)
    field = model.field(condition, pose)
    assert field.energy is not None
    torch.testing.assert_close(field.energy, model.energy(condition, pose).detach())
    step = 1e-6
    for axis in range(3):
        shift = step * torch.eye(3, dtype=torch.float64)[axis]
        slope = (model.energy(condition, pose + shift) - model.energy(condition, pose - shift)) / (2 * step)
        torch.testing.assert_close(field.score[..., axis], -slope.detach(), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_the_energy_models_field_works_where_gradients_are_off(mode):
    torch.manual_seed(0)
    model = EnergyModel(Colors()).eval().requires_grad_(False)
    images, pose = torch.rand(2, 3, 8, 8), torch.randn(1, 4, 3)

    def ask() -> Tensor:
        features = model.encode(images)
        return model.field(model.condition(features[:1], features[1:])[:, None], pose).score

    expected = ask()
    with mode():
        score = ask()
        assert not score.requires_grad
        torch.testing.assert_close(score, expected, rtol=0, atol=0)


# ---------------------------------------------------------------- training steps


@pytest.mark.parametrize("model", [ScoreModel, EnergyModel])
@pytest.mark.parametrize("noise", ["uniform", "gaussian"])
def test_descending_the_loss_brings_it_down(model, noise):
    torch.manual_seed(0)
    fitted = model(Colors(), noise=noise, hidden=32, view_loss=0.0)
    pairs = batch()
    parameters = [each for each in fitted.parameters() if each.requires_grad]
    optimizer = torch.optim.Adam(parameters, lr=3e-3)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        loss = fitted.training_step(pairs, 0)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert sum(losses[-10:]) < 0.7 * sum(losses[:10])


@pytest.mark.parametrize("accumulated", [1, 2, 3])
def test_micro_batches_of_a_step_have_different_draws(accumulated, monkeypatch):
    """The first one has the draws of a step without accumulation."""
    model = ScoreModel(Colors(), hidden=8, layers=1)
    draw, noises, dropout_seeds = model.noised_pose.draw, [], []

    def watched(true: Tensor, generator: torch.Generator) -> Tensor:
        noises.append(draw(true, generator))
        dropout_seeds.append(torch.initial_seed())
        return noises[-1]

    monkeypatch.setattr(model.noised_pose, "draw", watched)
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False, "accelerator": "cpu"}
    trainer = Trainer(max_epochs=1, accumulate_grad_batches=accumulated, enable_model_summary=False, **quiet)
    trainer.fit(model, DataLoader([batch()] * 6, batch_size=None))
    assert len(noises) == len({noise.sum().item() for noise in noises}) == len(set(dropout_seeds)) == 6
    first = dropout_seeds[::accumulated]
    assert first == [(1 << 62) + 1_009 * step for step in range(6 // accumulated)]


def test_a_frozen_trunk_stays_in_evaluation_mode_and_gets_no_gradient():
    model = ScoreModel(Colors()).train()
    trunk = model.backbone.trunk_module()
    assert model.network.training
    assert model.backbone.head.training
    assert not any(module.training for module in trunk.modules())
    before = {name: value.clone() for name, value in trunk.state_dict().items()}
    model.training_step(batch(), 0).backward()
    assert all(parameter.grad is None for parameter in trunk.parameters())
    assert all(torch.equal(value, before[name]) for name, value in trunk.state_dict().items())
    assert all(parameter.grad is not None for parameter in model.backbone.head.parameters())


def test_cached_features_give_the_loss_of_the_images():
    torch.manual_seed(0)
    model = ScoreModel(Colors())
    pairs = batch()
    by_image = model.training_step(pairs, 0)
    pairs.features, pairs.pixels = model.backbone.trunk(pairs.images), None
    torch.testing.assert_close(model.training_step(pairs, 0), by_image)


def test_validation_noise_is_the_pairs_own_whatever_else_the_data_hold():
    def views_of(name: str) -> ObjectViews:
        poses = torch.rand(3, 3, generator=torch.Generator().manual_seed(len(name)), dtype=torch.float64) + 1
        files = [Path(f"{name}/train/rgb/{index:03d}.png") for index in range(3)]
        return ObjectViews(name, "train", "unlabelled", None, files, camera_to_world(poses), torch.full((3,), 0.8))

    def losses(names: Sequence[str]) -> list[float]:
        """Of the pairs of the last object."""
        table = ViewTable([views_of(name) for name in names])
        images = torch.arange(3 * 8 * 8 * 3).view(3, 8, 8, 3).repeat(len(names), 1, 1, 1) % 256
        validated = PairData(table, images.to(torch.uint8).numpy(), None)[table.pairs()[-6:]]
        model.validation_loss.reset()
        model.validation_step(validated, 0)
        return torch.cat(model.validation_loss.value).tolist()

    model = ScoreModel(Colors()).eval()
    assert losses(["mug"]) == losses(["brush", "mug"])


def test_images_of_another_size_are_resized():
    backbone = Colors()
    assert backbone(torch.rand(2, 3, 20, 20)).shape == (2, 6)


@pytest.mark.parametrize("at_once", [1, 4, 100])
def test_features_do_not_depend_on_the_batch_size_of_a_frozen_trunk(at_once, monkeypatch):
    backbone = Colors()
    images = torch.rand(9, 3, 8, 8, generator=torch.Generator().manual_seed(0)) * 2 - 1
    together = backbone.trunk_features(images)
    monkeypatch.setattr("lp_framework.models.backbones.ON_CPU", at_once)
    torch.testing.assert_close(backbone.trunk(images), together)
    assert backbone.trunk(images[:0]).shape == (0, backbone.trunk_dim)


def test_a_fingerprint_changes_with_the_trunks_weights_alone():
    backbone = Colors()
    before = backbone.fingerprint()
    with torch.no_grad():
        backbone.head.weight += 1
    assert backbone.fingerprint() == before
    with torch.no_grad():
        backbone.net[0].weight[0, 0, 0, 0] += 1e-3
    assert backbone.fingerprint() != before


# ---------------------------------------------------------------- built-in backbones


@pytest.fixture
def no_network(monkeypatch):
    torchvision_ops.ensure()
    from torchvision.models import WeightsEnum

    def fail(self: object, *arguments: object, **options: object) -> None:
        raise URLError("no route to host")

    monkeypatch.setattr(WeightsEnum, "get_state_dict", fail)


def test_a_resnet_without_network_warns_and_is_random(no_network):
    with pytest.warns(UserWarning, match=r"ImageNet weights of resnet18 did not load .*no route to host.*random"):
        first = ResNet("resnet18", image_size=32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        second = ResNet("resnet18", pretrained=False, image_size=32)
    assert first.fingerprint() != second.fingerprint()
    assert first.feature_dim == first.trunk_dim == 512
    assert first(torch.rand(2, 3, 32, 32) * 2 - 1).isfinite().all()


def test_the_papers_resnet_has_2048_features_and_is_trained():
    backbone = ResNet(pretrained=False, image_size=32).train()
    assert backbone.feature_dim == 2048
    assert backbone(torch.rand(2, 3, 40, 40) * 2 - 1).shape == (2, 2048)
    assert not backbone.frozen
    assert backbone.resnet.training
    assert all(parameter.requires_grad for parameter in backbone.resnet.parameters())


def test_an_unknown_resnet_is_named_with_the_nearest():
    with pytest.raises(UserError, match=r"arch=resnet5 does not fit.*resnet101; did you mean 'resnet50'"):
        registry.build("backbone", {"name": "resnet", "arch": "resnet5"})


def test_efficientnet_brings_real_weights_without_network(no_network):
    backbone = EfficientNetLite0().eval()
    assert backbone.frozen
    images = torch.rand(2, 3, 224, 224, generator=torch.Generator().manual_seed(0)) * 2 - 1
    features = backbone.trunk(images)
    assert features.shape == (2, backbone.trunk_dim)
    assert backbone.head(features).shape == (2, backbone.feature_dim)
    assert backbone.fingerprint() == EfficientNetLite0().fingerprint()
    assert (features[0] - features[1]).abs().max() > 1e-3


@pytest.mark.parametrize("name", ["score", "energy"])
def test_a_misspelt_setting_of_a_model_is_named(name):
    with pytest.raises(UserError, match="did you mean 'periodic'"):
        registry.build("model", {"name": name, "target": "perodic"}, backbone=Colors())


# ---------------------------------------------------------------- standardised features


def test_standardise_uses_the_mean_and_spread_of_all_batches():
    features = 3 * torch.randn(1000, 5, generator=torch.Generator().manual_seed(0)) + 7
    layer = Standardise(5).train()
    for batch in features.split([1, 299, 130, 570]):
        layer(batch)
    torch.testing.assert_close(layer.mean, features.mean(dim=0))
    torch.testing.assert_close(layer.variance, features.var(dim=0, unbiased=False))
    spread = layer.eval()(features).std(dim=0)
    assert ((spread > 0.9) & (spread < 1)).all()


def test_standardise_does_not_use_the_batchs_own_statistics():
    layer = Standardise(3).train()
    layer(torch.randn(500, 3, generator=torch.Generator().manual_seed(1)))
    one_object = torch.full((8, 3), 2.0)
    assert (layer.eval()(one_object) > 1.5).all()  # batch normalisation would give 0
