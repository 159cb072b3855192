"""The score model and the energy model of the relative pose, as LightningModules."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from lp_framework.data.pairs import PairBatch
from lp_framework.errors import UserError, at_least, check_settings
from lp_framework.keyed_random import keyed_normal, keyed_uniform
from lp_framework.models.backbones import Backbone
from lp_framework.models.networks import PoseNetwork
from lp_framework.models.objectives import NoisedPose, PoseKernel
from lp_framework.models.pair_mean import PairMean
from lp_framework.models.trained_module import TrainedModule
from lp_framework.models.view_head import relative_pose_loss
from lp_framework.registry import register

VALIDATION_NOISES = 4  # noised poses per validation pair
# Relative poses of views with latitudes in [-30, 30] degrees and radii in [1.2, 2.0].
LOW, HIGH = (-math.pi / 3, 0.0, -0.8), (math.pi / 3, 2 * math.pi, 0.8)


class FieldValue(NamedTuple):
    """The output of a model at given poses: `score` `[..., 3]` and, for energy models, `energy` `[...]`."""

    score: Tensor
    energy: Tensor | None


class PoseModel(TrainedModule):
    """A score or energy of the relative pose, given two images.

    Solvers call `encode` once per image, `condition` once per pair, and then `field` at any poses. *Codes* are tensors
    or other objects that can be indexed like a batch, `codes[pairs.reference]`. A *condition* is a tensor or another
    object that can be indexed along the pairs and unsqueezed, `condition[:, None]`, to broadcast against poses
    `[B, N, 3]`.
    """

    sigma: float  # radians and scene units: the score is (truth - x) / sigma^2 near the truth if it is unique
    kernel: PoseKernel  # of the noise
    has_energy: bool  # whether `field` also returns an energy
    has_density = False  # whether conditions are `PoseDensity`, normalised and known at every sigma
    choose_by: Literal["distance", "energy"] = "distance"  # how to pick the best final pose, see solver=langevin

    @abstractmethod
    def encode(self, images: Tensor) -> Any:
        """Codes of images `[I, 3, H, W]` in [-1, 1]."""

    @abstractmethod
    def condition(self, reference: Any, query: Any) -> Any:
        """The condition of P pairs, given the codes of their references and queries."""

    @abstractmethod
    def field(self, condition: Any, pose: Tensor) -> FieldValue:
        """Score (and energy) at relative poses `[..., 3]`, at the model's `sigma`."""

    def modes(self, condition: Any, count: int) -> Tensor:
        """The most likely poses `[P, count, 3]`, best first; `UserError` if the model has no density."""
        raise UserError("start=modes needs model=matching; the modes of score and energy networks are not known")

    def probability(self, condition: Any, pose: Tensor, degrees: float = 30.0) -> Tensor | None:
        """The probability `[...]` that the true rotation is within `degrees` of that of relative poses `[..., 3]`.

        None for a model without a density.
        """
        return None

    def at_sigma(self, condition: Any, sigma: float) -> Any:
        """The condition for evaluating `field` at another `sigma`; `UserError` if the model has only one."""
        raise UserError(
            "solver.sigma needs model=matching, whose field is known at every sigma; that of score and energy networks "
            f"is known only at the sigma of their training, {self.sigma:g}"
        )


