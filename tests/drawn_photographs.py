"""A photograph's object, drawn by numpy, on a transparent background."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image


def drawn(width: int = 60, height: int = 40, scale: int = 1) -> NDArray[np.uint8]:
    """An ellipse `[height, width, 4]` with soft edges on a transparent background; its colours encode the position."""
    y, x = np.mgrid[0:height, 0:width]
    u, v = (x + 0.5) / width * 2 - 1, (y + 0.5) / height * 2 - 1
    alpha = np.clip((1 - np.hypot(u, v)) * 8, 0, 1) * 255
    colour = np.stack([100 + 90 * u, 100 + 90 * v, 100 + 50 * np.sin(4 * u)], axis=-1)
    image = np.concatenate([colour, alpha[..., None]], axis=-1).round().astype(np.uint8)
    return image.repeat(scale, axis=0).repeat(scale, axis=1)


def placed(image: NDArray[np.uint8], left: int, top: int, width: int = 300, height: int = 200) -> Image.Image:
    """The image somewhere in a larger, transparent frame."""
    frame = Image.new("RGBA", (width, height))
    frame.paste(Image.fromarray(image), (left, top))
    return frame
