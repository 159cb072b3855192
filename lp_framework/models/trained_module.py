"""Base class of all trained modules: optimizer and schedule, keyed noise, checkpoints without the frozen trunk."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import torch
from lightning import LightningModule

from lp_framework.data.module import FeatureExtractor
from lp_framework.data.pairs import PairBatch
from lp_framework.errors import UserError, at_least
from lp_framework.models.backbones import Backbone

RECIPE = "lp_framework"  # key in a checkpoint: the configs of model and backbone, by registered name
WEIGHTS = {"state_dict", "current_model_state"}  # keys of weights in a checkpoint; the second with a moving average


class TrainedModule(LightningModule):
    """A LightningModule on a backbone. Checkpoints contain its `recipe`, from which it can be rebuilt."""

    recipe: Mapping[str, Any] | None = None

    needs_points = False  # whether its batches include the 3-D points visible in their views

    def __init__(
        self,
        backbone: Backbone,
        optimizer: Literal["adam", "adamw"],
        learning_rate: float,
        weight_decay: float,
        schedule: Literal["cosine", "constant"],
        seed: int,
    ) -> None:
        super().__init__()
        at_least(0, "model", learning_rate=learning_rate, weight_decay=weight_decay)
        self.backbone = backbone
        self.optimizer, self.learning_rate, self.weight_decay = optimizer, learning_rate, weight_decay
        self.schedule, self.seed = schedule, seed
        self._micro_batch = 0  # index within an optimizer step, for trainer.accumulate_grad_batches

    def extractor(self) -> FeatureExtractor | None:
        """The feature extractor whose outputs the data module caches: the frozen trunk, or None if it is trained."""
        return self.backbone if self.backbone.frozen else None

    def on_train_batch_start(self, batch: PairBatch, batch_idx: int) -> None:
        """Seed the global generator for dropout, with the same keys as the noise but a separate stream."""
        self._micro_batch = batch_idx % self.trainer.accumulate_grad_batches
        torch.manual_seed(self._step_key() + (1 << 62))

    def _generator(self) -> torch.Generator:
        """A CPU generator keyed by seed, step, micro-batch and process, so that resumed runs draw the same noise."""
        return torch.Generator().manual_seed(self._step_key())

    def _step_key(self) -> int:
        step = (self.seed * 1_000_003 + self.global_step) * 1_009 + self.global_rank
        return step + 0x9E3779B9 * self._micro_batch  # far apart in the 32 bits that a CPU generator uses

    def configure_optimizers(self) -> Any:
        parameters = [parameter for parameter in self.parameters() if parameter.requires_grad]
        kind = torch.optim.AdamW if self.optimizer == "adamw" else torch.optim.Adam
        optimizer = kind(parameters, lr=self.learning_rate, weight_decay=self.weight_decay)
        if self.schedule == "constant":
            return optimizer
        total = int(self.trainer.estimated_stepping_batches)
        warm_up = max(1, min(200, total // 10))

        def factor(step: int) -> float:
            return min(1.0, (step + 1) / warm_up) * 0.5 * (1 + math.cos(math.pi * min(1.0, step / total)))

        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Save the recipe; for a frozen trunk, save its fingerprint instead of its weights."""
        checkpoint[RECIPE] = self.recipe
        if not self.backbone.frozen:
            return
        checkpoint["trunk"] = self.backbone.fingerprint()
        trunk = set(self._trunk_keys())
        for state in WEIGHTS & checkpoint.keys():
            checkpoint[state] = {key: value for key, value in checkpoint[state].items() if key not in trunk}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the frozen trunk's weights; raises `UserError` if the model was trained on another trunk."""
        if not self.backbone.frozen:
            return
        if checkpoint.get("trunk") != self.backbone.fingerprint():
            raise UserError(
                "the frozen part of its backbone has other weights here than when the model was trained; "
                "use the same pretrained weights"
            )
        here = self.state_dict()
        for state in WEIGHTS & checkpoint.keys():
            checkpoint[state].update({key: here[key] for key in self._trunk_keys()})

    def _trunk_keys(self) -> list[str]:
        trunk = self.backbone.trunk_module()
        prefix = next(name for name, module in self.named_modules() if module is trunk)
        return [f"{prefix}.{key}" for key in trunk.state_dict()]