class DenoisingModel(PoseModel):
    """A network on the pooled features of two images; subclasses define the meaning of its output."""

    outputs: int  # of the network

    def __init__(
        self,
        backbone: Backbone,
        target: Literal["periodic", "line"] = "periodic",
        noise: Literal["uniform", "gaussian"] = "uniform",
        sigma: float = 1.0,
        noise_low: Sequence[float] = LOW,
        noise_high: Sequence[float] = HIGH,
        hidden: int = 256,
        layers: int = 3,
        frequencies: int = 4,
        dropout: float = 0.0,
        view_loss: float = 1.0,
        optimizer: Literal["adam", "adamw"] = "adamw",
        learning_rate: float = 2e-3,
        weight_decay: float = 1e-2,
        schedule: Literal["cosine", "constant"] = "cosine",
        seed: int = 0,
    ) -> None:
        super().__init__(backbone, optimizer, learning_rate, weight_decay, schedule, seed)
        at_least(1, "model", hidden=hidden, frequencies=frequencies)
        at_least(0, "model", layers=layers, view_loss=view_loss)
        check_settings("model", ("dropout", dropout, 0 <= dropout < 1, "in [0, 1)"))
        self.sigma, self.kernel = sigma, PoseKernel(target, sigma)
        self.noised_pose = NoisedPose(noise, sigma, noise_low, noise_high)
        self.network = PoseNetwork(
            backbone.feature_dim, self.outputs, hidden, layers, frequencies, self.kernel.periodic, dropout
        )
        # The linear readout of `relative_pose_loss`; checkpoints contain it under this name.
        self.view_head = nn.ModuleDict({"readout": nn.Linear(backbone.feature_dim, 4)} if view_loss > 0 else {})
        self.view_loss = view_loss
        self.validation_loss = PairMean()

    def encode(self, images: Tensor) -> Tensor:
        """Codes `[I, D]` of images `[I, 3, H, W]` in [-1, 1]."""
        return self.backbone(images)

    def condition(self, reference: Tensor, query: Tensor) -> Tensor:
        """The condition `[P, hidden]` of P pairs, given codes `[P, D]` of references and queries."""
        return self.network.project(reference, query)

    @abstractmethod
    def pair_loss(self, condition: Tensor, noised: Tensor, true: Tensor) -> Tensor:
        """The objective for each noised pose `[...]`."""

    def training_step(self, batch: PairBatch, batch_idx: int) -> Tensor:
        features = self._features(batch)
        true = batch.relative_poses()
        noised = self.noised_pose.draw(true, self._generator())
        condition = self.condition(features[batch.reference], features[batch.query])
        loss = self.pair_loss(condition, noised, true).mean()
        self.log("train/loss", loss, prog_bar=True, batch_size=len(batch))
        if self.view_loss > 0:
            view_loss = relative_pose_loss(self.view_head["readout"](features), batch)
            self.log("train/view_loss", view_loss, batch_size=len(batch))
            loss = loss + self.view_loss * view_loss
        return loss

    def validation_step(self, batch: PairBatch, batch_idx: int) -> None:
        features, ids = self._features(batch), batch.ids
        true = batch.relative_poses()[:, None].expand(-1, VALIDATION_NOISES, -1)
        noised = self._validation_noise(true, ids)
        condition = self.condition(features[batch.reference], features[batch.query])[:, None]
        loss = self.pair_loss(condition, noised, true).mean(dim=1)
        self.validation_loss.update(ids, loss)
        self.log("val/loss", self.validation_loss, prog_bar=True, on_step=False, on_epoch=True, batch_size=len(batch))

    def _features(self, batch: PairBatch) -> Tensor:
        if batch.features is not None:
            features: Tensor = self.backbone.head(batch.features)
            return features
        return self.encode(batch.images)

    def _validation_noise(self, true: Tensor, pairs: Tensor) -> Tensor:
        """Noised poses keyed by pair: independent of epoch, batch size and number of processes."""
        count = true.shape[1] * 3
        if self.noised_pose.noise == "gaussian":
            return true + self.noised_pose.sigma * keyed_normal(self.seed, pairs, count=count).view(true.shape).to(true)
        return self.noised_pose.place(keyed_uniform(self.seed, pairs, count=count).view(true.shape).to(true))


@register("model", "score")
class ScoreModel(DenoisingModel):
    """Score network trained by denoising score matching (paper, Eq. 3)."""

    has_energy, outputs = False, 3

    def field(self, condition: Tensor, pose: Tensor) -> FieldValue:
        return FieldValue(self.network(condition, pose), None)

    def pair_loss(self, condition: Tensor, noised: Tensor, true: Tensor) -> Tensor:
        """1/2 |s(noised) - grad log p(noised | true)|^2, `[...]`."""
        error = self.network(condition, noised) - self.kernel.score(noised, true)
        return 0.5 * error.square().sum(dim=-1)


@register("model", "energy")
class EnergyModel(DenoisingModel):
    """Energy network trained on its closed-form target (paper, appendix "Energy-based Modeling")."""

    has_energy, outputs = True, 1

    def energy(self, condition: Tensor, pose: Tensor) -> Tensor:
        """-log p(pose | pair) up to a constant, `[...]`."""
        return self.network(condition, pose).squeeze(-1)

    def field(self, condition: Tensor, pose: Tensor) -> FieldValue:
        """The score is the negative gradient of the energy with respect to the pose."""
        with torch.inference_mode(False), torch.enable_grad():
            # Clones, because tensors made in inference mode cannot take part in autograd.
            variable = pose.detach().clone().requires_grad_()
            energy = self.energy(condition.detach().clone(), variable)
            (gradient,) = torch.autograd.grad(energy.sum(), variable)
        return FieldValue(-gradient, energy.detach())

    def pair_loss(self, condition: Tensor, noised: Tensor, true: Tensor) -> Tensor:
        """1/2 |E(noised) + log p(noised | true)|^2, `[...]`, without the constant of log p."""
        return 0.5 * (self.energy(condition, noised) - self.kernel.energy(noised, true)).square()
