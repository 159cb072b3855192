"""Painting textures: colours, grained and mottled backgrounds, and a few figures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

Colour = tuple[int, int, int]


def plain(colour: Colour) -> Image.Image:
    """A texture of one colour."""
    return Image.new("RGB", (8, 8), colour)


def shade(colour: Colour, factor: float) -> Colour:
    """Make the colour darker (`factor` < 1) or, towards white, lighter (`factor` > 1)."""
    goal = 0 if factor < 1 else 255
    weight = abs(factor - 1)
    r, g, b = (round(c + (goal - c) * weight) for c in colour)
    return r, g, b


def pen(image: Image.Image) -> ImageDraw.ImageDraw:
    """A pen to draw on the image."""
    return ImageDraw.Draw(image)


def noise(width: int, height: int, columns: int, rows: int, seed: int) -> NDArray[np.float64]:
    """Smooth noise `[height, width]` in about [-1, 1] from a grid of random values; the left and right edges match."""
    grid = np.random.default_rng(seed).uniform(-1, 1, (rows, columns)).astype(np.float32)
    wrapped = np.concatenate([grid[:, -2:], grid, grid[:, :2]], axis=1)
    cell = width / columns
    area = (2 * cell, 0, 2 * cell + width, rows)
    stretched = Image.fromarray(wrapped).resize((round(cell * (columns + 4)), rows), Image.Resampling.BICUBIC)
    return np.asarray(stretched.resize((width, height), Image.Resampling.BICUBIC, box=area), dtype=np.float64)


def mottle(image: Image.Image, strength: float = 0.08, seed: int = 0, cells: int = 12) -> Image.Image:
    """The image with slightly uneven brightness, like paint or clay."""
    width, height = image.size
    rows = max(2, round(cells * height / width))
    coarse = noise(width, height, cells, rows, seed)
    fine = noise(width, height, 5 * cells, 5 * rows, seed + 1)
    gain = 1 + strength * (0.65 * coarse + 0.35 * fine)
    return Image.fromarray((np.asarray(image, dtype=np.float64) * gain[..., None]).clip(0, 255).astype(np.uint8))


def painted(colour: Colour, seed: int = 0, strength: float = 0.06, size: int = 256) -> Image.Image:
    """A slightly uneven background of one colour."""
    return mottle(Image.new("RGB", (size, size), colour), strength, seed, cells=6)


def wood(colour: Colour, width: int = 512, height: int = 512, seed: int = 0) -> Image.Image:
    """Wood with grain along the width."""
    warp = noise(width, height, 3, 6, seed)
    rows = np.arange(height)[:, None] / height
    rings = np.sin(2 * np.pi * (9 * rows + 1.3 * warp))
    fibres = noise(width, height, 12, height // 3, seed + 1)
    gain = 1 + 0.10 * rings + 0.10 * fibres
    return Image.fromarray((np.array(colour) * gain[..., None]).clip(0, 255).astype(np.uint8))


def star(draw: ImageDraw.ImageDraw, x: float, y: float, radius: float, colour: Colour, points: int = 5) -> None:
    """Draw a star with one tip up."""
    angle = np.arange(2 * points) * np.pi / points
    reach = np.where(np.arange(2 * points) % 2 == 0, radius, 0.42 * radius)
    draw.polygon([(x + r * np.sin(a), y - r * np.cos(a)) for a, r in zip(angle, reach, strict=True)], fill=colour)


def bands(stops: list[tuple[float, Colour]], size: int = 512) -> Image.Image:
    """Horizontal bands, bottom to top: each colour extends up to its fraction of the height."""
    image = Image.new("RGB", (8, size))
    draw = pen(image)
    start = 0.0
    for stop, colour in stops:
        draw.rectangle([0, round(size * (1 - stop)), 8, round(size * (1 - start))], fill=colour)
        start = stop
    return image


def wheel_paint(hub: Colour, tyre: Colour = (46, 44, 48)) -> Image.Image:
    """Hub cap, rim and tyre as horizontal bands, for a `solids.wheel` seen from the side."""
    cap, rim = shade(hub, 1.5), shade(hub, 0.6)
    near = [(0.06, cap), (0.08, rim), (0.19, hub), (0.215, rim)]
    far = [(0.81, rim), (0.92, hub), (0.94, rim), (1.0, cap)]
    return bands([*near, (0.785, tyre), *far])
