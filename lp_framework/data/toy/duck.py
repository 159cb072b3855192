"""`data=toy`: the duck."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image

from lp_framework.data.toy import textures as tx
from lp_framework.data.toy.shapes import (
    box,
    curve,
    ellipsoid,
    joined,
    lathe,
    loft,
    rod,
    scene,
    torus,
    tube,
    wheel,
)


def duck() -> trimesh.Scene:
    """A pull-along duck heading for +X, cap askew, its left wing lifted; red wheels on the right, blue on the left."""
    stations = curve(  # x, centre height, half height, half width
        [
            (-0.86, 1.02, 0.015, 0.03),
            (-0.74, 0.93, 0.1, 0.14),
            (-0.52, 0.78, 0.24, 0.32),
            (-0.15, 0.68, 0.36, 0.44),
            (0.22, 0.68, 0.38, 0.44),
            (0.5, 0.76, 0.3, 0.33),
            (0.62, 0.82, 0.16, 0.18),
            (0.65, 0.84, 0.01, 0.01),
        ],
        41,
    )
    angle = np.linspace(0, 2 * np.pi, 41)[:-1]
    x, centre, high, wide = (column[:, None] for column in stations.T)
    rings = np.stack(
        [x + 0 * angle, centre - high * np.cos(angle), wide * np.sin(angle)], axis=-1
    )  # keel, +Z, back, -Z
    feathers = Image.new("RGB", (1024, 1024), tx.MUSTARD)
    draw = tx.pen(feathers)
    draw.rectangle([0, 0, 256, 1024], fill=tx.shade(tx.MUSTARD, 1.35))
    draw.rectangle([768, 0, 1024, 1024], fill=tx.shade(tx.MUSTARD, 1.35))
    for top in range(850, 1024, 45):
        draw.rectangle([0, top, 1024, top + 20], fill=tx.BROWN)
    feathers = tx.mottle(feathers, 0.05, 2)
    body = loft(rings).paint(feathers)

    head_paint = tx.mottle(Image.new("RGB", (512, 512), tx.MUSTARD), 0.04, 3)
    for cheek in (256, 0, 512):  # +Z, and -Z at both ends
        tx.dot(tx.pen(head_paint), cheek + (52 if cheek == 256 else -52), 285, 30, tx.PINK)
    head = ellipsoid(0.35, 0.34, 0.33).move(0.44, 1.3)
    bill = ellipsoid(0.24, 0.06, 0.17, 28).turn("z", 6).move(0.82, 1.24)
    jaw = ellipsoid(0.18, 0.05, 0.13, 28).turn("z", -8).move(0.78, 1.17)
    whites = joined([ellipsoid(0.085, 0.1, 0.06, 24).turn("y", -40 * s).move(0.64, 1.4, 0.235 * s) for s in (-1, 1)])
    pupils = joined(
        [ellipsoid(0.045, 0.055, 0.035, 20).turn("y", -40 * s).move(0.685, 1.4, 0.272 * s) for s in (-1, 1)]
    )

    scallops = []
    for colour, tip in ((tx.RED, tx.MAROON), (tx.SKY, tx.BLUE)):
        wing = Image.new("RGB", (512, 512), colour)
        for row in range(9, -1, -1):  # feathers, each row over the one behind
            for column in range(9):
                x, y = 64 * column - 32 * (row % 2), 56 * row
                fill, edge = (tip, colour)[row % 2], tx.shade(tip, 0.6)
                tx.pen(wing).rounded_rectangle([x, y - 60, x + 63, y + 50], radius=31, fill=fill, outline=edge, width=4)
        scallops.append(wing)
    feather = ellipsoid(0.2, 0.38, 0.09, 36).turn("z", -90)
    folded = feather.turn("z", -14).move(-0.12, 0.76, 0.45)
    lifted = feather.turn("z", -38).turn("x", -52).move(-0.16, 1.02, -0.56)

    brim = lathe([(0, -0.03), (0.27, -0.05), (0.31, -0.01), (0.29, 0.09), (0.24, 0.1), (0, 0.1)], 48)
    crown = ellipsoid(0.33, 0.11, 0.33).move(y=0.13)
    cap = {"y": 1.6, "x": 0.4, "z": 0.06}
    ribbon = joined([ellipsoid(0.13, 0.025, 0.05, 20).turn("z", 25 * s).move(0.2, 1.5, 0.32) for s in (-1, 1)])
    knot = ellipsoid(0.09, 0.09, 0.09, 20).move(0.62, 0.98)
    tie = [ellipsoid(0.06, 0.1, 0.15, 24).turn("x", 15 * s).move(0.6, 0.98, 0.15 * s) for s in (-1, 1)]
    scarf = torus(0.25, 0.065).turn("z", -14).move(0.4, 1.03)

    board = tx.planks(tx.WOOD, 768, 384, 3, 4)
    base = box(1.5, 0.12, 0.7, 0.05).move(0, 0.26)
    wheels = [joined([wheel(0.2, 0.12).move(x, 0.2, z) for x in (-0.5, 0.5)]) for z in (0.42, -0.42)]
    axles = joined([rod((x, 0.2, -0.46), (x, 0.2, 0.46), 0.03) for x in (-0.5, 0.5)])
    string = tube(curve([(0.74, 0.26, 0), (0.86, 0.2, 0.02), (0.98, 0.22, 0.06), (1.08, 0.34, 0.1)], 24), 0.014, 8)
    return scene(
        [
            body,
            head.paint(head_paint),
            joined([bill, jaw]).paint(tx.painted(tx.ORANGE)),
            whites.paint(tx.plain(tx.WHITE)),
            pupils.paint(tx.plain(tx.DARK)),
            folded.paint(scallops[0]),
            lifted.paint(scallops[1]),
            brim.turn("x", 14).move(**cap).paint(tx.plain(tx.NAVY)),
            crown.turn("x", 14).move(**cap).paint(tx.plain(tx.WHITE)),
            ellipsoid(0.06, 0.06, 0.06, 16).move(0.4, 1.84, 0.12).paint(tx.plain(tx.RED)),
            ribbon.paint(tx.plain(tx.NAVY)),
            joined([knot, *tie]).paint(tx.plain(tx.TEAL)),
            scarf.paint(tx.plain(tx.TEAL)),
            base.paint(tx.all_sides(board)),
            wheels[0].paint(tx.wheel_paint(tx.CREAM, tx.RED)),
            wheels[1].paint(tx.wheel_paint(tx.CREAM, tx.BLUE)),
            axles.paint(tx.plain(tx.SLATE)),
            string.paint(tx.plain(tx.CREAM)),
            ellipsoid(0.08, 0.08, 0.08, 20).move(1.1, 0.38, 0.11).paint(tx.plain(tx.RED)),
        ]
    )
