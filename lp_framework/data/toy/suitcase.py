"""`data=toy`: the suitcase."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image

from lp_framework.data.toy import textures as tx
from lp_framework.data.toy.shapes import both, box, curve, cylinder, extrude, joined, rounded, scene, tube


def suitcase() -> trimesh.Scene:
    """A travelling case: one shell of teal and one of mustard leather, with the stickers of two journeys."""
    shells = [
        tx.mottle(Image.new("RGB", (640, 448), colour), 0.08, seed, 30)
        for seed, colour in ((1, tx.TEAL), (2, tx.MUSTARD))
    ]
    front, back = shells[0].copy(), shells[1].copy()

    draw = tx.pen(front)
    tx.dot(draw, 318, 150, 96, tx.CREAM)
    tx.dot(draw, 318, 150, 86, tx.RED)
    tx.star(draw, 318, 112, 34, tx.CREAM)
    tx.text(front, "OSLO", 318, 178, 54, tx.CREAM)
    draw.polygon([(215, 280), (420, 260), (430, 380), (225, 400)], fill=tx.WHITE)
    draw.polygon([(225, 289), (412, 271), (420, 371), (233, 390)], fill=tx.SKY)
    draw.polygon([(233, 390), (290, 300), (330, 350), (362, 310), (420, 371)], fill=tx.NAVY)
    draw.polygon([(290, 300), (276, 322), (290, 318), (306, 320)], fill=tx.WHITE)
    for k, colour in enumerate((tx.LEAF, tx.WHITE, tx.RED)):
        draw.rectangle([546 + 28 * k, 120, 574 + 28 * k, 190], fill=colour)
    tx.flower(draw, 54, 200, 44, tx.PINK, tx.MUSTARD)
    draw.rounded_rectangle([546, 250, 630, 320], radius=14, fill=tx.MAROON)
    tx.text(front, "24", 588, 285, 52, tx.CREAM)
    draw.polygon([(14, 300), (94, 290), (98, 330), (18, 340)], fill=tx.CREAM)
    draw.line([(24, 318), (88, 310)], fill=tx.RED, width=10)

    draw = tx.pen(back)
    draw.ellipse([200, 60, 440, 230], fill=tx.WHITE)
    draw.ellipse([210, 70, 430, 220], fill=tx.ORANGE)
    draw.chord([210, 70, 430, 220], 20, 160, fill=tx.BLUE)
    draw.line([(330, 200), (320, 120)], fill=tx.BROWN, width=10)
    for dx, dy in ((-52, 6), (-34, -26), (10, -34), (48, -10), (44, 20)):
        draw.line([(320, 122), (320 + dx, 122 + dy)], fill=tx.FOREST, width=14)
    draw.rectangle([230, 280, 430, 390], fill=tx.NAVY)
    draw.rectangle([240, 290, 420, 380], outline=tx.CREAM, width=5)
    tx.text(back, "ROMA", 330, 336, 54, tx.CREAM)
    tx.star(draw, 54, 160, 46, tx.RED)
    draw.polygon([(546, 180), (628, 170), (634, 240), (552, 250)], fill=tx.WHITE)
    tx.dot(draw, 590, 210, 24, tx.RED)
    for y in range(250, 340, 26):
        draw.rectangle([14, y, 94, y + 12], fill=tx.MAROON)

    def halves(a: Image.Image, b: Image.Image) -> Image.Image:
        """`a` left and `b` right."""
        picture = a.resize((448, 448))
        picture.paste(b.resize((448, 448)).crop((224, 0, 448, 448)), (224, 0))
        return picture

    teal, tan = shells
    right, left, lid = halves(teal, tan), halves(tan, teal), halves(tan, teal).rotate(-90)
    wide, tall, deep = 1.36, 0.94, 0.5
    shell = box(wide, tall, deep, 0.1, 5).paint(tx.box_sheet(front, right, back, left, lid, lid))
    leather = tx.mottle(Image.new("RGB", (256, 256), tx.BROWN), 0.15, 3, 16)
    stitched = leather.resize((1024, 256))
    for edge in (70, 186):
        for k in range(0, 1024, 20):
            tx.pen(stitched).line([(k, edge), (k + 11, edge)], fill=tx.CREAM, width=14)
    seam = box(wide + 0.025, tall + 0.025, 0.06, 0.025).paint(tx.all_sides(leather))
    around = [(-deep / 2, -tall / 2), (deep / 2, -tall / 2), (deep / 2, tall / 2), (-deep / 2, tall / 2)]
    belt = extrude(rounded(np.array(around) * 1.05, 0.16, 7), 0.11, 0.012).turn("y", 90)
    straps = joined([belt.move(s * 0.4) for s in (-1, 1)])
    caps = joined(
        [
            box(0.17, 0.17, 0.15, 0.07).move(sx * (wide / 2 - 0.07), sy * (tall / 2 - 0.07), sz * (deep / 2 - 0.06))
            for sx in (-1, 1)
            for sy in (-1, 1)
            for sz in (-1, 1)
        ]
    )
    buckles = joined([box(0.17, 0.12, 0.03, 0.014).move(s * 0.4, 0.12, deep / 2 + 0.02) for s in (-1, 1)])
    tongues = joined([box(0.03, 0.15, 0.04, 0.01).move(s * 0.4, 0.12, deep / 2 + 0.025) for s in (-1, 1)])
    locks = joined([box(0.13, 0.05, 0.13, 0.015).move(s * 0.2, tall / 2 + 0.005) for s in (-1, 1)])
    grip = tube(
        curve(
            [(-0.2, 0.45, 0), (-0.19, 0.56, 0), (-0.1, 0.62, 0), (0.1, 0.62, 0), (0.19, 0.56, 0), (0.2, 0.45, 0)], 41
        ),
        0.04,
    )
    feet = joined(
        [cylinder(0.05, 0.06, 0.01, 24).move(sx * 0.5, -tall / 2 - 0.03, sz * 0.15) for sx in (-1, 1) for sz in (-1, 1)]
    )
    return scene(
        [
            shell,
            seam,
            straps.paint(tx.slab_sheet(leather, leather, stitched)),
            caps.paint(tx.all_sides(leather)),
            both(buckles).paint(tx.plain(tx.STEEL)),
            both(tongues).paint(tx.plain(tx.BROWN)),
            locks.paint(tx.plain(tx.STEEL)),
            grip.paint(leather),
            feet.paint(tx.plain(tx.DARK)),
        ]
    )
