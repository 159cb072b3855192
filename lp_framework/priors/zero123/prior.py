"""Zero123 as an energy over relative poses and a generator of novel views."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from lp_framework.errors import UserError, positive
from lp_framework.priors.base import Prior, ViewCode, resized
from lp_framework.priors.ddim import ddim_sample, guided, scaled_linear_alphas, standard_normal
from lp_framework.priors.zero123.cuda_graph import Replayed
from lp_framework.priors.zero123.networks import Attention, Dtype, Networks, choose_attention
from lp_framework.priors.zero123.original import Averages
from lp_framework.priors.zero123.weights import load_networks
from lp_framework.registry import register

IMAGE_SIZE = 256  # some configs of published folders have the sizes of Stable Diffusion instead
GRAD_SCALE = 4096  # prevents small gradients from vanishing in float16; a power of two is exact
SCALE = 0.18215  # factor on latents before noise is added; the latent of the source is not scaled
CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)

_Result = TypeVar("_Result")


def conditioning_vector(pose: Tensor) -> Tensor:
    """T = [-dlatitude, sin dlongitude, cos dlongitude, dradius] `[..., 4]` of relative poses `[..., 3]`.

    Zero123 (section 3.2) measures the polar angle down from the pole, hence the sign of the first entry.

    >>> conditioning_vector(torch.tensor([0.2, 0.0, -0.5]))
    tensor([-0.2000,  0.0000,  1.0000, -0.5000])
    """
    latitude, longitude, radius = pose.unbind(-1)
    return torch.stack([-latitude, longitude.sin(), longitude.cos(), radius], dim=-1)


class Chunks:
    """Runs a function on slices of a batch, at most `size` long (None: the whole batch).

    When the GPU runs out of memory, `release` frees what it can and returns whether it freed anything. If it did not,
    `size` is halved permanently. Then the rest of the batch is retried.
    """

    def __init__(self, size: int | None, release: Callable[[], bool] | None = None) -> None:
        self.size, self.release = size, release

    def run(self, function: Callable[[slice], _Result], batch: int) -> list[_Result]:
        """The results for `slice(0, size)`, `slice(size, 2 * size)`, ... of a batch."""
        results: list[_Result] = []
        start = 0
        while start < batch:
            stop = min(start + (self.size or batch), batch)
            try:
                results.append(function(slice(start, stop)))
            except torch.cuda.OutOfMemoryError:
                if self.release is None or not self.release():
                    if stop - start == 1:
                        raise
                    self.size = (stop - start) // 2
            else:
                start = stop
                continue
            torch.cuda.empty_cache()  # by now the exception and the failed attempt's tensors are freed
        return results


class StoredGradient(torch.autograd.Function):
    """Energies `[B]` of poses `[B, 3]`, each depending only on its own pose. `both` also computes the gradients, chunk
    by chunk, and these are stored instead of activations. Differentiable once; for higher orders use the residual."""

    @staticmethod
    def forward(pose: Tensor, both: Callable[[slice], tuple[Tensor, Tensor]], chunks: Chunks) -> tuple[Tensor, Tensor]:
        energies, gradients = zip(*chunks.run(both, len(pose)), strict=True)
        return torch.cat(energies), torch.cat(gradients)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(output[1])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor, _: Tensor) -> tuple[Tensor, None, None]:
        (gradients,) = ctx.saved_tensors
        return grad[:, None] * gradients, None, None


class Zero123Prior(Prior):
    """Zero123's four networks, in any dtype; poses, their projection and energies are always float32.

    With `cuda_graph`, the energy and its gradient are recorded once per batch size and then replayed, which saves a
    thousand kernel launches per step. If the GPU runs out of memory, `max_batch` is halved.
    """

    def __init__(
        self,
        networks: Networks,
        channels_last: bool = False,
        compile: bool = False,
        cuda_graph: bool = False,
        attention: Attention = "sdpa",
        max_batch: int | None = None,
    ) -> None:
        super().__init__()
        if max_batch is not None and max_batch < 1:
            raise UserError(f"prior.max_batch must be at least 1, got {max_batch}")
        self.unet, self.vae, self.image_encoder = networks.unet, networks.vae, networks.image_encoder
        self.cc_projection = networks.cc_projection
        self.cc_projection.float()  # small, and it processes the pose
        choose_attention(self.unet, attention)
        if channels_last:
            self.unet.to(memory_format=torch.channels_last)
        if compile:
            # Inductor's layout optimization gives wrong gradients (30% off) on CPUs, seen with PyTorch 2.13.
            self.unet.compile(options={"layout_optimization": False})
        self.eval().requires_grad_(False)
        side = IMAGE_SIZE // 2 ** (len(self.vae.config.block_out_channels) - 1)
        self.image_size, self.latent_shape = IMAGE_SIZE, (int(self.vae.config.latent_channels), side, side)
        self.channels_last, self.cuda_graph, self.replayed = channels_last, cuda_graph, Replayed()
        self.chunks, self.image_chunks = (Chunks(max_batch, self.replayed.forget) for _ in range(2))
        self.alphas_cumprod = nn.Buffer(scaled_linear_alphas(), persistent=False)
        self.clip_mean = nn.Buffer(torch.tensor(CLIP_MEAN).view(3, 1, 1), persistent=False)
        self.clip_std = nn.Buffer(torch.tensor(CLIP_STD).view(3, 1, 1), persistent=False)
        self.num_timesteps = len(self.alphas_cumprod)

    def _apply(self, function: Any, recurse: bool = True) -> Any:
        self.replayed.forget()  # called whenever the module is moved or converted
        return super()._apply(function, recurse)

    @torch.no_grad()
    def encode(self, images: Tensor) -> ViewCode:
        """See `Prior.encode`: the unscaled mode of the autoencoder's posterior, and CLIP's embedding `[B, 1, 768]`."""
        images = resized(images, self.image_size)
        parts = self.image_chunks.run(lambda part: self._encode(images[part]), len(images))
        latents, embeddings = zip(*parts, strict=True)
        return ViewCode(torch.cat(latents), torch.cat(embeddings))

    def _encode(self, images: Tensor) -> tuple[Tensor, Tensor]:
        latent = self.vae.encode(images.to(self.vae.dtype)).latent_dist.mode().float()
        # The published code resizes for CLIP with bicubic interpolation and aligned corners, without antialiasing.
        side: Any = self.image_encoder.config.image_size
        small = functional.interpolate(images.float(), [side, side], mode="bicubic", align_corners=True)
        pixels = ((small + 1) / 2 - self.clip_mean) / self.clip_std
        embedding = self.image_encoder(pixel_values=pixels.to(self.image_encoder.dtype)).image_embeds.float()
        return latent, embedding[:, None]

    @torch.no_grad()
    def decode(self, latent: Tensor) -> Tensor:
        """Decode unscaled latents `[B, *latent_shape]` to images `[B, 3, image_size, image_size]`, not clipped."""
        parts = self.image_chunks.run(lambda part: self.vae.decode(latent[part].to(self.vae.dtype)).sample, len(latent))
        return torch.cat(parts).float()

    def token(self, embedding: Tensor, pose: Tensor) -> Tensor:
        """The condition `[B, 1, 768]`: the projection of the source's embedding `[B, 1, 768]` and the pose's T."""
        vector = conditioning_vector(pose).to(embedding.dtype)
        return self.cc_projection(torch.cat([embedding, vector[:, None]], dim=-1))

    def residual(self, target: ViewCode, source: ViewCode, pose: Tensor, timestep: Tensor, noise: Tensor) -> Tensor:
        """See `Prior.residual`: epsilon_theta(z_t, t, source, T) - epsilon, with z_t = q(z_t | z_0) of the target."""
        self.check(target, source, pose, timestep, noise)
        parts = self.chunks.run(
            lambda part: self._residual(target[part], source[part], pose[part], timestep[part], noise[part]), len(pose)
        )
        return torch.cat(parts)

    def _residual(self, target: ViewCode, source: ViewCode, pose: Tensor, timestep: Tensor, noise: Tensor) -> Tensor:
        alpha = self.alphas_cumprod[timestep].view(-1, 1, 1, 1)  # alpha-bar_t
        noisy = alpha.sqrt() * SCALE * target.latent + (1 - alpha).sqrt() * noise  # z_t
        return self.predict(noisy, source.latent, self.token(source.embedding, pose), timestep) - noise

    def predict(self, noisy: Tensor, condition: Tensor, token: Tensor, timestep: Tensor) -> Tensor:
        """epsilon_theta `[B, *latent_shape]` (float32) of a chunk, given noised latents, source latents and tokens."""
        latents = torch.cat([noisy, condition], dim=1).to(self.unet.dtype)
        if self.channels_last:
            latents = latents.contiguous(memory_format=torch.channels_last)
        token = token.to(self.unet.dtype)
        return self.unet(latents, timestep, encoder_hidden_states=token, return_dict=False)[0].float()

    def denoising_error(
        self, target: ViewCode, source: ViewCode, pose: Tensor, timestep: Tensor, noise: Tensor
    ) -> Tensor:
        """See `Prior.denoising_error`. Gradients are computed with the values, so memory is that of one chunk."""
        self.check(target, source, pose, timestep, noise)
        inputs = pose, target.latent, source.latent, source.embedding, timestep, noise
        if pose.requires_grad and torch.is_grad_enabled():
            function = self._energy_and_grad
            both = partial(self.replayed, function) if self.cuda_graph else function
            energies, _ = StoredGradient.apply(pose, lambda part: both(*(each[part] for each in inputs)), self.chunks)
            return energies
        return torch.cat(self.chunks.run(lambda part: self._energy(*(each[part] for each in inputs)), len(pose)))

    def _energy(
        self, pose: Tensor, target: Tensor, source: Tensor, embedding: Tensor, timestep: Tensor, noise: Tensor
    ) -> Tensor:
        codes = ViewCode(target, embedding), ViewCode(source, embedding)  # the target's embedding is unused
        return self._residual(*codes, pose, timestep, noise).square().flatten(1).mean(dim=1)

    def _energy_and_grad(self, pose: Tensor, *others: Tensor) -> tuple[Tensor, Tensor]:
        with torch.enable_grad():
            pose = pose.detach().requires_grad_()
            energies = self._energy(pose, *others)
            (gradient,) = torch.autograd.grad(GRAD_SCALE * energies.sum(), pose)
        return energies.detach(), gradient / GRAD_SCALE

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
        # The defaults are those of Zero123's and iFusion's published code.
        token = self.token(source.embedding, pose.float())

        def predict(latent: Tensor, timestep: int) -> Tensor:
            """The guided prediction; the null condition is a zero token and a zero latent."""

            def of(part: slice) -> Tensor:
                noisy, image, context = latent[part], source.latent[part], token[part]
                time = torch.full((len(noisy),), timestep, device=noisy.device)
                if guidance == 1:
                    return self.predict(noisy, image, context, time)
                image, context = (torch.cat([torch.zeros_like(each), each]) for each in (image, context))
                free, conditioned = self.predict(noisy.repeat(2, 1, 1, 1), image, context, time.repeat(2)).chunk(2)
                return guided(free, conditioned, guidance)

            return torch.cat(self.chunks.run(of, len(latent)))

        start = standard_normal(pose.new_empty(len(pose), *self.latent_shape), generator).float()
        latent = ddim_sample(predict, start, self.alphas_cumprod, steps, eta, generator)
        return self.decode(latent / SCALE).clamp(-1, 1)


@register("prior", "zero123")
class Zero123(Zero123Prior):
    """Zero123: `path` is its checkpoint (105000.ckpt), a folder in diffusers' layout, or a Hugging Face id.

    `weights` selects the moving averages (as in iFusion) or the raw weights (as in ID-Pose) of a checkpoint file.
    """

    PUBLISHED = "kxic/zero123-105000"  # a Hugging Face id

    def __init__(
        self,
        path: str | None = None,
        revision: str | None = None,
        weights: Averages = "ema",
        dtype: Dtype = "float32",
        channels_last: bool = False,
        compile: bool = False,
        cuda_graph: bool = False,
        attention: Attention = "sdpa",
        max_batch: int | None = None,
        usual_error: float | None = None,
    ) -> None:
        networks = load_networks(self.PUBLISHED if path is None else path, revision, weights, dtype)
        super().__init__(networks, channels_last, compile, cuda_graph, attention, max_batch)
        if usual_error is not None:
            positive("prior", usual_error=usual_error)
        self.usual_error = usual_error


@register("prior", "zero123xl")
class Zero123XL(Zero123):
    """Zero123-XL, trained on Objaverse-XL; like `zero123`, with checkpoint zero123-xl.ckpt."""

    PUBLISHED = "kxic/zero123-xl"
