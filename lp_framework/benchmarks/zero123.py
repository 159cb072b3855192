"""Zero123 as `bench` has it: with random weights, at its full or at a narrow size; and its contenders."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor, nn

from lp_framework.benchmarks.harness import Work, worth
from lp_framework.priors.base import Prior, ViewCode
from lp_framework.priors.zero123.networks import (
    DTYPES,
    PUBLISHED,
    Attention,
    Configs,
    Dtype,
    Networks,
    clip_config,
    unet_config,
    vae_config,
)
from lp_framework.priors.zero123.prior import IMAGE_SIZE, Zero123Prior
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.twist import IFusion, SineRadius, TwistPoses

_Prior = TypeVar("_Prior", bound=Prior)
TIMESTEP = 500  # the work is that of any other

Architecture = Literal["published", "narrow"]
NARROW: Configs = {  # the same layers, few and narrow: to try the measurement in seconds
    "unet": unet_config([32, 32], 1, [True, False], heads=4, context=32),
    "vae": vae_config([32, 32, 32, 32], 1),
    "image_encoder": clip_config(width=64, layers=1, patch=32, image_size=224, projection=32),
}
ARCHITECTURES: Mapping[Architecture, Configs] = {"published": PUBLISHED, "narrow": NARROW}


@dataclass(frozen=True)
class Computing:
    """How Zero123 computes: its size, and settings of `prior=zero123`."""

    architecture: Architecture = "published"
    dtype: Dtype = "float32"
    channels_last: bool = False
    compile: bool = False
    cuda_graph: bool = False
    attention: Attention = "sdpa"
    max_batch: int | None = None

    def networks(self, device: torch.device) -> Networks:
        """The four networks, with random weights."""
        with device:
            return Networks(ARCHITECTURES[self.architecture])

    def prior(self, networks: Networks) -> Zero123Prior:
        """A prior with the weights of these networks, whose memory it shares where nothing converts them."""
        # New parameters around the same storage: a conversion of one does not reach the other.
        shared: dict[int, Any] = {id(each): nn.Parameter(each.detach(), False) for each in networks.parameters()}
        own = copy.deepcopy(networks, shared)
        for part in (own.unet, own.vae, own.image_encoder):
            nn.Module.to(part, DTYPES[self.dtype])  # diffusers' own `to` warns of nothing
        settings = self.channels_last, self.compile, self.cuda_graph, self.attention, self.max_batch
        return Zero123Prior(own, *settings).to(own.cc_projection.weight.device)


def random_pair(device: torch.device) -> Pairs:
    """A pair of random images of Zero123's size."""
    index = torch.arange(2, device=device)
    return Pairs(torch.rand(2, 3, IMAGE_SIZE, IMAGE_SIZE, device=device) * 2 - 1, index[:1], index[1:], ids=index[:1])


def encoded(prior: _Prior, codes: ViewCode) -> _Prior:
    """The prior, for images that have been encoded before: neither contender is charged for them."""
    ready = copy.copy(prior)
    ready.encode = lambda images: codes  # type: ignore[method-assign]
    return ready


def batched(prior: Prior, pair: Pairs, starts: Tensor, steps: int) -> Work:
    """Steps of this package's `ifusion` from starts `[1, N, 3]`: all of them and both directions in one batch."""
    return worth(steps, partial(IFusion(prior, steps).solve, pair, starts, 0))


def plain_prior(networks: Networks) -> Zero123Prior:
    """In float32, with attention that spells out its weights: softmax(Q K^T / sqrt(d)) V."""
    from diffusers.models.attention_processor import AttnProcessor

    prior = Computing().prior(networks)
    prior.unet.set_attn_processor(AttnProcessor())
    return prior


class PlainLoop:
    """One start `[3]` of a sequential loop, its costs those of iFusion's published code (`optimize_pose_loop`).

    As there: both images are encoded anew at every step, by the autoencoder once as targets and once as conditions,
    by CLIP as conditions; float32; both directions in one batch of two; attention that spells out its weights; a twist
    that lives on the CPU; a loss that is read at every step, for the plateau scheduler. Left out, and next to free:
    condition dropout, sampling of the posterior, the progress bar.
    """

    def __init__(self, prior: Zero123Prior, images: Tensor, start: Tensor) -> None:
        self.prior, self.total = prior, 0.0
        self.condition, self.target = images, images.flip(0)  # (reference, query) and (query, reference)
        self.poses = TwistPoses(start.cpu(), SineRadius())
        self.twist = torch.zeros(6, requires_grad=True)
        self.optimizer = torch.optim.Adam([self.twist], lr=0.1)
        self.scheduler = torch.optim.lr_scheduler.ReduceLROnPlateau(self.optimizer, factor=0.6, patience=10)

    def loss(self, pose: Tensor, noise: Tensor) -> Tensor:
        """Mean squared error of both directions for a pose `[3]` and noise `[2, *latent_shape]`."""
        source = self.prior.encode(self.condition)  # VAE and CLIP
        latent = self.prior.vae.encode(self.target).latent_dist.mode()  # VAE
        target = ViewCode(latent, source.embedding)  # a target's embedding is not read
        poses = torch.stack([pose, -pose]).to(noise.device)
        timestep = torch.full((2,), TIMESTEP, device=noise.device)
        return self.prior.residual(target, source, poses, timestep, noise).square().mean()

    def step(self) -> None:
        """One update of the start."""
        self.optimizer.zero_grad()
        noise = torch.randn(2, *self.prior.latent_shape, device=self.condition.device)
        loss = self.loss(self.poses(self.twist), noise)
        loss.backward()
        self.optimizer.step()
        self.total += loss.item()
        self.scheduler.step(self.total)


def looped(loops: Sequence[PlainLoop], steps: int) -> None:
    """Steps of each start, one start after the other."""
    for loop in loops:
        for _ in range(steps):
            loop.step()
