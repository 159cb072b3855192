"""`data=toy`: the robot."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image

from lp_framework.data.toy import textures as tx
from lp_framework.data.toy.shapes import (
    Shape,
    arc,
    box,
    curve,
    cylinder,
    ellipsoid,
    joined,
    lathe,
    rod,
    scene,
    torus,
    tube,
)


def robot() -> trimesh.Scene:
    """A tin robot: dials in front, a key in its back, a claw raised on its left, a hammer hanging on its right."""
    tin = tx.mottle(Image.new("RGB", (512, 512), tx.TEAL), 0.05, 1)
    chest = tin.copy()
    draw = tx.pen(chest)
    draw.rounded_rectangle([60, 60, 452, 300], radius=26, fill=tx.CREAM, outline=tx.DARK, width=8)
    tx.dot(draw, 165, 180, 84, tx.DARK)
    tx.dot(draw, 165, 180, 74, tx.WHITE)
    for angle in np.radians(np.arange(-120, 121, 30)):
        s, c = np.sin(angle), np.cos(angle)
        draw.line([(165 + 54 * s, 180 - 54 * c), (165 + 68 * s, 180 - 68 * c)], fill=tx.DARK, width=6)
    draw.line([(165, 180), (205, 128)], fill=tx.RED, width=9)
    for k, colour in enumerate((tx.RED, tx.MUSTARD, tx.LEAF)):
        tx.dot(draw, 300 + 58 * k, 130, 24, tx.DARK)
        tx.dot(draw, 300 + 58 * k, 130, 19, colour)
    for k, high in enumerate((50, 76, 38, 64, 84, 30)):
        draw.rectangle([284 + 25 * k, 275 - high, 302 + 25 * k, 275], fill=tx.ORANGE)
    for y in range(350, 450, 30):
        draw.rounded_rectangle([130, y, 382, y + 14], radius=7, fill=tx.shade(tx.TEAL, 0.5))
    spine = tin.copy()
    draw = tx.pen(spine)
    draw.rounded_rectangle([90, 70, 422, 440], radius=20, fill=tx.NAVY)
    for y in range(320, 430, 26):
        draw.line([(130, y), (382, y)], fill=tx.SKY, width=8)
    tx.text(spine, "R-12", 256, 110, 60, tx.MUSTARD)
    ribs = []
    for colour in (tx.RED, tx.MUSTARD):
        flank = tx.mottle(Image.new("RGB", (400, 512), colour), 0.05, 2)
        draw = tx.pen(flank)
        draw.rectangle([0, 380, 400, 430], fill=tx.CREAM)
        tx.star(draw, 200, 240, 90, tx.CREAM)
        ribs.append(flank)
    for picture in (chest, spine, *ribs):
        tx.rivets(picture, 22, 70, 8, tx.STEEL)
    torso = box(0.86, 0.86, 0.62, 0.08).move(y=1.05).paint(tx.box_sheet(chest, ribs[1], spine, ribs[0], tin, tin))

    face = tx.mottle(Image.new("RGB", (512, 400), tx.CREAM), 0.04, 4)
    draw = tx.pen(face)
    draw.rounded_rectangle([50, 50, 462, 230], radius=70, fill=tx.DARK)
    draw.rounded_rectangle([150, 270, 362, 350], radius=14, fill=tx.DARK)
    for x in range(160, 352, 32):
        draw.rectangle([x, 280, x + 22, 306], fill=tx.WHITE)
        draw.rectangle([x, 314, x + 22, 340], fill=tx.WHITE)
    nape = tx.mottle(Image.new("RGB", (512, 400), tx.NAVY), 0.05, 5)
    for y in range(80, 340, 44):
        tx.pen(nape).rounded_rectangle([110, y, 402, y + 20], radius=10, fill=tx.DARK)
    cheeks = [tx.mottle(Image.new("RGB", (400, 400), colour), 0.05, 6) for colour in (tx.RED, tx.MUSTARD)]
    for picture in (face, nape, *cheeks):
        tx.rivets(picture, 20, 80, 8, tx.STEEL)
    head = box(0.64, 0.5, 0.54, 0.09).move(y=1.82)
    eyes = [ellipsoid(0.1, 0.1, 0.07, 28).move(x, 1.885, 0.26) for x in (-0.13, 0.13)]
    pupils = joined([ellipsoid(0.045, 0.045, 0.03, 20).move(x + 0.015, 1.88, 0.325) for x in (-0.13, 0.13)])
    dish = lathe([(0, 0), (0.08, 0.01), (0.16, 0.05), (0.21, 0.11), (0.18, 0.11), (0.07, 0.04), (0, 0.03)], 36)
    dish = dish.turn("z", 90).move(-0.42, 1.86) + rod((-0.3, 1.86, 0), (-0.52, 1.86, 0), 0.035)
    ear = cylinder(0.12, 0.12, 0.03, 32).turn("z", 90).move(0.36, 1.84)
    aerial = tube(curve([(0.18, 2.05, 0), (0.2, 2.2, 0), (0.28, 2.32, 0)], 10), 0.02)
    neck = joined([torus(0.14, 0.045).move(y=y) for y in (1.5, 1.55)])

    def hose(points: list[tuple[float, float, float]]) -> Shape:
        path = curve(points, 29)
        return tube(path, 0.085 + 0.018 * np.cos(np.arange(29) * np.pi), 18)

    raised = hose([(0.42, 1.3, 0), (0.68, 1.3, 0.02), (0.84, 1.5, 0.1), (0.82, 1.78, 0.18)])
    hanging = hose([(-0.42, 1.3, 0), (-0.62, 1.24, 0), (-0.7, 1.0, 0.04), (-0.68, 0.76, 0.14)])
    claw = tube(np.pad(arc((0, 0.13), 0.14, -235, 55, 21), ((0, 0), (0, 1))), 0.05)
    claw = (claw + cylinder(0.11, 0.1, 0.02).move(y=-0.04)).turn("x", 15).move(0.82, 1.85, 0.2)
    fist = ellipsoid(0.13, 0.13, 0.13, 28).move(-0.68, 0.7, 0.16)
    handle = rod((-0.68, 0.7, -0.12), (-0.68, 0.7, 0.62), 0.04)
    mallet = cylinder(0.13, 0.36, 0.03).move(-0.68, 0.7, 0.6)
    shoulders = [ellipsoid(0.17, 0.19, 0.19, 28).move(x, 1.3) for x in (-0.46, 0.46)]
    legs = joined([hose([(x, 0.66, 0), (x, 0.5, 0), (x, 0.36, 0), (x, 0.2, 0)]) for x in (-0.22, 0.22)])
    boots = [box(0.34, 0.24, 0.56, 0.09).move(x, 0.13, 0.08) for x in (-0.23, 0.23)]
    bow = [torus(0.1, 0.035).turn("x", 90).scale(1.15, 0.9, 1).move(x, 1.15, -0.56) for x in (-0.13, 0.13)]
    key = joined([*bow, rod((0, 1.15, -0.28), (0, 1.15, -0.56), 0.04)])
    return scene(
        [
            torso,
            head.paint(tx.box_sheet(face, cheeks[1], nape, cheeks[0], tin, tin)),
            joined(eyes).paint(tx.plain(tx.MUSTARD)),
            pupils.paint(tx.plain(tx.DARK)),
            dish.paint(tx.plain(tx.STEEL)),
            ear.paint(tx.plain(tx.RED)),
            aerial.paint(tx.plain(tx.STEEL)),
            ellipsoid(0.06, 0.06, 0.06, 20).move(0.29, 2.36).paint(tx.plain(tx.RED)),
            neck.paint(tx.plain(tx.SLATE)),
            joined([raised, hanging, legs]).paint(tx.plain(tx.STEEL)),
            claw.paint(tx.plain(tx.ORANGE)),
            fist.paint(tx.plain(tx.NAVY)),
            handle.paint(tx.plain(tx.WOOD)),
            mallet.paint(tx.bands([(0.32, tx.DARK), (0.68, tx.MAROON), (1, tx.DARK)])),
            shoulders[0].paint(tx.plain(tx.RED)),
            shoulders[1].paint(tx.plain(tx.MUSTARD)),
            boots[0].paint(tx.painted(tx.RED)),
            boots[1].paint(tx.painted(tx.MUSTARD)),
            key.paint(tx.plain(tx.MUSTARD)),
        ]
    )
