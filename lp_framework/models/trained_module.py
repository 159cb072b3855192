"""What all trained modules share: optimiser and rate, keyed noise, and checkpoints without the frozen trunk."""

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
WEIGHTS = {"state_dict", "current_model_state"}  # where a checkpoint has weights; the second is of a moving average


class TrainedModule(LightningModule):
    """A LightningModule on a backbone. With its `recipe` every checkpoint tells how to build it again."""

    recipe: Mapping[str, Any] | None = None

    carries_points = False  # whether its batches have the points in space that their views show

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
        self._micro_batch = 0  # of an optimiser step, with trainer.accumulate_grad_batches

    def extractor(self) -> FeatureExtractor | None:
        """What of an image the data module shall compute once and cache: the frozen trunk's features; else nothing."""
        return self.backbone if self.backbone.frozen else None

    def on_train_batch_start(self, batch: PairBatch, batch_idx: int) -> None:
        """Dropout draws from the global generator: keyed as the noise is, apart from it."""
        self._micro_batch = batch_idx % self.trainer.accumulate_grad_batches
        torch.manual_seed(self._step_key() + (1 << 62))

    def _generator(self) -> torch.Generator:
        """Noise keyed by seed, step, micro-batch and process, so resumed runs draw the same; on the CPU."""
        return torch.Generator().manual_seed(self._step_key())

    def _step_key(self) -> int:
        step = (self.seed * 1_000_003 + self.global_step) * 1_009 + self.global_rank
        return step + 0x9E3779B9 * self._micro_batch  # far apart in the 32 bits that a generator on the CPU heeds

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
        """A frozen trunk comes with its backbone: its fingerprint is kept, its weights are left out."""
        checkpoint[RECIPE] = self.recipe
        if not self.backbone.frozen:
            return
        checkpoint["trunk"] = self.backbone.fingerprint()
        trunk = set(self._trunk_keys())
        for state in WEIGHTS & checkpoint.keys():
            checkpoint[state] = {key: value for key, value in checkpoint[state].items() if key not in trunk}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Put the frozen trunk's weights back; `UserError` where the rest was trained on another trunk."""
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
