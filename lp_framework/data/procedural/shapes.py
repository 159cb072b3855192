"""Shapes common to household objects, built from `solids`.

As in `solids`, +Y is up and the middle of a texture that goes around faces +Z.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw

from lp_framework.data.procedural.solids import (
    Array,
    Shape,
    arc_length,
    box,
    curve,
    ellipsoid,
    hollow,
    lathe,
    loft,
    tube,
)

Parts = list[tuple[Shape, Image.Image]]  # an object: its shapes, each with its texture


def pair(shape: Shape) -> Shape:
    """The shape and its mirror image in X."""
    return shape + shape.scale(x=-1)


def four(shape: Shape) -> Shape:
    """The shape and its mirror images in X, in Z and in both, like table legs."""
    return pair(shape) + pair(shape).scale(z=-1)


def oval(x: float, z: float, y: float, exponent: float = 2.0, count: int = 48) -> Array:
    """A ring `[count, 3]` at height `y` with the axes `x` and `z`: an ellipse, squarer with a larger exponent.

    Its points are evenly spaced, from the middle of its back over -X; each has an opposite point.
    """
    sine, cosine = (np.sin(np.linspace(-np.pi, 0, 4 * count)), np.cos(np.linspace(-np.pi, 0, 4 * count)))
    outline = [side * np.sign(wave) * np.abs(wave) ** (2 / exponent) / 2 for side, wave in ((x, sine), (z, cosine))]
    place = arc_length(np.stack(outline, axis=1))
    half = [np.interp(np.arange(count // 2) / (count // 2), place, column) for column in outline]
    ring = np.stack([half[0], np.zeros(count // 2), half[1]], axis=1)
    return np.concatenate([ring, -ring]) + np.array([0.0, y, 0.0])


def body(levels: ArrayLike, exponent: float = 2.0, count: int = 48, steps: int = 1) -> Shape:
    """A closed body through ovals at levels `[L, 3]` (x, z, y), smooth for `steps` > 1; `v` is the relative height."""
    rows = np.asarray(levels, float)
    rows = rows if steps == 1 else curve(rows, (len(rows) - 1) * steps + 1)
    shape = loft(np.stack([oval(max(x, 1e-3), max(z, 1e-3), y, exponent, count) for x, z, y in rows]))
    height = shape.vertices[:, 1]
    fraction = (height - height.min()) / max(np.ptp(height), 1e-9)
    return Shape(shape.vertices, np.stack([shape.uv[:, 0], fraction], axis=1), shape.triangles)


def vessel(profile: ArrayLike, wall: float = 0.03, lined: bool = False) -> Shape:
    """A round vessel with this outer profile, points (radius, height) from foot to rim, along which `v` goes from 0 to
    1. Its inside has the rim's colour or, if `lined`, repeats the outside's print."""
    whole, share = hollow(np.asarray(profile, float), wall)
    shape = lathe(whole, 48)
    v = shape.uv[:, 1]
    v = np.where(v <= share, v / share, 1 - (v - share) / (1 - share) if lined else 1.0)
    return Shape(shape.vertices, np.stack([shape.uv[:, 0], v.clip(0.002, 0.998)], axis=1), shape.triangles)


def handle(x: float, low: float, high: float, reach: float, radius: float, flat: float = 1.0) -> Shape:
    """A handle in the XY plane from `(x, low)` to `(x, high)`, protruding by `reach`; `flat` stretches it along Z."""
    sides = [(0, 1), (0.75, 0.95), (1, 0.6), (0.7, 0.12), (0, 0)]
    path = curve([(x + reach * out, low + (high - low) * up, 0) for out, up in sides], 17)
    return tube(path, radius, 10).scale(z=flat)


def board(x: float, y: float, z: float) -> Shape:
    """A board; its texture follows its longest side at one scale everywhere, like wood grain."""
    shape = box(x, y, z, 0.12 * min(x, y, z), steps=1)
    along = shape.vertices[:, int(np.argmax([x, y, z]))]
    return Shape(shape.vertices, np.stack([along, shape.vertices.sum(axis=1) - along], axis=1), shape.triangles)


def dented(shape: Shape, random: Generator, depth: float, waves: float = 2.0) -> Shape:
    """The shape with smooth dents and bumps, or bent if there is less than one wave, by `depth` of its size."""
    size = np.ptp(shape.vertices, axis=0).max()
    phase = shape.vertices @ random.normal(size=(3, 3)) * 2 * waves / size + random.uniform(0, 2 * np.pi, 3)
    return Shape(shape.vertices + depth * size * np.sin(phase), shape.uv, shape.triangles)


def lump(random: Generator, x: float, y: float, z: float, depth: float = 0.06) -> Shape:
    """An ellipsoid with these half axes, dented."""
    return dented(ellipsoid(x, y, z, 24), random, depth)


def box_sheet(faces: Sequence[Image.Image], size: int = 512) -> Image.Image:
    """The texture of a `box`: front, right, back, left, top and bottom in 3 x 2 cells."""
    sheet = Image.new("RGB", (size, size))
    for index, face in enumerate(faces):
        left, right = (round((index % 3 + k) * size / 3) for k in (0, 1))
        sheet.paste(face.resize((right - left, size // 2), Image.Resampling.BILINEAR), (left, index // 3 * size // 2))
    return sheet


def stick(
    picture: Image.Image, u: float, start: float, stop: float, width: float, sheet: Image.Image, elliptic: bool = False
) -> None:
    """Stick a label on a `body`'s texture: centred at `u`, `width` of the way around, between two heights."""
    left, right = round((u - width / 2) * sheet.width), round((u + width / 2) * sheet.width)
    top, bottom = round(sheet.height * (1 - stop)), round(sheet.height * (1 - start))
    label = picture.resize((max(1, right - left), max(1, bottom - top)), Image.Resampling.BILINEAR)
    mask = Image.new("L", label.size, 0 if elliptic else 255)
    ImageDraw.Draw(mask).ellipse([0, 0, label.width, label.height], fill=255)
    for shift in (-sheet.width, 0, sheet.width):  # parts that cross the seam continue at the other edge
        sheet.paste(label, (left + shift, top), mask)


def around(pictures: Sequence[Image.Image], start: float, stop: float, sheet: Image.Image) -> None:
    """Stick pictures side by side all the way around, the first in the middle; their relative widths are kept."""
    shares = np.array([each.width for each in pictures]) / sum(each.width for each in pictures)
    middles = 0.5 + np.cumsum(shares) - shares / 2 - shares[0] / 2
    for each, u, share in zip(pictures, middles, shares, strict=True):
        stick(each, u % 1, start, stop, share, sheet)
