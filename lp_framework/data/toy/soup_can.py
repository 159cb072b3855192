"""`data=toy`: the soup can."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image

from lp_framework.data.toy import textures as tx
from lp_framework.data.toy.shapes import lathe, scene, torus


def soup_can() -> trimesh.Scene:
    """A tin of tomato soup; its label is different all the way round."""
    label = Image.new("RGB", (2048, 720), tx.CREAM)
    draw = tx.pen(label)
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
        [
            body.paint(tx.mottle(label, 0.03, 1)),
            lower.paint(tx.plain(tx.STEEL)),
            upper.paint(tin),
            rims.paint(tx.plain(tx.STEEL)),
        ]
    )
