"""The energy minimized by the prior's solvers: the denoising error in both directions of a pair."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from lp_framework.errors import UserError
from lp_framework.keyed_random import keyed_normal, on_cpu, to_device
from lp_framework.priors.base import Prior, ViewCode
from lp_framework.solvers.base import Pairs

_NOISE = 0x4E4F  # gives the prior's noise and a solver's other draws independent streams


def keyed_noise(prior: Prior, device: torch.device, *keys: Tensor | int) -> Tensor:
    """Standard normal noise `[..., *latent_shape]` (float32) for integer keys that broadcast to `[...]`; the keys are
    on the CPU to avoid synchronizing with the device."""
    draws = keyed_normal(_NOISE, *keys, count=math.prod(prior.latent_shape))
    return to_device(draws.float().unflatten(-1, prior.latent_shape), device)


class PairEnergy:
    """The prior's denoising error of relative poses, averaged over both directions, for B pairs at once.

    Direction 0 predicts the query from the reference under the pose x, direction 1 the reference from the query under
    -x. The images are encoded on construction unless `codes` is given. `passes` counts the samples passed through the
    network: one per encoded image, two per pose and call.
    """

    def __init__(self, prior: Prior, pairs: Pairs, seed: int, codes: ViewCode | None = None) -> None:
        self.prior, self.pairs, self.seed = prior, pairs, seed
        self._ids = on_cpu(pairs.ids)[:, None, None]
        self.passes = 0
        if codes is None:
            # Of a clone, because tensors made in inference mode, and their views, cannot take part in autograd.
            with torch.inference_mode(False), torch.no_grad():
                codes = prior.encode(pairs.images.clone())
            self.passes = len(pairs.images)
        self.codes = codes

    def noise(self, step: int, count: int = 1) -> Tensor:
        """Standard normal noise `[B, count, 2, *latent_shape]` (float32) for both directions of each pair.

        It is keyed by seed, pair, step, index (up to `count`) and direction, so all starts of a pair share it.
        """
        number, direction = torch.arange(count)[:, None], torch.arange(2)
        return keyed_noise(self.prior, self.pairs.ids.device, self.seed, self._ids, step, number, direction)

    def mean(self, poses: Tensor, timesteps: Sequence[int], noise: Tensor) -> Tensor:
        """Mean energies `[B, N]` of poses `[B, N, 3]` over timesteps, each with its own noise `[B, count, 2, ...]`."""
        energies = [self(poses, timestep, noise[:, number]) for number, timestep in enumerate(timesteps)]
        return torch.stack(energies).mean(dim=0)

    def __call__(self, poses: Tensor, timestep: int, noise: Tensor) -> Tensor:
        """Energies `[B, N]` of relative poses `[B, N, 3]` under noise `[B, 2, *latent_shape]`; differentiable."""
        errors = self.prior.denoising_error(*self._samples(poses, timestep, noise))
        return errors.unflatten(0, (*poses.shape[:2], 2)).mean(dim=-1)

    def residual(self, poses: Tensor, timestep: int, noise: Tensor) -> Tensor:
        """Predicted minus true noise `[B, N, 2, latent elements]`, whose mean square is the energy; differentiable in
        the poses `[B, N, 3]` in forward and reverse mode."""
        residual = self.prior.residual(*self._samples(poses, timestep, noise))
        return residual.flatten(1).unflatten(0, (*poses.shape[:2], 2))

    def _samples(
        self, poses: Tensor, timestep: int, noise: Tensor
    ) -> tuple[ViewCode, ViewCode, Tensor, Tensor, Tensor]:
        """The prior's arguments for B x N x 2 samples: targets, sources, poses, timesteps, noises."""
        if not 0 <= timestep < self.prior.num_timesteps:
            raise UserError(f"this prior has timesteps 0 to {self.prior.num_timesteps - 1}, got {timestep}")
        starts = poses.shape[1]
        targets = torch.stack([self.pairs.query, self.pairs.reference], dim=-1)  # [B, 2]; the sources are the others
        index = targets[:, None].expand(-1, starts, -1)
        self.passes += index.numel()
        return (
            self.codes[index.flatten()],
            self.codes[index.flip(-1).flatten()],
            torch.stack([poses, -poses], dim=2).flatten(0, 2),
            torch.full((index.numel(),), timestep, device=poses.device),
            noise[:, None].expand(-1, starts, -1, -1, -1, -1).flatten(0, 2),
        )
