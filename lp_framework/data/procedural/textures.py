"""Surface appearance: random colours, patterns, materials, and pictures drawn by code."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.random import Generator
from PIL import Image

from lp_framework.data.procedural.paint import Colour, noise, painted, pen, plain, shade, wood
from lp_framework.data.procedural.solids import curve

Choice = TypeVar("Choice")

HUES = (0.0, 0.02, 0.06, 0.1, 0.14, 0.3, 0.38, 0.53, 0.58, 0.62, 0.66, 0.78, 0.93)  # denser among common hues
TONES = {  # hues, ranges of saturation and value, and frequency
    "vivid": (HUES, (0.65, 1.0), (0.55, 1.0), 0.3),
    "pale": (HUES, (0.08, 0.4), (0.8, 1.0), 0.13),
    "deep": (HUES, (0.5, 1.0), (0.15, 0.45), 0.12),
    "brown": ((0.05, 0.07, 0.09), (0.35, 0.7), (0.3, 0.85), 0.13),
    "grey": (HUES, (0.0, 0.06), (0.25, 0.75), 0.1),
    "white": ((0.05, 0.12), (0.0, 0.07), (0.86, 1.0), 0.15),
    "black": (HUES, (0.0, 0.25), (0.06, 0.16), 0.07),
}
# Strokes: kind, index of one of three colours, and points (x right, y up) in a square from -10 to 10.
PICTURES = {
    "fruit": "disc 0 0 -1 8 8, disc 2 -3 2 2 2, line 1 0 6 1 10, blob 1 1 8 5 10 8 7",
    "berries": "disc 0 -5 2 3 3, disc 0 0 3 3 3, disc 0 5 2 3 3, disc 0 3 -2 3 3, disc 0 0 -6 3 3, blob 1 0 5 -6 9 6 9",
    "flower": "disc 0 0 6 4 4, disc 0 6 2 4 4, disc 0 4 -5 4 4, disc 0 -4 -5 4 4, disc 0 -6 2 4 4, disc 1 0 0 4 4",
    "ear": "line 1 0 -10 1 9, blob 0 0 -6 6 -2 1 -3, blob 0 0 -4 -6 0 0 -1, blob 0 0 -1 6 3 1 2, blob 0 0 1 -6 5 0 4",
    "fish": "area 0 -9 0 -2 5 5 1 10 5 8 0 10 -5 5 -1 -2 -5, area 1 -3 4 1 8 2 3, disc 2 -6 1 1 1",
    "hills": "disc 0 5 5 3 3, area 1 -10 -6 -4 6 0 0 3 3 10 -6, area 2 -6 2 -4 6 -2 3, area 0 2 -6 2 -2 4 0 7 -6",
    "bowl": "blob 0 -9 0 9 0 5 -8 -5 -8, disc 2 0 0 8 2, disc 1 0 0 7 1.4, line 2 -3 3 -2 5 -4 7, line 2 3 3 4 5 2 7",
    "cat": "area 1 -8 9 0 5 -7 1, area 1 8 9 0 5 7 1, disc 0 0 0 8 7, disc 2 -3 1 1 1, disc 2 3 1 1 1, disc 1 0 -3 2 1",
    "cow": (
        "area 2 -7 4 5 4 5 -8 3 -8 3 -3 -4 -3 -4 -8 -6 -8, blob 2 5 3 6 7 9 5 9 2, disc 0 -3 1 2 2, "
        "disc 0 2 1 1.5 2, line 1 -7 3 -9 -2"
    ),
    "boat": "area 0 -8 -4 8 -4 5 -8 -5 -8, area 1 -1 9 -1 -3 -7 -3, area 2 1 6 1 -3 6 -3",
    "tree": "line 1 0 -10 0 0, disc 0 -4 1 4 4, disc 0 4 1 4 4, disc 0 0 5 4 4",
    "heart": "disc 1 0 0 9 9, blob 0 0 -7 -6 0 -4 5 0 3 4 5 6 0",
    "star": "area 0 0 10 2.4 3 9.5 3 3.8 -1.2 6 -8 0 -4 -6 -8 -3.8 -1.2 -9.5 3 -2.4 3, disc 1 0 0 2 2",
}


def pick(random: Generator, choices: Sequence[Choice], shares: Sequence[float] | None = None) -> Choice:
    """Choose one of the choices, uniformly or by weight."""
    weights = None if shares is None else np.asarray(shares) / np.sum(shares)
    return choices[int(random.choice(len(choices), p=weights))]


def chance(random: Generator, probability: float) -> bool:
    """True with this probability."""
    return bool(random.random() < probability)


def colour(random: Generator, *tones: str) -> Colour:
    """A random colour from these `TONES`, by default from any."""
    names = tones or tuple(TONES)
    hues, saturation, value, _ = TONES[pick(random, names, [TONES[name][3] for name in names])]
    hue = (pick(random, hues) + random.normal(0, 0.015)) % 1
    r, g, b = colorsys.hsv_to_rgb(hue, random.uniform(*saturation), random.uniform(*value))
    return round(255 * r), round(255 * g), round(255 * b)


def colour_at(image: Image.Image, x: int = 0, y: int = 0) -> Colour:
    """A pixel of an RGB image."""
    return image.getpixel((x, y))  # type: ignore[return-value]


def contrast(first: Colour, second: Colour) -> float:
    """Difference in perceived brightness, 0 to 255.

    >>> round(contrast((0, 0, 0), (255, 255, 255)))
    255
    """
    return abs(float(np.dot((0.3, 0.59, 0.11), np.subtract(first, second, dtype=float))))


def ink(random: Generator, ground: Colour, *tones: str) -> Colour:
    """A colour from the given tones that stands out from the ground; black or white if none is found quickly."""
    for _ in range(8):
        if contrast(found := colour(random, *tones), ground) > 80:
            return found
    return max(((24, 22, 26), (250, 248, 240)), key=lambda extreme: contrast(extreme, ground))


def pattern(random: Generator, image: Image.Image, paint: Colour) -> None:
    """Paint over the image: stripes, checks, dots, rays, rings, waves, clouds, or a heap of rounded pieces."""
    if chance(random, 0.15):
        return heap(random, image, paint)
    width, height = image.size
    x, y = np.meshgrid(np.arange(width) / max(width, height), np.arange(height) / max(width, height))
    count, turn, (x0, y0) = int(random.integers(2, 9)), pick(random, (0, 0.25, 0.5, 0.75)), random.uniform(0.2, 0.8, 2)
    along = x * np.cos(np.pi * turn) + y * np.sin(np.pi * turn)
    across = y * np.cos(np.pi * turn) - x * np.sin(np.pi * turn)
    fields = {
        "stripes": lambda: np.sin(2 * np.pi * count * along),
        "checks": lambda: np.sin(np.pi * count * along) * np.sin(np.pi * count * across),
        "dots": lambda: np.cos(2 * np.pi * count * x) + np.cos(2 * np.pi * count * y) - 0.8,
        "rays": lambda: np.sin(2 * count * np.arctan2(y - y0, x - x0)),
        "rings": lambda: np.sin(np.pi * count * np.hypot(x - x0, y - y0)),
        "waves": lambda: np.sin(np.pi * count * y + 2 * np.sin(2 * np.pi * x)),
        "clouds": lambda: 1.5 * noise(width, height, count + 1, count + 1, int(random.integers(2**31))),
    }
    field = pick(random, list(fields.values()))() - random.uniform(-0.4, 0.4)
    mask = (0.5 + pick(random, (0.6, 8, 8)) * field).clip(0, 1)  # soft or with hard edges
    image.paste(paint, mask=Image.fromarray((255 * mask).astype(np.uint8)))


def heap(random: Generator, image: Image.Image, paint: Colour) -> None:
    """Draw a heap of rounded pieces in two colours, like pasta, beans or sweets."""
    draw, paints = pen(image), (paint, paint, colour(random, "vivid", "brown", "pale"))
    long, short = max(image.size) * random.uniform(0.05, 0.14) * np.array((1, random.uniform(0.35, 1)))
    for x, y in random.random((110, 2)) * image.size:
        tone = shade(pick(random, paints), random.uniform(0.75, 1.25))
        width, height = (long, short) if chance(random, 0.5) else (short, long)
        draw.ellipse([x - width, y - height, x + width, y + height], fill=tone, outline=shade(tone, 0.6))
        draw.ellipse([x - width / 2, y - 0.7 * height, x, y - 0.3 * height], fill=shade(tone, 1.4))


def ground(random: Generator, width: int, height: int, base: Colour, other: Colour, busy: float) -> Image.Image:
    """An image of one colour, with a pattern of the other with probability `busy`."""
    image = Image.new("RGB", (width, height), base)
    if chance(random, busy):
        pattern(random, image, other)
    return image


def material(random: Generator, *tones: str, grained: float = 0.0) -> Image.Image:
    """A texture without print in one of the tones: wood with probability `grained`, else plain, mottled, speckled."""
    base, kind = colour(random, *tones), random.random()
    if chance(random, grained):
        return wood(colour(random, "brown"), 256, 256, int(random.integers(2**31)))
    if kind < 0.5:
        return plain(base)
    if kind < 0.85:
        return painted(base, int(random.integers(2**31)), random.uniform(0.03, 0.15), 128)
    image, speckles = Image.new("RGB", (96, 96), base), random.random((96, 96)) < random.uniform(0.02, 0.2)
    image.paste(ink(random, base), mask=Image.fromarray(speckles.astype(np.uint8) * 255))
    return image


def draw_picture(image: Image.Image, name: str, x: float, y: float, radius: float, colours: Sequence[Colour]) -> None:
    """Draw one of `PICTURES`, centred at pixel `(x, y)`."""
    draw = pen(image)
    for stroke in PICTURES[name].split(", "):
        kind, which, *numbers = stroke.split()
        paint, points = colours[int(which)], np.reshape(np.array(numbers, float), (-1, 2)) * radius / 10
        if kind == "disc":
            (dx, dy), (width, height) = points
            draw.ellipse([x + dx - width, y - dy - height, x + dx + width, y - dy + height], fill=paint)
            continue
        if kind == "blob":  # a smooth closed curve through the points
            points = curve(np.concatenate([points[-1:], points, points[:2]]), 10 * len(points) + 20)[10:-10]
        corners = [(x + dx, y - dy) for dx, dy in points]
        if kind == "line":
            draw.line(corners, fill=paint, width=max(1, round(0.1 * radius)), joint="curve")
        else:
            draw.polygon(corners, fill=paint)


def picture(random: Generator, image: Image.Image, x: float, y: float, radius: float, against: Colour) -> None:
    """Draw a random picture in random colours that stand out from the ground."""
    colours = ink(random, against, "vivid", "deep", "pale"), colour(random, "vivid", "brown"), ink(random, against)
    draw_picture(image, pick(random, list(PICTURES)), x, y, radius, colours)


def frieze(random: Generator, width: int, height: int, repeats: int, base: Colour) -> Image.Image:
    """One motif repeated identically `repeats` times side by side; `width` must be a multiple of `repeats`."""
    tile = Image.new("RGB", (width // repeats, height), base)
    if chance(random, 0.5):
        pattern(random, tile, ink(random, base))
    else:
        picture(random, tile, tile.width / 2, height / 2, 0.45 * min(tile.size), base)
    image = Image.new("RGB", (width, height))
    for k in range(repeats):
        image.paste(tile, (k * tile.width, 0))
    return image
