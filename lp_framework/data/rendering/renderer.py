"""The renderer interface, with the lighting and anti-aliasing that all renderers share.

The lights are fixed to the camera. If they were fixed to the object, shading would reveal the longitude of a body of
revolution, and a symmetric object would no longer be ambiguous.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

SUPERSAMPLING = 2  # samples per pixel along each side
# Parallel lights: direction towards the light in the camera's frame (+X right, +Y up, +Z back), and intensity.
LIGHTS = ((-0.6, 0.8, 1.1), 2.5), ((1.0, 0.1, 0.7), 0.65)  # from behind the camera at the upper left; from the right
AMBIENT = 0.2


class View(NamedTuple):
    """A rendered view.

    `pixels` `[H, W, 4]` (uint8) have straight alpha and are transparent outside the scene. `depth` `[H, W]` (float32),
    if the renderer provides it, is along the optical axis in scene units, 0 where a pixel is transparent.
    """

    pixels: NDArray[np.uint8]
    depth: NDArray[np.float32] | None = None


class Renderer(ABC):
    """Draws views of scenes. It is pickled to worker processes, so its state must be picklable."""

    name: str

    @abstractmethod
    def views(
        self, scene: trimesh.Scene, camera_to_world: ArrayLike, resolution: int, field_of_view_degrees: float
    ) -> Iterator[View]:
        """Yield the views of a scene, H = W = `resolution`, from OpenGL cameras `[V, 4, 4]` (array or CPU tensor).

        The optical axis passes through the image's centre. Surfaces are opaque and visible from both sides. Raises
        `UserError` if the renderer cannot work on this machine.
        """

    def render(
        self, scene: trimesh.Scene, camera_to_world: ArrayLike, resolution: int, field_of_view_degrees: float
    ) -> NDArray[np.uint8]:
        """Pixels `[V, H, W, 4]` of all `views` at once."""
        views = self.views(scene, camera_to_world, resolution, field_of_view_degrees)
        return np.stack([view.pixels for view in views])


def downsample(samples: NDArray[np.uint8], depth: NDArray[np.float32]) -> View:
    """Downsample pixels `[H s, W s, 4]` with premultiplied alpha and depths `[H s, W s]`, s = SUPERSAMPLING: the mean
    colour of each pixel, without bleeding the background into edges, and the depth of its nearest sample."""
    steps = range(SUPERSAMPLING)
    parts = [(slice(row, None, SUPERSAMPLING), slice(column, None, SUPERSAMPLING)) for row in steps for column in steps]
    sums = np.add.reduce([samples[part] for part in parts], dtype=np.uint16)
    alpha = sums[..., 3:].astype(np.float32)
    pixels = np.empty(sums.shape, np.uint8)
    pixels[..., :3] = np.minimum(sums[..., :3] * (255 / np.maximum(alpha, 1)) + 0.5, 255)
    pixels[..., 3:] = alpha / SUPERSAMPLING**2 + 0.5
    farther = np.where(depth > 0, depth, np.inf)
    nearest = np.minimum.reduce([farther[part] for part in parts])
    return View(pixels, np.where(np.isfinite(nearest), nearest, 0).astype(np.float32))
