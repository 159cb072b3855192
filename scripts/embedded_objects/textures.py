"""Painted textures: a palette, patterned backgrounds, lettering, and texture sheets for boxes and slabs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain, product

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lp_framework.data.procedural.paint import Colour, mottle, pen, shade, wood
from lp_framework.data.procedural.paint import bands as bands
from lp_framework.data.procedural.paint import painted as painted
from lp_framework.data.procedural.paint import plain as plain
from lp_framework.data.procedural.paint import star as star
from lp_framework.data.procedural.paint import wheel_paint as wheel_paint

CREAM: Colour = (242, 226, 190)
RED: Colour = (200, 58, 44)
MAROON: Colour = (122, 36, 40)
ORANGE: Colour = (232, 124, 44)
MUSTARD: Colour = (234, 178, 54)
LEAF: Colour = (104, 156, 72)
FOREST: Colour = (52, 100, 66)
TEAL: Colour = (42, 134, 140)
SKY: Colour = (136, 192, 218)
BLUE: Colour = (52, 104, 168)
NAVY: Colour = (34, 56, 92)
PINK: Colour = (232, 150, 142)
WOOD: Colour = (178, 120, 68)
BROWN: Colour = (112, 70, 44)
STEEL: Colour = (164, 172, 180)
SLATE: Colour = (86, 94, 106)
DARK: Colour = (46, 44, 48)
WHITE: Colour = (250, 246, 236)
GLASS: Colour = (64, 92, 112)


def canvas(
    width: int, height: int, colour: Colour, strength: float = 0.0, seed: int = 0, cells: int = 12
) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    """A background of one colour, made uneven by `mottle` if `strength` is given, and a pen to draw on it."""
    image = Image.new("RGB", (width, height), colour)
    if strength:
        image = mottle(image, strength, seed, cells)
    return image, pen(image)


def planks(colour: Colour, width: int = 512, height: int = 512, rows: int = 6, seed: int = 0) -> Image.Image:
    """Boards one above the other, each in its own shade, with dark joints and nail heads."""
    image = wood(colour, width, height, seed)
    tones = 1 + np.random.default_rng(seed).uniform(-0.14, 0.10, rows)
    row = np.minimum(np.arange(height) * rows // height, rows - 1)
    image = Image.fromarray((np.asarray(image) * tones[row][:, None, None]).clip(0, 255).astype(np.uint8))
    draw = pen(image)
    for k in range(rows):
        y = k * height // rows
        draw.line([(0, y), (width, y)], fill=shade(colour, 0.45), width=max(2, height // 128))
        for x in (width // 24, width - width // 24):
            dot(draw, x, y + height // rows // 2, height / 128, shade(colour, 0.4))
    return image


def courses(width: int, height: int, rows: Sequence[int], of: int, proportion: float) -> Iterator[tuple[float, ...]]:
    """Positions of bricks or tiles in running bond: left, top, length and height of each, in some of `of` rows."""
    high = height / of
    columns = max(2, round(width / (proportion * high)))
    long = width / columns
    for row in rows:
        for column in range(-1, columns + 1):
            yield (column + 0.5 * (row % 2)) * long, row * high, long, high


def bricks(
    colour: Colour, mortar: Colour, width: int = 512, height: int = 512, rows: int = 12, seed: int = 0
) -> Image.Image:
    """A wall in running bond, each brick in its own shade."""
    image, draw = canvas(width, height, mortar)
    random = np.random.default_rng(seed)
    for x, y, long, high in courses(width, height, range(rows), rows, 2.2):
        fill = shade(colour, 1 + random.uniform(-0.22, 0.14))
        draw.rounded_rectangle([x + 2, y + 2, x + long - 2, y + high - 2], radius=3, fill=fill)
    return mottle(image, 0.08, seed)


def shingles(colour: Colour, width: int = 512, height: int = 512, rows: int = 10, seed: int = 0) -> Image.Image:
    """Round roof tiles, overlapping downwards."""
    image, draw = canvas(width, height, shade(colour, 0.55))
    random = np.random.default_rng(seed)
    for x, y, long, high in courses(width, height, range(rows, -2, -1), rows, 1.1):
        fill, area = shade(colour, 1 + random.uniform(-0.18, 0.14)), [x + 1, y - high, x + long - 1, y + 1.25 * high]
        draw.rounded_rectangle(area, radius=0.48 * long, fill=fill, outline=shade(colour, 0.5), width=3)
    return image


def dot(draw: ImageDraw.ImageDraw, x: float, y: float, radius: float, colour: Colour) -> None:
    """A filled disc."""
    draw.ellipse([x - radius, y - radius, x + radius, y + radius], fill=colour)


def rivets(image: Image.Image, margin: float, step: float, radius: float, colour: Colour) -> None:
    """Rivet heads along the four edges of the image."""
    width, height = image.size
    across = np.linspace(margin, width - margin, max(2, round(width / step)))
    down = np.linspace(margin, height - margin, max(2, round(height / step)))
    for x, y in chain(
        product(across, (margin, height - margin)), ((x, y) for y in down for x in (margin, width - margin))
    ):
        dot(pen(image), x + radius / 3, y + radius / 3, radius, shade(colour, 0.45))
        dot(pen(image), x, y, radius, colour)


def text(
    image: Image.Image, words: str, x: float, y: float, size: float, colour: Colour, outline: Colour | None = None
) -> None:
    """Bold lettering centred at `(x, y)`, `size` pixels high."""
    stroke = max(1, round(size / 22))
    font = ImageFont.load_default(size)
    draw = pen(image)
    if outline is not None:
        draw.text((x, y), words, outline, font, anchor="mm", stroke_width=3 * stroke, stroke_fill=outline)
    draw.text((x, y), words, colour, font, anchor="mm", stroke_width=stroke, stroke_fill=colour)


def flower(draw: ImageDraw.ImageDraw, x: float, y: float, radius: float, petal: Colour, heart: Colour) -> None:
    """A flower of seven petals."""
    for angle in np.arange(7) * 2 * np.pi / 7:
        dot(draw, x + 0.62 * radius * np.sin(angle), y - 0.62 * radius * np.cos(angle), 0.42 * radius, petal)
    dot(draw, x, y, 0.36 * radius, heart)


def window(
    draw: ImageDraw.ImageDraw, left: float, top: float, right: float, bottom: float, frame: Colour, bars: int = 1
) -> None:
    """A framed window with sky in its panes, `bars` upright and one across."""
    rim = max(4.0, 0.07 * (right - left))
    draw.rounded_rectangle([left, top, right, bottom], radius=rim, fill=frame)
    inner = (left + rim, top + rim, right - rim, bottom - rim)
    draw.rectangle(inner, fill=GLASS)
    wide, high = inner[2] - inner[0], inner[3] - inner[1]
    corners = ((0.15, 3), (0.6, 1), (0.85, 1), (0.4, 3))
    draw.polygon([(inner[0] + share * wide, inner[side]) for share, side in corners], fill=shade(GLASS, 1.25))
    for k in range(1, bars + 1):
        x = inner[0] + wide * k / (bars + 1)
        draw.rectangle([x - rim / 3, inner[1], x + rim / 3, inner[3]], fill=frame)
    if bars:
        draw.rectangle([inner[0], inner[1] + high / 2 - rim / 3, inner[2], inner[1] + high / 2 + rim / 3], fill=frame)


def box_sheet(
    front: Image.Image,
    right: Image.Image,
    back: Image.Image,
    left: Image.Image,
    top: Image.Image,
    bottom: Image.Image,
    cell: int = 448,
) -> Image.Image:
    """The texture of `solids.box`: six pictures as seen from outside (the top seen from above with the front below)."""
    sheet = Image.new("RGB", (3 * cell, 2 * cell))
    for index, picture in enumerate((front, right, back, left, top, bottom)):
        place = (index % 3 * cell, index // 3 * cell)
        sheet.paste(picture.resize((cell, cell), Image.Resampling.LANCZOS), place)
    return sheet


def all_sides(picture: Image.Image) -> Image.Image:
    """The texture of `solids.box` with one picture on its six faces."""
    return box_sheet(picture, picture, picture, picture, picture, picture, cell=256)


def slab_sheet(front: Image.Image, back: Image.Image, rim: Image.Image, size: int = 1024) -> Image.Image:
    """The texture of `solids.extrude`: front, back as seen from behind, and a strip along the rim."""
    sheet = Image.new("RGB", (size, size))
    high = size * 3 // 4
    for column, picture in enumerate((front, back)):
        sheet.paste(picture.resize((size // 2, high), Image.Resampling.LANCZOS), (column * size // 2, 0))
    sheet.paste(rim.resize((size, size - high), Image.Resampling.LANCZOS), (0, high))
    return sheet


def band(picture: Image.Image, start: float, stop: float, ground: Colour, size: int = 1024) -> Image.Image:
    """A square texture that shows the picture between the heights `start` and `stop` (fractions from the bottom)."""
    image = Image.new("RGB", (size, size), ground)
    top, bottom = round(size * (1 - stop)), round(size * (1 - start))
    image.paste(picture.resize((size, bottom - top), Image.Resampling.LANCZOS), (0, top))
    return image


def wrapped(front: Image.Image, right: Image.Image, back: Image.Image, left: Image.Image) -> Image.Image:
    """Four pictures of one height side by side, as they go around a loft of `solids.plan` rings."""
    half = back.width // 2
    ends = back.crop((half, 0, back.width, back.height)), back.crop((0, 0, half, back.height))
    sheet = Image.new("RGB", (front.width + right.width + back.width + left.width, front.height))
    x = 0
    for picture in (ends[0], left, front, right, ends[1]):
        sheet.paste(picture, (x, 0))
        x += picture.width
    return sheet
