"""`data=toy`: the cottage."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image

from lp_framework.data.toy import textures as tx
from lp_framework.data.toy.shapes import box, cylinder, ellipsoid, extrude, joined, lathe, rod, scene


def cottage() -> trimesh.Scene:
    """A cottage: porch to the front, shed to the right, solar panels and a tree behind, a chimney stack to the left."""
    plaster = tx.mottle(Image.new("RGB", (650, 400), tx.CREAM), 0.07, 1)
    front = plaster.copy()
    draw = tx.pen(front)
    for x in (60, 270):
        for side in (x - 42, x + 122):
            draw.rectangle([side, 120, side + 40, 270], fill=tx.TEAL)
            for y in range(132, 262, 16):
                draw.line([(side + 5, y), (side + 35, y)], fill=tx.shade(tx.TEAL, 0.7), width=4)
        tx.window(draw, x, 118, x + 120, 272, tx.WHITE)
    draw.rectangle([0, 350, 650, 400], fill=tx.SLATE)

    left = tx.bricks(tx.shade(tx.RED, 0.85), tx.CREAM, 550, 400, 14, 2)
    tx.window(tx.pen(left), 40, 120, 150, 260, tx.WHITE)
    tx.window(tx.pen(left), 400, 120, 510, 260, tx.WHITE)

    back = tx.planks(tx.SKY, 650, 400, 9, 3)
    draw = tx.pen(back)
    tx.window(draw, 60, 90, 330, 260, tx.WHITE, bars=3)
    draw.rectangle([440, 110, 580, 400], fill=tx.FOREST)
    tx.window(draw, 460, 130, 560, 240, tx.WHITE)
    tx.dot(draw, 562, 290, 9, tx.MUSTARD)

    right = plaster.resize((550, 400))
    random = np.random.default_rng(5)
    for x, y in zip(random.normal(390, 75, 420), 400 - abs(random.normal(0, 160, 420)), strict=True):
        tx.dot(tx.pen(right), x, y, random.uniform(5, 11), tx.shade(tx.FOREST, random.uniform(0.8, 1.3)))

    walls = box(1.3, 0.8, 1.1, 0.01).move(y=0.52)
    gable_right = plaster.resize((512, 384))
    draw = tx.pen(gable_right)
    tx.dot(draw, 256, 240, 74, tx.WHITE)
    tx.dot(draw, 256, 240, 58, tx.GLASS)
    draw.line([(256, 170), (256, 310)], fill=tx.WHITE, width=10)
    draw.line([(186, 240), (326, 240)], fill=tx.WHITE, width=10)
    gable_left = tx.bricks(tx.shade(tx.RED, 0.85), tx.CREAM, 512, 384, 10, 2)
    gable = extrude([(-0.55, 0), (0.55, 0), (0, 0.55)], 1.3, 0.005).turn("y", 90).move(y=0.9)

    slope = box(1.56, 0.08, 0.98, 0.025).move(z=0.45).turn("x", 45)
    tiles = tx.shingles(tx.shade(tx.RED, 0.95), 768, 480, 9, 1)
    moss = tx.shingles(tx.SLATE, 768, 480, 9, 2)
    panel = Image.new("RGB", (400, 240), tx.NAVY)
    for x in range(0, 401, 50):
        tx.pen(panel).line([(x, 0), (x, 240)], fill=tx.STEEL, width=3)
    for y in range(0, 241, 60):
        tx.pen(panel).line([(0, y), (400, y)], fill=tx.STEEL, width=3)
    panels = box(0.95, 0.05, 0.55, 0.01).move(0.1, 0.05, 0.45).turn("x", 45).scale(z=-1).move(y=1.47)

    brick = tx.bricks(tx.shade(tx.RED, 0.75), tx.CREAM, 256, 768, 26, 7)
    stack = box(0.26, 1.7, 0.4, 0.015).move(-0.76, 0.96, 0.1)
    pots = joined(
        [
            lathe([(0, 0), (0.07, 0), (0.09, 0.2), (0.05, 0.2), (0.05, 0.1), (0, 0.1)], 20).move(-0.76, 1.84, z)
            for z in (0.02, 0.18)
        ]
    )

    boards = tx.planks(tx.WOOD, 384, 384, 7, 4).rotate(90)
    hatch = boards.copy()
    tx.pen(hatch).rectangle([110, 90, 290, 384], fill=tx.LEAF, outline=tx.FOREST, width=10)
    tx.pen(hatch).line([(110, 380), (290, 100)], fill=tx.FOREST, width=14)
    shed = box(0.46, 0.52, 0.72, 0.01).move(0.86, 0.36, -0.15)
    shed_roof = box(0.6, 0.05, 0.86, 0.015).turn("z", -20).move(0.86, 0.7, -0.15)

    door = Image.new("RGB", (200, 360), tx.MAROON)
    for area in ([25, 25, 92, 160], [108, 25, 175, 160], [25, 190, 92, 335], [108, 190, 175, 335]):
        tx.pen(door).rectangle(area, fill=tx.RED)
    tx.dot(tx.pen(door), 170, 180, 11, tx.MUSTARD)
    entrance = box(0.26, 0.5, 0.05, 0.01).move(0.38, 0.37, 0.56)
    posts = joined([cylinder(0.035, 0.56, 0.0, 16).move(x, 0.4, 0.86) for x in (0.18, 0.58)])
    porch = extrude([(-0.3, 0), (0.3, 0), (0, 0.24)], 0.42, 0.015).move(0.38, 0.68, 0.72)
    step = box(0.56, 0.08, 0.4, 0.02).move(0.38, 0.14, 0.74)
    boxes = joined([box(0.26, 0.07, 0.09, 0.015).move(x, 0.36, 0.59) for x in (-0.41, 0.01)])
    blooms = [
        ellipsoid(0.045, 0.05, 0.045, 12).move(x + d, 0.42, 0.59) for x in (-0.41, 0.01) for d in (-0.09, 0, 0.09)
    ]

    lawn = tx.mottle(Image.new("RGB", (512, 512), tx.LEAF), 0.25, 9, 30)
    flagstone = cylinder(0.1, 0.03, 0.01, 20).scale(1.5, 1, 0.6).move(0.4, 0.12, 0.98)
    leaves = tx.mottle(Image.new("RGB", (256, 256), tx.FOREST), 0.35, 4, 14)
    crown = [(-0.72, 1.02, -0.86, 0.3), (-0.9, 0.78, -0.78, 0.24), (-0.52, 0.8, -0.9, 0.25), (-0.72, 1.28, -0.86, 0.2)]
    foliage = joined([ellipsoid(r, 0.9 * r, r, 24).move(x, y, z) for x, y, z, r in crown])
    bushes = joined(
        [
            ellipsoid(r, r, r, 20).move(x, 0.12 + 0.6 * r, z)
            for x, z, r in [(0.95, 0.55, 0.2), (0.78, 0.68, 0.14), (-0.6, 0.7, 0.12)]
        ]
    )
    mailbox = box(0.12, 0.14, 0.2, 0.03).move(-0.86, 0.5, 0.84)
    stone = tx.painted(tx.STEEL, 3, 0.15)
    return scene(
        [
            box(2.2, 0.12, 2.1, 0.05).move(0, 0.06).paint(tx.all_sides(lawn)),
            walls.paint(tx.box_sheet(front, right, back, left, plaster, plaster)),
            gable.paint(tx.slab_sheet(gable_right, gable_left, tx.plain(tx.CREAM))),
            slope.move(y=1.47).paint(tx.all_sides(tiles)),
            slope.turn("y", 180).move(y=1.47).paint(tx.all_sides(moss)),
            panels.paint(tx.all_sides(panel)),
            stack.paint(tx.all_sides(brick)),
            box(0.32, 0.07, 0.46, 0.015).move(-0.76, 1.81, 0.1).paint(tx.plain(tx.SLATE)),
            pots.paint(tx.plain(tx.ORANGE)),
            shed.paint(tx.box_sheet(boards, hatch, boards, boards, boards, boards)),
            shed_roof.paint(tx.all_sides(tx.shingles(tx.TEAL, 384, 384, 7, 8))),
            entrance.paint(tx.box_sheet(door, door, door, door, door, door)),
            posts.paint(tx.plain(tx.WHITE)),
            porch.paint(tx.slab_sheet(tx.plain(tx.WHITE), tx.plain(tx.WHITE), tiles)),
            (step + flagstone).paint(stone),
            boxes.paint(tx.painted(tx.BROWN)),
            joined(blooms).paint(tx.plain(tx.PINK)),
            rod((-0.72, 0.1, -0.84), (-0.72, 0.9, -0.86), 0.075).paint(tx.painted(tx.BROWN, 2, 0.3)),
            foliage.paint(leaves),
            bushes.paint(tx.mottle(Image.new("RGB", (256, 256), tx.LEAF), 0.35, 5, 14)),
            mailbox.paint(tx.plain(tx.BLUE)),
            rod((-0.86, 0.1, 0.84), (-0.86, 0.46, 0.84), 0.03).paint(tx.plain(tx.BROWN)),
        ]
    )
