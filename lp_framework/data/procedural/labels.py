"""Prints on packages: made-up brands, lettering in several fonts, and faces composed of both."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.random import Generator
from PIL import Image, ImageFont

from lp_framework.data.procedural import textures as tx
from lp_framework.data.procedural.paint import Colour, pen, shade, star
from lp_framework.data.procedural.textures import chance, colour, pick

# All ship with matplotlib.
FONTS = """DejaVuSans-Bold DejaVuSans-BoldOblique DejaVuSans DejaVuSerif-Bold DejaVuSerif-BoldItalic DejaVuSansMono-Bold
STIXGeneralBol STIXGeneralBolIta STIXGeneral STIXGeneralItalic cmb10 cmss10 cmr10 cmtt10"""

SYLLABLES = "ba co del fri ga ho ja ka lu ma na or pi qua ro sa ti um va wi yo zen bon mil sun nor lac ter fel bri"
PRODUCTS = """milk soup beans pasta rice honey butter tea coffee juice sauce ketchup mustard oats flakes crackers
biscuits cookies cocoa pudding cheese yoghurt tuna olives corn peas tomatoes peaches cherries jam syrup salt sugar flour
soap shampoo lotion cleaner wash polish wax glue paint cream gel spray noodles chips nuts raisins muesli popcorn candy
gum water cola lemonade beer cider wine oil vinegar pepper spice broth stock chili curry salsa pickles spread"""
WORDS = "new classic original extra fine organic fresh light 500g 250ml 1kg strong mild natural quality 2for1 free"

Box = tuple[float, float, float, float]  # left, top, right, bottom

# Layouts of faces: elements and their boxes, in percent of the face's width and height.
LAYOUTS = {
    "front": (
        "emblem 15 5 85 23, plate 0 27 100 50, title 7 27 93 50, motif 10 54 90 97",
        "scene 0 46 100 100, emblem 8 4 60 20, title 6 21 94 45",
        "disc 8 8 92 76, name 28 18 72 34, title 14 34 86 56, text 10 85 90 97",
        "title 6 5 94 38, motif 10 40 90 82, name 15 84 85 97",
        "plate 12 0 88 100, name 18 6 82 22, motif 20 26 80 66, title 16 70 84 94",
    ),
    "wide front": (
        "title 5 8 60 60, emblem 6 66 50 94, motif 62 6 98 94",
        "scene 60 0 100 100, emblem 5 6 45 36, title 4 40 58 92",
        "disc 22 4 78 96, name 36 14 64 32, title 28 34 72 74",
        "plate 0 30 100 78, title 6 32 66 76, motif 68 8 98 92, name 6 4 40 26",
    ),
    "back": (
        "name 10 3 90 18, text 6 22 94 55, picture 55 58 95 97, code 8 66 50 95",
        "picture 15 3 85 45, title 8 46 92 62, text 6 65 94 97",
        "emblem 8 5 70 25, text 6 30 48 96, picture 52 28 96 62, picture 52 64 96 97",
    ),
    "facts": (
        "facts 10 5 90 60, code 16 70 84 95",
        "text 8 5 92 30, facts 10 36 90 94",
    ),
    "story": (
        "emblem 8 5 92 28, motif 14 32 86 66, text 10 70 90 96",
        "plate 0 0 100 40, title 8 8 92 34, picture 10 44 90 96",
    ),
    "spine": (
        "title 5 12 60 88, emblem 64 15 95 85",
        "motif 2 8 24 92, title 26 14 96 86",
    ),
}


@dataclass(frozen=True)
class Brand:
    """What the faces of a package share; `busy` is the fraction with a pattern."""

    name: str
    product: str
    base: Colour
    second: Colour
    accent: Colour
    font: str
    motif: str
    busy: float
    outlined: bool


def brand(random: Generator) -> Brand:
    """A made-up brand with a product."""
    base, product = colour(random, "vivid", "vivid", "pale", "deep", "white", "brown"), pick(random, PRODUCTS.split())
    return Brand(
        name="".join(random.choice(SYLLABLES.split(), int(random.integers(2, 4)))).capitalize(),
        product=pick(random, (product.upper(), product.title(), product)),
        base=base,
        second=tx.ink(random, base, "vivid", "deep", "white", "pale"),
        accent=colour(random, "vivid"),
        font=pick(random, FONTS.split()),
        motif=pick(random, list(tx.PICTURES)),
        busy=random.uniform(0, 0.8),
        outlined=chance(random, 0.35),
    )


@cache
def font(name: str, size: int = 56) -> ImageFont.FreeTypeFont:
    """One of `FONTS`, by default in the size from which lettering is scaled."""
    import matplotlib

    return ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts", "ttf", f"{name}.ttf"), size)


def letter(image: Image.Image, words: str, box: Box, fill: Colour, name: str, outline: Colour | None = None) -> None:
    """Draw words centred in the box, as large as it allows, stretched in height by up to a half."""
    stroke = 5 if outline else 0
    left, top, right, bottom = font(name).getbbox(words, stroke_width=stroke)
    lettering = Image.new("RGBA", (int(right - left) + 4, int(bottom - top) + 4), (*(outline or fill), 0))
    origin = (2 - left, 2 - top)
    pen(lettering).text(origin, words, fill, font(name), stroke_width=stroke, stroke_fill=outline)
    wide, high = box[2] - box[0], box[3] - box[1]
    scale = min(wide / lettering.width, 1.5 * high / lettering.height)
    size = max(1, round(lettering.width * scale)), max(1, round(min(high, 1.5 * lettering.height * scale)))
    lettering = lettering.resize(size, Image.Resampling.BILINEAR)
    image.paste(lettering, (round(box[0] + (wide - size[0]) / 2), round(box[1] + (high - size[1]) / 2)), lettering)


def about(x: float, y: float, half_width: float, half_height: float) -> Box:
    """The box around a point."""
    return x - half_width, y - half_height, x + half_width, y + half_height


def small_print(random: Generator, image: Image.Image, box: Box, fill: Colour) -> None:
    """Fill the box with lines of words."""
    size = int(np.clip((box[3] - box[1]) / 6, 7, 13))
    small = font(pick(random, ("DejaVuSans", "DejaVuSerif", "STIXGeneral")), size)
    columns = max(3, int((box[2] - box[0]) / (0.55 * size)))
    for y in np.arange(box[1], box[3] - size, 1.25 * size):
        pen(image).text((box[0], y), " ".join(random.choice(PRODUCTS.split(), 1 + columns // 6))[:columns], fill, small)


def element(random: Generator, image: Image.Image, b: Brand, kind: str, box: Box) -> None:
    """Draw one element of `LAYOUTS` in this box of pixels."""
    left, top, right, bottom = box
    draw, wide, high, middle = pen(image), right - left, bottom - top, ((left + right) / 2, (top + bottom) / 2)
    radius, below = min(wide, high) / 2, tx.colour_at(image, int(middle[0]), int(middle[1]))
    stands_out = max((b.base, b.second, b.accent), key=lambda each: tx.contrast(each, below))
    if kind == "title":
        letter(image, b.product, box, stands_out, b.font, b.accent if b.outlined else None)
    elif kind == "name":
        letter(image, b.name, box, stands_out, b.font)
    elif kind == "emblem":  # the name on an ellipse, a rounded plate or a ribbon
        shape, notch = int(random.integers(3)), 0.1 * wide
        ribbon = [left, top, right, top, right - notch, middle[1], right, bottom, left, bottom, left + notch, middle[1]]
        if shape == 0:
            draw.ellipse(box, fill=b.second, outline=b.accent, width=3)
        elif shape == 1:
            draw.rounded_rectangle(box, radius=0.3 * high, fill=b.second, outline=b.accent, width=2)
        else:
            draw.polygon(ribbon, fill=b.second)
        letter(image, b.name, about(*middle, 0.36 * wide, 0.3 * high), b.base, b.font)
    elif kind == "plate":
        draw.rectangle(box, fill=b.second)
    elif kind == "disc":
        draw.ellipse(box, fill=b.second, outline=b.accent, width=4)
    elif kind == "motif":
        if chance(random, 0.4):
            draw.ellipse(about(*middle, radius, radius), fill=b.second)
            radius *= 0.75
        tx.draw_picture(image, b.motif, *middle, radius, (b.accent, shade(b.second, 0.8), shade(b.base, 0.6)))
    elif kind == "picture":
        tx.picture(random, image, *middle, radius, below)
    elif kind == "scene":  # a heap of the product
        part = Image.new("RGB", (max(1, int(wide)), max(1, int(high))), b.second)
        tx.heap(random, part, b.accent)
        image.paste(part, (int(left), int(top)))
    elif kind == "text":
        small_print(random, image, box, stands_out)
    elif kind == "code":
        draw.rectangle(box, fill=(252, 252, 250))
        for x in np.arange(left + 4, right - 4, max(3.0, wide / 24)):
            draw.rectangle([x, top + 3, x + random.uniform(0.3, 0.9) * wide / 24, bottom - 4], fill=(20, 20, 22))
    elif kind == "facts":
        draw.rectangle(box, fill=(250, 250, 246), outline=(20, 20, 20), width=2)
        rows = np.linspace(top, bottom, int(random.integers(6, 10)))
        letter(image, "Nutrition Facts", (left + 4, top + 3, right - 4, rows[1]), (20, 20, 20), "DejaVuSans-Bold")
        for y, step in zip(rows[1:-1], np.diff(rows[1:]), strict=True):
            draw.line([(left, y), (right, y)], fill=(20, 20, 20))
            for x, half in ((0.25, random.uniform(0.05, 0.2)), (0.87, 0.07)):
                draw.rectangle(about(left + x * wide, y + 0.5 * step, half * wide, 0.15 * step), fill=(90, 90, 90))


def panel(random: Generator, b: Brand, role: str, wide: float, high: float, longest: int = 256) -> Image.Image:
    """A printed face of these proportions, in one of the role's `LAYOUTS`; narrow faces read along their length."""
    width, height = (max(24, round(longest * side / max(wide, high))) for side in (wide, high))
    if height > 1.9 * width:
        return panel(random, b, role, high, wide, longest).transpose(Image.Transpose.ROTATE_90)
    base = pick(random, (b.second, shade(b.base, 0.7), shade(b.second, 1.4))) if role == "back" else b.base
    image = tx.ground(random, width, height, base, shade(base, pick(random, (0.75, 0.85, 1.3))), b.busy)
    role = "spine" if width > 2.6 * height else "wide front" if role == "front" and width > 1.2 * height else role
    for entry in pick(random, LAYOUTS[role]).split(", "):
        kind, *box = entry.split()
        left, top, right, bottom = (float(edge) / 100 for edge in box)
        element(random, image, b, kind, (left * width, top * height, right * width, bottom * height))
    if "front" in role and chance(random, 0.5):
        x, y, radius = random.uniform(0.7, 0.85) * width, random.uniform(0.15, 0.85) * height, 0.16 * min(width, height)
        star(pen(image), x, y, 1.2 * radius, b.accent, 14)
        letter(image, pick(random, WORDS.split()), about(x, y, radius / 2, radius / 3), b.base, b.font)
    return image


def four_sides(random: Generator, b: Brand, x: float, z: float, y: float, alike: bool = True) -> list[Image.Image]:
    """Prints for the sides of a package of this size: front, right, back, left.

    All sides differ. If they may be `alike`, sometimes front and back are, or right and left, but never both, and only
    if the other two are wide enough to tell them apart.
    """
    roles = (("front", x), ("facts", z), ("back", x), ("story", z))
    front, right, back, left = (panel(random, b, role, width, y) for role, width in roles)
    case = random.random() if alike else 1.0
    if case < 0.4 and z > 0.5 * x:
        back = front if case < 0.25 else front.transpose(Image.Transpose.ROTATE_180)
    elif 0.4 < case < 0.6 and x > 0.5 * z:
        left = right
    return [front, right, back, left]
