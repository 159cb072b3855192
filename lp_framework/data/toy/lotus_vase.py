"""`data=toy`: the lotus vase."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image

from lp_framework.data.toy import textures as tx
from lp_framework.data.toy.shapes import curve, hollow, lathe, scene

REPEATS = 16  # of the pattern, around the vase


def lotus_vase() -> trimesh.Scene:
    """A painted vase; its pattern repeats `REPEATS` times around it."""
    wide, high = 256, 2048  # of one repeat, which is then reduced
    tile = Image.new("RGB", (wide, high), tx.CREAM)
    draw = tx.pen(tile)

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

    outside = curve(
        [
            (0.26, 0),
            (0.29, 0.03),
            (0.25, 0.1),
            (0.36, 0.32),
            (0.52, 0.66),
            (0.48, 0.93),
            (0.26, 1.1),
            (0.21, 1.22),
            (0.3, 1.36),
        ],
        65,
    )
    profile, share = hollow(outside, 0.03)
    return scene([lathe(profile, 96).paint(tx.band(pattern, 0.12 * share, share, tx.shade(tx.NAVY, 0.55)))])
