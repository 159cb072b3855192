"""`data=toy`: the juice carton."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image

from lp_framework.data.toy import textures as tx
from lp_framework.data.toy.shapes import loft, plan, scene


def juice_carton() -> trimesh.Scene:
    """A gable-top carton: an orange on its front, a glass on its back, small print and stripes on its flanks."""
    x, z, height = 0.86, 0.66, 0.92
    front = Image.new("RGB", (688, 736), tx.SKY)
    draw = tx.pen(front)
    draw.polygon([(0, 736), (0, 560), (200, 480), (460, 560), (688, 470), (688, 736)], fill=tx.LEAF)
    tx.dot(draw, 344, 420, 236, tx.ORANGE)
    tx.dot(draw, 344, 420, 208, tx.CREAM)
    for angle in range(0, 360, 45):
        draw.pieslice([148, 224, 540, 616], angle + 4, angle + 41, fill=tx.shade(tx.ORANGE, 1.15))
    tx.dot(draw, 344, 420, 20, tx.CREAM)
    draw.ellipse([470, 150, 640, 240], fill=tx.FOREST)
    draw.line([(480, 195), (630, 195)], fill=tx.LEAF, width=6)
    tx.text(front, "ORANGE", 344, 92, 140, tx.WHITE, tx.NAVY)
    tx.text(front, "1 litre", 580, 670, 52, tx.WHITE)

    back = Image.new("RGB", (688, 736), tx.MUSTARD)
    draw = tx.pen(back)
    for angle in np.radians(np.arange(0, 360, 24)):
        tip = [(344 + 800 * np.cos(angle + d), 430 + 800 * np.sin(angle + d)) for d in (-0.1, 0.1)]
        draw.polygon([(344, 430), *tip], fill=tx.shade(tx.MUSTARD, 1.35))
    draw.polygon([(210, 200), (478, 200), (440, 616), (248, 616)], fill=tx.WHITE)
    draw.polygon([(227, 300), (461, 300), (430, 600), (258, 600)], fill=tx.ORANGE)
    draw.line([(380, 520), (500, 90)], fill=tx.RED, width=24)
    draw.line([(500, 90), (580, 70)], fill=tx.RED, width=24)
    for ice in ((270, 330), (350, 360)):
        draw.rounded_rectangle([*ice, ice[0] + 70, ice[1] + 70], radius=12, fill=tx.shade(tx.ORANGE, 1.45))
    draw.rectangle([0, 640, 688, 736], fill=tx.MAROON)
    tx.text(back, "SHAKE WELL", 344, 680, 56, tx.CREAM)

    left = Image.new("RGB", (528, 736), tx.CREAM)
    draw = tx.pen(left)
    draw.rectangle([50, 60, 478, 470], outline=tx.NAVY, width=8)
    tx.text(left, "NUTRITION", 264, 110, 58, tx.NAVY)
    for row in range(6):
        y = 175 + 48 * row
        draw.line([(60, y - 22), (468, y - 22)], fill=tx.NAVY, width=3)
        draw.rectangle([75, y - 8, 75 + 60 + 37 * (row * 5 % 7), y + 10], fill=tx.SLATE)
        draw.rectangle([400, y - 8, 450, y + 10], fill=tx.SLATE)
    random = np.random.default_rng(1)
    x0 = 110.0
    while x0 < 410:
        bar = random.uniform(4, 15)
        draw.rectangle([x0, 530, x0 + bar, 680], fill=tx.DARK)
        x0 += bar + random.uniform(5, 14)

    right = Image.new("RGB", (528, 736), tx.NAVY)
    draw = tx.pen(right)
    for k, colour in enumerate((tx.RED, tx.ORANGE, tx.MUSTARD)):
        draw.polygon([(0, 500 + 70 * k), (528, 250 + 70 * k), (528, 320 + 70 * k), (0, 570 + 70 * k)], fill=colour)
    for cx, cy, r in ((120, 130, 70), (300, 90, 50), (420, 200, 60), (400, 640, 54), (200, 300, 40)):
        tx.dot(draw, cx, cy, r, tx.ORANGE)
        tx.dot(draw, cx - r / 3, cy - r / 3, r / 4, tx.shade(tx.ORANGE, 1.5))
        draw.ellipse([cx, cy - r - 14, cx + r, cy - r + 18], fill=tx.LEAF)
    print_sheet = tx.mottle(tx.wrapped(front, right, back, left), 0.03, 4)

    corner = 0.03
    body = loft(np.stack([plan(x, z, corner, y, 192) for y in (0, 0.015, height)]))
    slopes = tx.wrapped(
        *(Image.new("RGB", (w, 340), c) for w, c in ((688, tx.NAVY), (528, tx.NAVY), (688, tx.MAROON), (528, tx.CREAM)))
    )
    tx.text(slopes, "100 %", 344 + 528 + 344, 170, 170, tx.WHITE)
    t = np.linspace(0, 1, 6)
    gable = loft(np.stack([plan(x, z, corner, height + 0.3 * s, 192) * (1, 1, 1 - 0.94 * s) for s in t]))
    fin_rings = [plan(x + 0.02, 0.06, 0.015, height + y) for y in (0.28, 0.3, 0.42, 0.43)]
    fin = loft(np.stack(fin_rings))
    fin_print = tx.wrapped(
        *(Image.new("RGB", (w, 64), c) for w, c in ((688, tx.WHITE), (48, tx.WHITE), (688, tx.MUSTARD), (48, tx.WHITE)))
    )
    base = loft(np.stack([plan(x + 0.006, z + 0.006, corner, y) for y in (-0.01, 0.03)]))
    return scene(
        [
            body.paint(print_sheet),
            gable.paint(slopes),
            fin.paint(fin_print),
            base.paint(tx.plain(tx.NAVY)),
        ]
    )
