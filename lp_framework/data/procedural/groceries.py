"""Packages: boxes, cartons, bottles, tins, pouches, tubes and jugs with printed labels."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from PIL import Image

from lp_framework.data.procedural.labels import brand, four_sides, panel
from lp_framework.data.procedural.paint import plain
from lp_framework.data.procedural.shapes import Parts, around, body, box_sheet, handle, stick
from lp_framework.data.procedural.solids import box, cylinder, loft, plan
from lp_framework.data.procedural.textures import chance, colour, ground, heap, ink, material, pick


def printed_box(random: Generator, alike: bool = False) -> Parts:
    """A box, lying, upright or roughly cubic; `alike`: the same print on front and back, and on both ends."""
    proportions = [(1, 0.25, 0.5), (1, 0.35, 0.6), (0.7, 1, 0.2), (0.5, 1, 0.35), (0.8, 0.9, 0.7), (1, 0.3, 0.3)]
    x, y, z = np.array(pick(random, proportions)) * random.uniform(0.8, 1.25, 3)
    b = brand(random)
    if alike:
        sides = [panel(random, b, "front", x, y), panel(random, b, "story", z, y)] * 2
        lids = [plain(pick(random, (b.base, b.second)))] * 2
    else:
        sides = four_sides(random, b, x, z, y)
        lids = [panel(random, b, role, x, z) for role in (("front", "back") if y < z else ("story", "facts"))]
    return [(box(x, y, z, random.uniform(0.008, 0.03), steps=2), box_sheet([*sides, *lids]))]


def carton(random: Generator) -> Parts:
    """A gable-top carton of milk or juice."""
    x, z, y = random.uniform((0.38, 0.36, 0.65), (0.6, 0.5, 1.0))
    b, sheet = brand(random), Image.new("RGB", (512, 256))
    sides = zip(four_sides(random, b, x, z, y), (x, z, x, z), strict=True)
    around([side.resize((round(512 * width), 256)) for side, width in sides], 0, 1, sheet)
    ridge = y + random.uniform(0.4, 0.7) * z
    walls = loft(np.stack([plan(x, z, 0.015, height, 96) for height in (0.0, y)]))
    gable = loft(np.stack([plan(x, z, 0.015, y, 96), plan(x, 0.05, 0.015, ridge, 96)]))
    fin = loft(np.stack([plan(x, 0.03, 0.01, ridge + height, 96) for height in (-0.01, 0.12 * y)]))
    return [(walls, sheet), (gable, plain(b.base)), (fin, plain(pick(random, (b.base, b.second))))]


def bottle(random: Generator, flat: bool, resolved: bool = True) -> Parts:
    """A bottle: `flat` ones are oval, with a label in front or on both sides. Round ones have a label all the way round
    if the longitude is `resolved` by it, otherwise a label in front or none."""
    b, wide, shoulder = brand(random), *random.uniform((0.26, 0.5), (0.42, 0.74))
    neck = random.uniform(0.4, 0.7) * wide if flat else random.uniform(0.09, 0.14)
    ratio, waist = random.uniform((0.45, 0.82), (0.75, 1.0)) if flat else (1.0, 1.0)
    top = shoulder + random.uniform(0.08, 0.88 - shoulder)
    widths = np.array([0.92 * wide, wide, waist * wide, wide, 0.35 * wide + 0.65 * neck, neck, neck])
    depths = np.maximum(ratio * widths, np.minimum(widths, neck * (ratio + 1) / 2))
    depths[-2:] = neck
    heights = [0, 0.03, 0.55 * shoulder, shoulder, 0.4 * shoulder + 0.6 * top, top, 0.92]
    exponent, steps = random.uniform(2, 3) if flat else 2.0, int(random.integers(2, 5))
    form = body(np.stack([widths, depths, heights], axis=1), exponent, steps=steps)
    sheet = Image.new("RGB", (512, 512), ink(random, b.base))
    low, high = random.uniform((0.05, 0.85 * shoulder), (0.15, 0.98 * shoulder))
    if resolved and not flat:
        roles = zip(("front", "facts", "back", "story"), random.uniform(0.5, 1.2, 4), strict=True)
        around([panel(random, b, role, width, 1) for role, width in roles], low, high, sheet)
    elif resolved or chance(random, 0.5):
        front, back = (panel(random, b, role, 0.9 * wide, high - low) for role in ("front", "back"))
        stick(front, 0.5, low, high, 0.34, sheet, elliptic=chance(random, 0.3))
        if flat and chance(random, 0.5):
            stick(back, 0.0, low, high, 0.34, sheet)
    cap = cylinder(neck * random.uniform(0.5, 0.7), random.uniform(0.06, 0.16), 0.01, 24)
    return [(form, sheet), (cap.move(y=0.94), plain(colour(random)))]


def tin(random: Generator, resolved: bool, exponent: float = 2.0) -> Parts:
    """A can, jar, tub or canister; its label goes all the way round if the longitude is `resolved` by it."""
    kind = pick(random, ("can", "can", "jar", "tub", "drum"))
    high = {"can": random.uniform(0.35, 1.4), "jar": 1.2, "tub": random.uniform(0.5, 1), "drum": 1.7}[kind]
    foot, top = random.uniform(0.7, 0.85) if kind == "tub" else 1.0, 0.85 if kind == "jar" else 1.0
    widths, heights = np.array([0.96 * foot, foot, 1.0, top, top]), high * np.array([0, 0.02, 0.88, 0.96, 1])
    form = body(np.stack([widths, widths, heights], axis=1), exponent)
    b, metal = brand(random), pick(random, ((150, 155, 160), (190, 180, 150), colour(random)))
    sheet = Image.new("RGB", (512, 512), metal)
    if kind == "jar":
        heap(random, sheet, colour(random))
    start, stop = (0.15, 0.75) if kind == "jar" else (0.03, 0.88)
    if resolved:
        roles = zip(("front", "facts", "back", "story"), random.uniform(0.6, 1.0, 4), strict=True)
        around([panel(random, b, role, width, high * (stop - start)) for role, width in roles], start, stop, sheet)
    else:  # glazed in one colour, or with a horizontal band
        sheet.paste(b.base, (0, 0, 512, 512))
        sheet.paste(pick(random, (b.base, b.second)), (0, 150, 512, 300))
    lid = body([(top + 0.02, top + 0.02, height) for height in (0.97 * high, high + 0.04)], exponent)
    return [(form, sheet), (lid, plain(pick(random, (metal, b.second, b.accent))))]


def pouch(random: Generator) -> Parts:
    """A bag of crisps or coffee, sealed at both ends."""
    b, x, z = brand(random), *random.uniform((0.55, 0.18), (0.9, 0.4))
    half = [(x, 0.015, 0), (x, 0.03, 0.06), (0.96 * x, 0.7 * z, 0.22)]
    levels = [*half, (0.94 * x, z, 0.5), *((width, depth, 1 - height) for width, depth, height in half[::-1])]
    sheet = ground(random, 512, 512, b.base, b.second, 0.3)
    around(four_sides(random, b, x, 0.1, 1, alike=False), 0.08, 0.92, sheet)
    return [(body(levels, 2.2, steps=3), sheet)]


def paste_tube(random: Generator) -> Parts:
    """A tube of paste lying on its side."""
    b, wide, long = brand(random), *random.uniform((0.2, 0.7), (0.32, 1.0))
    levels = np.array([(0.8, 0.8, 0), (1, 1, 0.08), (1.1, 0.8, 0.5), (1.5, 0.1, 1)]) * (wide, wide, long)
    sheet = ground(random, 512, 512, b.base, b.second, 0.5)
    for u, role in ((0.5, "front"), (0.0, "back")):
        stick(panel(random, b, role, 1.5 * wide, long), u, 0.1, 0.9, 0.4, sheet)
    cap = cylinder(0.38 * wide, 0.16, 0.01, 24).move(y=-0.07)
    return [(body(levels, steps=2).turn("x", -90), sheet), (cap.turn("x", -90), plain(b.accent))]


def jug(random: Generator) -> Parts:
    """A bottle of detergent or oil with a handle at its side, or with a trigger on top."""
    b, wide, ratio, y = brand(random), *random.uniform((0.4, 0.45, 0.6), (0.6, 0.7, 0.75))
    levels = np.array([(0.95, 0), (1, 0.04), (0.95, 0.6 * y), (0.7, 0.85 * y), (0.25, y), (0.22, y + 0.08)])
    widths = wide * levels[:, 0]
    form = body(np.stack([widths, ratio * widths, levels[:, 1]], axis=1), random.uniform(2, 3.5), steps=3)
    base, paint = colour(random), plain(colour(random))
    sheet = Image.new("RGB", (512, 512), base)
    for u, role in ((0.5, "front"), (0.0, pick(random, ("back", "facts", "front")))):
        stick(panel(random, b, role, 0.8 * wide, 0.5 * y), u, 0.08, 0.62, 0.3, sheet, elliptic=chance(random, 0.3))
    if chance(random, 0.55):
        grip = handle(0.3 * wide, 0.4 * y, 0.9 * y, random.uniform(0.3, 0.45) * wide, 0.045, 0.8)
        cap = cylinder(0.14 * wide + 0.02, 0.1, 0.015, 24).move(y=y + 0.1)
        return [(form, sheet), (grip, plain(base)), (cap, paint)]
    head = box(0.26, 0.1, 0.09, 0.03).move(0.06, y + 0.16) + cylinder(0.06, 0.1, 0.01, 20).move(y=y + 0.1)
    lever = box(0.03, 0.16, 0.05, 0.01, 1).turn("z", 25).move(0.14, y + 0.05)
    nozzle = cylinder(0.03, 0.05, 0.005, 16).turn("z", 90).move(0.21, y + 0.17)
    return [(form, sheet), (head, paint), (lever + nozzle, material(random))]
