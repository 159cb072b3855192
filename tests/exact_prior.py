"""A prior whose energy over relative poses is known in closed form, to test solvers against exact results."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lp_framework.errors import UserError
from lp_framework.priors.base import Prior, ViewCode


class ExactPrior(Prior):
    """Energy over the offset d = x - (pose of target - pose of source), with the requested minima:

        E(x) = 1/2 s^2 [d_lat^2 + d_rad^2] + 1/2 s^2 prod_k [depth_k + 1 - cos(d_lon - offset_k)]

    It is periodic in longitude. Valleys of depth 0 lie at their `offsets` (radians) and are global minima with E = 0
    (at d_lat = d_rad = 0); others lie near theirs and end higher. `stiffness` is s^2. The pose of an image is its
    first three numbers.

    E is the mean square of `residual`, whatever the timestep. `noisy` times the first element of the noise is added to
    d_lon, so that a solver's draws can be seen in its path.
    """

    offsets: Tensor
    depths: Tensor

    def __init__(
        self,
        offsets: Sequence[float] = (0.0,),
        depths: Sequence[float] | None = None,
        stiffness: float = 1.0,
        noisy: float = 0.0,
    ) -> None:
        super().__init__()
        depths = [0.0] * len(offsets) if depths is None else list(depths)
        if len(depths) != len(offsets) or min(depths) < 0:
            raise UserError(f"one depth, not negative, is needed for each of {len(offsets)} offsets, got {depths}")
        self.num_timesteps, self.latent_shape, self.image_size = 1000, (3, 1, 1), 8
        for name, each in (("offsets", offsets), ("depths", depths)):
            self.register_buffer(name, torch.tensor(each, dtype=torch.float64), persistent=False)
        self.stiffness, self.noisy = stiffness, noisy

    def encode(self, images: Tensor) -> ViewCode:
        return ViewCode(images.flatten(1)[:, :3, None, None], images.new_zeros(len(images), 1, 0))

    def residual(self, target: ViewCode, source: ViewCode, pose: Tensor, timestep: Tensor, noise: Tensor) -> Tensor:
        self.check(target, source, pose, timestep, noise)
        away = pose - (target.latent - source.latent).flatten(1)
        longitude = away[:, 1:2] + self.noisy * noise.flatten(1)[:, :1]
        half = ((longitude - self.offsets.to(pose)) / 2).sin()
        depths = self.depths.to(pose)
        deep = (
            depths == 0
        )  # there sqrt(1 - cos d) = sqrt(2) |sin(d / 2)|, smooth but for a sign, which squaring removes
        root = torch.where(deep, 2**0.5 * half, (depths + 2 * half.square() + deep).sqrt()).prod(dim=1)
        parts = torch.stack([away[:, 0], root, away[:, 2]], dim=1)
        return (1.5 * self.stiffness) ** 0.5 * parts[:, :, None, None]  # the mean of three squares

    def generate(
        self,
        source: ViewCode,
        pose: Tensor,
        steps: int = 50,
        guidance: float = 3.0,
        generator: torch.Generator | None = None,
        eta: float = 1.0,
    ) -> Tensor:
        """Images whose first three numbers are the target's pose."""
        images = torch.zeros(len(pose), 3, self.image_size, self.image_size).to(pose)
        images.view(len(pose), -1)[:, :3] = source.latent.flatten(1) + pose
        return images


def image_of(pose: Tensor) -> Tensor:
    """Images `[B, 3, 8, 8]` that `ExactPrior` takes for views from the poses `[B, 3]`."""
    images = torch.zeros(len(pose), 3, 8, 8, dtype=pose.dtype)
    images.view(len(pose), -1)[:, :3] = pose
    return images
