"""Pixel conversions of images."""

from __future__ import annotations

import numpy as np
from PIL import Image


def eight_bit(image: Image.Image) -> Image.Image:
    """Convert an image of any mode to 8 bits; `ValueError` if its white level is unknown (floating point)."""
    if image.mode == "F":
        raise ValueError("its pixels are floating-point numbers; save it with 8 or 16 bits")
    if not image.mode.startswith("I"):
        return image
    levels = np.asarray(image).astype(np.float64).clip(0, 65535) / 257  # Pillow's own conversion clips above 255
    return Image.fromarray(np.rint(levels).astype(np.uint8))
