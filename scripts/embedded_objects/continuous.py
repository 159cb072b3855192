"""Embedded objects with rotationally symmetric shapes; only the first one's texture determines the longitude."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image

from embedded_objects import textures as tx
from lp_framework.data.procedural.solids import curve, hollow, lathe, scene, torus


def soup_can() -> trimesh.Scene:
    """A tin of tomato soup whose label differs all the way around."""
    label, draw = tx.canvas(2048, 720, tx.CREAM)
    draw.rectangle([0, 0, 2048, 330], fill=tx.RED)
    draw.rectangle([0, 322, 2048, 338], fill=tx.MUSTARD)

    tx.text(label, "TOMATO", 1024, 130, 112, tx.WHITE, tx.MAROON)  # front
    tx.text(label, "soup", 1024, 250, 96, tx.MUSTARD)
    tx.dot(draw, 1024, 520, 150, tx.RED)
    tx.dot(draw, 970, 470, 36, tx.shade(tx.RED, 1.5))
    tx.star(draw, 1024, 400, 90, tx.FOREST, 6)

    draw.rectangle([1290, 0, 1740, 720], fill=tx.TEAL)  # right: a bowl
    for k in range(3):
        x = 1430 + 85 * k
        draw.line([(x, 300), (x + 24, 240), (x - 10, 180), (x + 14, 110)], fill=tx.WHITE, width=16, joint="curve")
    draw.chord([1330, 200, 1700, 610], 0, 180, fill=tx.WHITE)
    draw.ellipse([1330, 350, 1700, 460], fill=tx.CREAM)
    draw.ellipse([1350, 362, 1680, 448], fill=tx.ORANGE)
    for x, y in ((1450, 400), (1520, 420), (1590, 395)):
        draw.ellipse([x, y, x + 36, y + 14], fill=tx.FOREST)
    draw.rectangle([1440, 606, 1590, 636], fill=tx.WHITE)

    draw.rectangle([1790, 60, 2048, 660], fill=tx.WHITE)  # back, over the seam: table and bar code
    draw.rectangle([0, 60, 230, 660], fill=tx.WHITE)
    for row in range(10):
        y = 110 + 54 * row
        draw.line([(1800, y + 34), (2040, y + 34)], fill=tx.STEEL, width=4)
        draw.rectangle([1815, y, 1815 + 70 + 41 * (row * 3 % 4), y + 18], fill=tx.SLATE)
    random = np.random.default_rng(2)
    top = 100.0
    while top < 620:
        bar = random.uniform(5, 18)
        draw.rectangle([40, top, 190, top + bar], fill=tx.DARK)
        top += bar + random.uniform(6, 16)

    draw.rectangle([290, 0, 740, 720], fill=tx.NAVY)  # left: basil and a seal
    for x, y in ((430, 250), (600, 330), (430, 430), (600, 510)):
        draw.line([(515, y + 90), (x, y)], fill=tx.LEAF, width=12)
        draw.ellipse([x - 95, y - 52, x + 95, y + 52], fill=tx.LEAF)
        draw.line([(x - 80, y), (x + 80, y)], fill=tx.FOREST, width=7)
    draw.line([(515, 200), (515, 690)], fill=tx.LEAF, width=16)
    tx.star(draw, 515, 120, 100, tx.MUSTARD, 16)
    tx.text(label, "BIO", 515, 120, 50, tx.NAVY)

    tin = tx.bands([((k + 1) / 24, tx.shade(tx.STEEL, 1.25 if k % 3 else 0.9)) for k in range(24)])
    ribs = [(0.485 + 0.012 * np.cos(np.pi * k), 0.04 + 0.0225 * k) for k in range(5)]
    lower = lathe([(0, 0), (0.45, 0), *ribs, (0.485, 0.14), (0, 0.14)], 96)
    lid = [(0, 1.17), (0.2, 1.17), (0.21, 1.16), (0.3, 1.16), (0.31, 1.17), (0.45, 1.17), (0.46, 1.2), (0.5, 1.2)]
    upper = lathe([(0, 1.05), *[(r, 1.19 - h) for r, h in ribs][::-1], (0.49, 1.2), *lid[::-1]], 96)
    body = lathe([(0.49, 0.12), (0.49, 1.08)], 96)
    rims = torus(0.497, 0.022, 96).move(y=0.022) + torus(0.497, 0.022, 96).move(y=1.2)
    return scene(
        body.paint(tx.mottle(label, 0.03, 1)),
        lower.paint(tx.STEEL),
        upper.paint(tin),
        rims.paint(tx.STEEL),
    )


REPEATS = 16  # of the pattern, around the vase


def lotus_vase() -> trimesh.Scene:
    """A painted vase whose pattern repeats `REPEATS` times around it."""
    wide, high = 256, 2048  # of one repeat, downsampled later
    tile, draw = tx.canvas(wide, high, tx.CREAM)

    def level(top: int, bottom: int, colour: tx.Colour) -> None:
        draw.rectangle([0, top, wide, bottom], fill=colour)

    level(0, 90, tx.NAVY)
    level(90, 110, tx.MUSTARD)
    for x in (0, 128, 256):  # neck: hanging leaves
        draw.polygon([(x - 60, 150), (x + 60, 150), (x, 420)], fill=tx.TEAL)
        draw.polygon([(x - 28, 150), (x + 28, 150), (x, 300)], fill=tx.CREAM)
    level(110, 150, tx.NAVY)
    level(450, 470, tx.RED)
    level(490, 700, tx.NAVY)
    key = [(0, 670), (0, 520), (192, 520), (192, 632), (80, 632), (80, 585), (128, 585)]  # shoulder: a Greek key
    draw.line(key, fill=tx.CREAM, width=30, joint="curve")
    draw.line([(0, 670), (256, 670), (256, 520)], fill=tx.CREAM, width=30, joint="curve")
    level(720, 740, tx.RED)
    for lean in (-84, 84, -46, 46, 0):  # belly: lotus flowers, petal by petal
        reach = 380 - 2 * abs(lean)
        for size, colour in ((1.0, tx.RED), (0.84, tx.CREAM), (0.66, tx.ORANGE)):
            left, right = (128 + 0.55 * size * lean + side * 54 * size for side in (-1, 1))
            middle = 1190 - 0.5 * size * reach
            draw.polygon(
                [(128, 1190), (left, middle), (128 + size * lean, 1190 - size * reach), (right, middle)], fill=colour
            )
    draw.arc([-128, 1080, 128, 1330], 0, 180, fill=tx.FOREST, width=22)
    draw.arc([128, 1080, 384, 1330], 0, 180, fill=tx.FOREST, width=22)
    for x in (0, 256):
        tx.dot(draw, x, 900, 34, tx.TEAL)
        tx.dot(draw, x, 900, 16, tx.MUSTARD)
        draw.ellipse([x - 40, 1200, x + 40, 1300], fill=tx.TEAL)
    level(1380, 1400, tx.RED)
    level(1420, 1560, tx.NAVY)
    tx.dot(draw, 128, 1490, 44, tx.MUSTARD)
    tx.dot(draw, 0, 1490, 24, tx.CREAM)
    tx.dot(draw, 256, 1490, 24, tx.CREAM)
    level(1580, 1600, tx.RED)
    for x in (0, 128, 256):  # foot: rising leaves
        draw.polygon([(x - 60, 1980), (x + 60, 1980), (x, 1640)], fill=tx.TEAL)
        draw.polygon([(x - 26, 1980), (x + 26, 1980), (x, 1790)], fill=tx.MUSTARD)
    level(1960, 2048, tx.NAVY)
    small = np.asarray(tile.resize((64, 1024), Image.Resampling.LANCZOS))
    pattern = Image.fromarray(np.tile(small, (1, REPEATS, 1)))

    radii = [0.26, 0.29, 0.25, 0.36, 0.52, 0.48, 0.26, 0.21, 0.3]
    heights = [0, 0.03, 0.1, 0.32, 0.66, 0.93, 1.1, 1.22, 1.36]
    outside = curve(np.transpose([radii, heights]), 65)
    profile, share = hollow(outside, 0.03)
    return scene(lathe(profile, 96).paint(tx.band(pattern, 0.12 * share, share, tx.shade(tx.NAVY, 0.55))))


def celadon_bottle() -> trimesh.Scene:
    """A plain glazed bottle whose colour depends only on the height, darker where the glaze gathers."""
    radii = [0.3, 0.33, 0.31, 0.44, 0.5, 0.4, 0.19, 0.14, 0.15, 0.24]
    heights = [0, 0.03, 0.08, 0.24, 0.44, 0.66, 0.82, 1.0, 1.16, 1.28]
    profile, share = hollow(curve(np.transpose([radii, heights]), 73), 0.03)
    stops = np.array([0, 0.05, 0.09, 0.13, 0.3, 0.55, 0.8, 0.95, 0.985, 1.0, 1.02]) * share
    red = [112, 112, 92, 124, 150, 164, 146, 150, 176, 132, 70]
    green = [70, 70, 128, 166, 192, 204, 188, 190, 150, 100, 58]
    blue = [44, 44, 108, 142, 164, 176, 162, 164, 110, 70, 46]
    rows = 1 - (np.arange(1024) + 0.5) / 1024
    column = np.stack([np.interp(rows, stops, channel) for channel in (red, green, blue)], axis=1)
    glaze = np.broadcast_to(column[:, None].round().astype(np.uint8), (1024, 8, 3))
    return scene(lathe(profile, 96).paint(Image.fromarray(np.ascontiguousarray(glaze))))
