"""Zero123 with random weights, at full or narrow size: batched against a loop, and in reduced precision."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor, nn

from lp_framework.benchmarks.harness import Section, Work, peak_bytes, timed, work_of
from lp_framework.errors import UserError
from lp_framework.models.pose_model import PoseModel
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
from lp_framework.solvers.pair_energy import PairEnergy
from lp_framework.solvers.starts import Ring
from lp_framework.solvers.twist import IFusion, SineRadius, TwistPoses
from lp_framework.solvers.two_stage import TwoStage

TIMESTEP = 500  # any timestep takes the same work
CONTENDERS = BATCHED, LOOP = "batched", "plain loop"
SWITCHES = ("channels_last", "compile", "cuda_graph")

Architecture = Literal["published", "narrow"]
NARROW: Configs = {  # the same kinds of layers, fewer and narrower: tries the measurement in seconds
    "unet": unet_config([32, 32], 1, [True, False], heads=4, context=32),
    "vae": vae_config([32, 32, 32, 32], 1),
    "image_encoder": clip_config(width=64, layers=1, patch=32, image_size=224, projection=32),
}
ARCHITECTURES: Mapping[Architecture, Configs] = {"published": PUBLISHED, "narrow": NARROW}


@dataclass(frozen=True)
class Computing:
    """How Zero123 is computed: its size, and settings of `prior=zero123`."""

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
        """A prior with the weights of these networks. It shares their memory unless they are converted."""
        # New parameters with the same storage: converting one does not affect the other.
        shared: dict[int, Any] = {id(each): nn.Parameter(each.detach(), False) for each in networks.parameters()}
        own = copy.deepcopy(networks, shared)
        for part in (own.unet, own.vae, own.image_encoder):
            nn.Module.to(part, DTYPES[self.dtype])  # diffusers' own `to` warns needlessly
        settings = self.channels_last, self.compile, self.cuda_graph, self.attention, self.max_batch
        return Zero123Prior(own, *settings).to(own.cc_projection.weight.device)


def random_pair(device: torch.device) -> Pairs:
    """A pair of random images at Zero123's size."""
    index = torch.arange(2, device=device)
    return Pairs(torch.rand(2, 3, IMAGE_SIZE, IMAGE_SIZE, device=device) * 2 - 1, index[:1], index[1:], ids=index[:1])


def encoded(prior: Prior, codes: ViewCode) -> Prior:
    """The prior with precomputed image codes, so that encoding counts for neither contender."""
    ready = copy.copy(prior)
    ready.encode = lambda images: codes  # type: ignore[method-assign]
    return ready


def batched(prior: Prior, pair: Pairs, starts: Tensor, steps: int) -> Work:
    """Steps of this package's `ifusion` from starts `[1, N, 3]`, with all starts and both directions in one batch."""
    return work_of(steps, partial(IFusion(prior, steps).solve, pair, starts, 0))


def plain_prior(networks: Networks) -> Zero123Prior:
    """A float32 prior with attention that materializes its weights: softmax(Q K^T / sqrt(d)) V."""
    from diffusers.models.attention_processor import AttnProcessor

    prior = Computing().prior(networks)
    prior.unet.set_attn_processor(AttnProcessor())
    return prior


