"""The tiny prior: energy over relative poses, generation of novel views, and training (`model=prior`)."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from lp_framework.data.files import read_json
from lp_framework.data.module import FeatureExtractor
from lp_framework.data.pairs import PairBatch
from lp_framework.errors import UserError, at_least, check_settings, positive
from lp_framework.keyed_random import keyed_bits, keyed_normal
from lp_framework.models.backbones import Backbone
from lp_framework.models.checkpoints import FOLDER, SHIPPED, find_checkpoint, read_checkpoint, restore
from lp_framework.models.pair_mean import PairMean
from lp_framework.models.trained_module import TrainedModule
from lp_framework.models.view_head import relative_pose_loss
from lp_framework.priors.base import Prior, ViewCode
from lp_framework.priors.ddim import ddim_sample, guided, scaled_linear_alphas, standard_normal
from lp_framework.priors.tiny.networks import IMAGE_SIZE, Gaussian, TinyNetworks, predicted_noise, readout, shrink
from lp_framework.registry import register

Denoised = tuple[Tensor, Gaussian]
DECODED = 16  # images per step for training the decoder, which is the most expensive part


class TrunkAndPixels:
    """The cached part of an image: the features of a frozen trunk, followed by the pixels of the downsized image."""

    def __init__(self, backbone: Backbone) -> None:
        self.backbone, self.to = backbone, backbone.to

    def trunk(self, images: Tensor) -> Tensor:
        """`[I, trunk_dim + 3 * 64 * 64]` of images `[I, 3, H, W]`."""
        return torch.cat([self.backbone.trunk(images), shrink(images)], dim=1)

    def fingerprint(self) -> str:
        """See `FeatureExtractor`."""
        return f"{self.backbone.fingerprint()} and pixels"


@register("model", "prior")
class PriorModel(TrainedModule):
    """The tiny prior: a pose-conditioned diffusion model of small images, trained by denoising (Ho et al. 2020)."""

    def __init__(
        self,
        backbone: Backbone,
        latent_dim: int = 192,
        scale: float = 0.5,
        orders: int = 4,
        width: int = 384,
        layers: int = 3,
        view_loss: float = 1.0,
        optimizer: Literal["adam", "adamw"] = "adamw",
        learning_rate: float = 2e-3,
        weight_decay: float = 1e-2,
        schedule: Literal["cosine", "constant"] = "cosine",
        seed: int = 0,
    ) -> None:
        super().__init__(backbone, optimizer, learning_rate, weight_decay, schedule, seed)
        at_least(1, "model", orders=orders, width=width)
        at_least(0, "model", layers=layers, view_loss=view_loss)
        positive("model", scale=scale)
        check_settings("model", ("latent_dim", latent_dim, 1 <= latent_dim <= 3072, "from 1 to 3072"))
        self.networks = TinyNetworks(backbone.feature_dim, latent_dim, scale, orders, width, layers)
        self.view_loss = view_loss
        self.alphas_cumprod = nn.Buffer(scaled_linear_alphas(), persistent=False)
        self.validation_loss = PairMean()

    def extractor(self) -> FeatureExtractor | None:
        return TrunkAndPixels(self.backbone) if self.backbone.frozen else None

    def on_fit_start(self) -> None:
        """Fit the latents' basis to the training views; a resumed run already has it."""
        if self.networks.latents.spread.any():
            return
        data = self.trainer.datamodule.data("train")  # type: ignore[attr-defined]
        views = torch.arange(len(data.table))
        alone = [data[part[:, None].expand(-1, 2).numpy()] for part in views.split(256)]  # pairs of a view with itself
        self.networks.latents.fit(torch.cat([self._pixels(batch) for batch in alone]).to(self.device))

    def code(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Latents `[I, latent_dim]` and codes `[I, code_dim]` of images `[I, 3, H, W]` in [-1, 1]."""
        return self.networks.latents(shrink(images)), self.networks.encoder(self.backbone(images))

    def training_step(self, batch: PairBatch, batch_idx: int) -> Tensor:
        pixels = self._pixels(batch)
        code, latents = self.networks.encoder(self._features(batch)), self.networks.latents(pixels)
        generator = self._generator()
        timestep = torch.randint(len(self.alphas_cumprod), (len(batch),), generator=generator).to(self.device)
        noise = torch.randn(len(batch), latents.shape[1], generator=generator).to(self.device)
        source, pose = code[batch.reference], batch.relative_poses()
        residual, predicted = self.residual(source, pose, latents[batch.query], timestep, noise)
        view_loss = relative_pose_loss(readout(code, self.networks.orders), batch)

        # The decoder is trained on what it decodes later: latents of views, and samples of the predictions.
        chosen = torch.randperm(len(batch), generator=generator)[:DECODED].to(self.device)
        seen = torch.arange(len(chosen), device=self.device)[:, None] % 2 == 0
        query = batch.query[chosen]
        sampled = (predicted.mean + predicted.log_spread.exp() * noise)[chosen].detach()
        image = self.networks.decoder(torch.where(seen, latents[query], sampled))
        image_loss = functional.mse_loss(image.flatten(1), pixels[query])

        loss = residual.square().mean(dim=1).mean()
        for name, value in (("loss", loss), ("view_loss", view_loss), ("image_loss", image_loss)):
            self.log(f"train/{name}", value, prog_bar=name == "loss", batch_size=len(batch))
        return loss + self.view_loss * view_loss + image_loss

    def validation_step(self, batch: PairBatch, batch_idx: int) -> None:
        latents, ids = self.networks.latents(self._pixels(batch)), batch.ids
        timestep = keyed_bits(self.seed, ids, count=1).squeeze(-1).to(self.device) % len(self.alphas_cumprod)
        noise = keyed_normal(self.seed, ids, count=latents.shape[1]).to(latents)
        source, pose = self.networks.encoder(self._features(batch))[batch.reference], batch.relative_poses()
        residual, _ = self.residual(source, pose, latents[batch.query], timestep, noise)
        self.validation_loss.update(ids, residual.square().mean(dim=1))
        self.log("val/loss", self.validation_loss, prog_bar=True, on_step=False, on_epoch=True, batch_size=len(batch))

    def _features(self, batch: PairBatch) -> Tensor:
        if batch.features is None:
            return self.backbone(batch.images)
        return self.backbone.head(batch.features[:, : self.backbone.trunk_dim])

    def _pixels(self, batch: PairBatch) -> Tensor:
        return shrink(batch.images) if batch.features is None else batch.features[:, self.backbone.trunk_dim :]

    def residual(self, code: Tensor, pose: Tensor, latents: Tensor, timestep: Tensor, noise: Tensor) -> Denoised:
        """Predicted minus true noise `[P, D]` of noised latents given source codes, and the predicted `Gaussian`."""
        alpha = self.alphas_cumprod[timestep][:, None]
        noisy = alpha.sqrt() * latents + (1 - alpha).sqrt() * noise
        predicted = self.networks.predict(code, pose)
        return predicted_noise(noisy, alpha, predicted) - noise, predicted


@register("prior", "tiny")
class TinyPrior(Prior):
    """A small diffusion model, bundled with weights trained on the embedded objects.

    Set `path` to use your own: a run of `train model=prior`, or a folder made from it by `convert`. The prediction for
    the target's latents is a Gaussian whose mean and spread depend on source and pose. The denoiser therefore has a
    closed form and cannot infer the pose from the noised target, so the energy depends on the pose at every timestep.
    """

    def __init__(self, path: str | None = None) -> None:
        super().__init__()
        file = find_checkpoint(SHIPPED / "tiny" if path is None else path)
        model = restore(file, read_checkpoint(file))
        if not isinstance(model, PriorModel):
            raise UserError(f"{file}: contains a pose model, not a prior; use it with checkpoint={path}")
        self.model = model
        self.num_timesteps = len(self.model.alphas_cumprod)
        self.latent_shape = (self.model.networks.latent_dim, 1, 1)
        self.image_size = IMAGE_SIZE
        run = file.parents[1] if file.parent.name == FOLDER else file.parent
        if (run / "training.json").is_file():
            self.usual_error = read_json(run / "training.json").get("final", {}).get("val/loss")

    @torch.no_grad()
    def encode(self, images: Tensor) -> ViewCode:
        """See `Prior.encode`: principal components `[B, D, 1, 1]`, and a steerable code `[B, 1, code_dim]`."""
        latents, codes = self.model.code(images.float())
        return ViewCode(latents[..., None, None], codes[:, None])

    def residual(self, target: ViewCode, source: ViewCode, pose: Tensor, timestep: Tensor, noise: Tensor) -> Tensor:
        self.check(target, source, pose, timestep, noise)
        latent, code = target.latent.flatten(1), source.embedding[:, 0]
        residual, _ = self.model.residual(code, pose, latent, timestep, noise.flatten(1))
        return residual[..., None, None]

    @torch.no_grad()
    def generate(
        self,
        source: ViewCode,
        pose: Tensor,
        steps: int = 50,
        guidance: float = 3.0,
        generator: torch.Generator | None = None,
        eta: float = 1.0,
    ) -> Tensor:
        networks, alphas = self.model.networks, self.model.alphas_cumprod
        predicted, spread = networks.predict(source.embedding[:, 0], pose.float()), networks.latents.spread
        anything = Gaussian(torch.zeros_like(spread), spread.clamp(min=1e-6).log())  # of all training views

        def predict(latent: Tensor, timestep: int) -> Tensor:
            free, conditional = (predicted_noise(latent, alphas[timestep], each) for each in (anything, predicted))
            return guided(free, conditional, guidance)

        start = standard_normal(predicted.mean, generator)
        return networks.decoder(ddim_sample(predict, start, alphas, steps, eta, generator))