class PlainLoop:
    """One start `[3]` of a sequential loop that costs as much as iFusion's published code (`optimize_pose_loop`).

    As in that code, every step encodes both images again, by the autoencoder as targets and as conditions and by CLIP
    as conditions; uses float32, a batch of both directions, and attention that materializes its weights; keeps the
    twist on the CPU; and reads the loss for the plateau scheduler. Left out, since nearly free: condition dropout,
    posterior sampling, the progress bar.
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
        target = ViewCode(latent, source.embedding)  # a target's embedding is unused
        poses = torch.stack([pose, -pose]).to(noise.device)
        timestep = torch.full((2,), TIMESTEP, device=noise.device)
        return self.prior.residual(target, source, poses, timestep, noise).square().mean()

    def step(self) -> None:
        """Update the start once."""
        self.optimizer.zero_grad()
        noise = torch.randn(2, *self.prior.latent_shape, device=self.condition.device)
        loss = self.loss(self.poses(self.twist), noise)
        loss.backward()
        self.optimizer.step()
        self.total += loss.item()
        self.scheduler.step(self.total)


def looped(loops: Sequence[PlainLoop], steps: int) -> None:
    """Run `steps` steps of one start after the other."""
    for loop in loops:
        for _ in range(steps):
            loop.step()


def measure_step(section: Section, computing: Computing, starts: Sequence[int], rounds: int, steps: int) -> None:
    """Time optimization steps on random weights: a batch computed as `computing` against the loop as published."""
    section.title, section.contenders = "second stage: a step of one pair", CONTENDERS
    device = section.device
    networks, pair = computing.networks(device), random_pair(device)
    batch_prior, loop_prior = computing.prior(networks), plain_prior(networks)
    if device.type == "cuda":
        batch_prior.encode(pair.images)  # warm-up
    encoding, codes = timed(lambda: batch_prior.encode(pair.images), device)
    ready = encoded(batch_prior, codes)
    ring = {count: Ring(count).make(pair, seed=0) for count in starts}
    loops = [PlainLoop(loop_prior, pair.images, start) for start in ring[max(starts)][0]]
    # The first step at each size compiles or records the graph, and recording allocates its memory.
    peaks = {count: peak_bytes(batched(ready, pair, poses, 1), batch_prior, device) for count, poses in ring.items()}
    loop_peak = peak_bytes(loops[0].step, loop_prior, device)
    for count, peak in peaks.items() if device.type == "cuda" else ():
        section.add(f"{starts_label(count)}, peak memory, GB", peak / 1e9, loop_peak / 1e9)
    section.note = (
        f"Zero123's {computing.architecture} size, random weights. {BATCHED}: all starts and both directions "
        f"together, images encoded once ({encoding:.3g} s, not counted); {LOOP}: one start at a time, images "
        "encoded again at each step"
    )
    section.facts = {"encoding_seconds": encoding}
    works = {
        f"{starts_label(count)}, seconds per step": (
            batched(ready, pair, poses, steps),
            work_of(steps, partial(looped, loops[:count], steps)),
        )
        for count, poses in ring.items()
    }
    section.race(works, rounds, warm_up=False)


def measure_pair(
    section: Section, computing: Computing, model: PoseModel, paper_seconds: Mapping[int, float],
    starts: Sequence[int], steps: int, rounds: int,
) -> None:  # fmt: skip
    """Time `two_stage` with `steps` steps of its second stage against only the second stage in `PlainLoop`.

    The former follows `computing` and encodes the images of each pair. The first pair at each number of starts, which
    chooses, compiles or records kernels, is reported separately. `paper_seconds` are the paper's by number of starts.
    """
    section.title, section.contenders = "pair: both stages and encoding", CONTENDERS
    networks, pair = computing.networks(section.device), random_pair(section.device)
    batch_prior, loop_prior = computing.prior(networks), plain_prior(networks)
    solver = TwoStage(model, batch_prior, refinement_steps=steps)
    ring = {count: Ring(count).make(pair, seed=0) for count in starts}

    def plain(count: int) -> None:
        looped([PlainLoop(loop_prior, pair.images, start) for start in ring[count][0]], steps)

    runs = {count: work_of(1, partial(solver.solve, pair, poses, 0)) for count, poses in ring.items()}
    first = {count: timed(work, section.device)[0] for count, work in runs.items()}
    PlainLoop(loop_prior, pair.images, ring[starts[0]][0, 0]).step()
    section.facts["first_pair_seconds"] = first
    section.note = (
        f"Zero123's {computing.architecture} size, random weights. {BATCHED}: two_stage with {steps} steps of its "
        f"second stage; {LOOP}: as many for each start, images encoded again at each step. "
        f"The first pair took {', '.join(f'{seconds:.3g} s from {count}' for count, seconds in first.items())}. "
        "The paper's pairs, of 50 steps at the published size on an RTX 6000 Ada, take "
        f"{', '.join(f'{seconds} s from {count}' for count, seconds in paper_seconds.items())}"
    )
    works = {
        f"{starts_label(count)}, seconds per pair": (work, work_of(1, partial(plain, count)))
        for count, work in runs.items()
    }
    section.race(works, rounds, warm_up=False)


def starts_label(starts: int) -> str:
    """The number of starts in words."""
    return f"{starts} start{'s' if starts > 1 else ''}"


def variant(words: str, architecture: Architecture, max_batch: int | None) -> Computing:
    """Parse words such as "bfloat16 channels_last compile", in any order; the dtype defaults to float32."""
    chosen, known = words.split(), [*DTYPES, *SWITCHES]
    dtypes = [word for word in chosen if word in DTYPES]
    if not chosen or len(dtypes) > 1 or not {*chosen} <= {*known}:
        raise UserError(
            f"precision.variants: '{words}' is not one; give one or more of {', '.join(known)}, with at most one dtype"
        )
    settings = {"dtype": dtypes[0] if dtypes else "float32", **{word: word in chosen for word in SWITCHES}}
    return Computing(architecture, **settings, max_batch=max_batch)  # type: ignore[arg-type]


def measure_precision(
    section: Section, architecture: Architecture, variants: Sequence[str], starts: int, rounds: int, steps: int,
    max_batch: int | None,
) -> None:  # fmt: skip
    """Time steps of a pair with the same random weights, one variant at a time to hold at most two U-Nets."""
    section.title, section.contenders = "precision: a step of one pair", ("as named", "plain float32")
    device, plain = section.device, Computing(architecture, max_batch=max_batch)
    computings = {words: variant(words, architecture, max_batch) for words in variants}
    networks, pair = plain.networks(device), random_pair(device)
    poses = Ring(starts).make(pair, seed=0)
    prior = plain.prior(networks)
    codes = prior.encode(pair.images)
    ready = encoded(prior, codes)
    memory = peak_bytes(partial(gradient, ready, pair, poses), prior.unet, device)
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):  # a GPU convolves float32 in TF32 otherwise
        exact = gradient(ready, pair, poses)
    section.note = f"Zero123's {architecture} size, random weights, {starts} starts"
    for words, computing in computings.items():
        other = computing.prior(networks)
        variant_ready = encoded(other, codes)
        # Measured at the first step: once recorded, later steps allocate nothing.
        variant_memory = peak_bytes(partial(gradient, variant_ready, pair, poses), other.unet, device)
        off = ((gradient(variant_ready, pair, poses) - exact).abs().max() / exact.abs().max()).item()
        section.note += f"; {words}: gradient off by {off:.1g}"
        section.facts[words] = {"gradient_deviation": off}
        label = f"{words}: seconds per step"
        section.race({label: (batched(variant_ready, pair, poses, steps), batched(ready, pair, poses, steps))}, rounds)
        if device.type == "cuda":
            section.add(f"{words}: peak memory, GB", variant_memory / 1e9, memory / 1e9)
        del other, variant_ready


def gradient(prior: Prior, pair: Pairs, poses: Tensor) -> Tensor:
    """Gradient of the energies at poses `[1, N, 3]`."""
    energy, poses = PairEnergy(prior, pair, seed=0), poses.detach().clone().requires_grad_()
    return torch.autograd.grad(energy(poses, TIMESTEP, energy.noise(0)[:, 0]).sum(), poses)[0]
