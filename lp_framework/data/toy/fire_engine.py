"""`data=toy`: the fire engine."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image

from lp_framework.data.toy import textures as tx
from lp_framework.data.toy.shapes import (
    box,
    cylinder,
    ellipsoid,
    extrude,
    joined,
    lathe,
    rod,
    rounded,
    scene,
    torus,
    wheel,
)


def fire_engine() -> trimesh.Scene:
    """A fire engine heading for +X: ladder over its right flank, hose reel over its left."""
    right = tx.mottle(Image.new("RGB", (950, 450), tx.RED), 0.04)
    draw = tx.pen(right)
    draw.rectangle([0, 330, 950, 372], fill=tx.WHITE)
    for k in range(3):
        x = 60 + 215 * k
        draw.rounded_rectangle([x, 50, x + 190, 310], radius=10, fill=tx.shade(tx.RED, 0.6))
        for y in range(62, 300, 20):
            draw.rectangle([x + 12, y, x + 178, y + 14], fill=tx.STEEL)
            draw.line([(x + 12, y + 14), (x + 178, y + 14)], fill=tx.SLATE, width=3)
        draw.rectangle([x + 70, 286, x + 120, 298], fill=tx.DARK)
    draw.ellipse([730, 80, 910, 260], fill=tx.WHITE)
    tx.text(right, "7", 820, 172, 150, tx.RED)
    draw.pieslice([195, 330, 495, 630], 180, 360, fill=tx.DARK)

    left = tx.mottle(Image.new("RGB", (950, 450), tx.RED), 0.04, seed=3)
    draw = tx.pen(left)
    draw.rectangle([0, 240, 950, 450], fill=tx.MUSTARD)
    for x in range(-60, 950, 60):
        draw.polygon([(x, 300), (x + 30, 300), (x + 60, 240), (x + 30, 240)], fill=tx.NAVY)
    draw.rounded_rectangle([40, 40, 400, 220], radius=12, fill=tx.STEEL, outline=tx.SLATE, width=6)
    for x, y, r in [(100, 95, 38), (200, 95, 38), (300, 95, 38), (90, 180, 24), (160, 180, 24), (350, 170, 34)]:
        tx.dot(draw, x, y, r, tx.DARK)
        tx.dot(draw, x, y, 0.8 * r, tx.WHITE)
        draw.line([(x, y), (x + 0.5 * r, y - 0.5 * r)], fill=tx.RED, width=6)
    tx.text(left, "FIRE", 690, 130, 150, tx.WHITE, tx.MAROON)
    draw.pieslice([455, 330, 755, 630], 180, 360, fill=tx.DARK)

    rear = Image.new("RGB", (600, 450), tx.MUSTARD)
    draw = tx.pen(rear)
    for y in range(-300, 800, 140):
        for x, side in ((0, 1), (600, -1)):
            draw.polygon([(x, y), (x + side * 300, y - 260), (x + side * 300, y - 190), (x, y + 70)], fill=tx.RED)
    draw.rounded_rectangle([190, 90, 410, 420], radius=14, fill=tx.MAROON, outline=tx.DARK, width=8)
    draw.rectangle([220, 120, 380, 230], fill=tx.GLASS)
    for x in (60, 540):
        for y, colour in ((250, tx.RED), (320, tx.ORANGE), (390, tx.WHITE)):
            tx.dot(draw, x, y, 34, tx.DARK)
            tx.dot(draw, x, y, 26, colour)

    deck = tx.painted(tx.SLATE, strength=0.15)
    body = box(1.92, 0.78, 1.2, 0.05).move(-0.54, 0.79).paint(tx.box_sheet(right, deck, left, rear, deck, deck))

    doors = []
    for seed, stripe in ((1, tx.WHITE), (2, tx.MUSTARD)):
        flank = tx.mottle(Image.new("RGB", (500, 550), tx.RED), 0.04, seed)
        draw = tx.pen(flank)
        draw.rectangle([0, 380, 500, 420] if stripe == tx.WHITE else [0, 290, 500, 550], fill=stripe)
        draw.polygon([(60, 60), (270, 60), (270, 260), (60, 260)], fill=tx.DARK)
        draw.polygon([(70, 70), (260, 70), (260, 250), (70, 250)], fill=tx.GLASS)
        draw.polygon([(300, 60), (370, 60), (440, 260), (300, 260)], fill=tx.DARK)
        draw.polygon([(310, 70), (364, 70), (426, 250), (310, 250)], fill=tx.GLASS)
        draw.line([(110, 250), (190, 70)], fill=tx.shade(tx.GLASS, 1.3), width=26)
        for x in (285, 40, 470):
            draw.line([(x, 40), (x, 520)], fill=tx.MAROON, width=5)
        draw.rounded_rectangle([230, 300, 275, 318], radius=6, fill=tx.STEEL)
        draw.pieslice([75, 395, 375, 695], 180, 360, fill=tx.DARK)
        doors.append(flank)
    outline = rounded([(0.45, 0.4), (1.5, 0.4), (1.5, 0.88), (1.28, 1.5), (0.45, 1.5)], 0.1)
    mirrored = doors[1].transpose(Image.Transpose.FLIP_LEFT_RIGHT)
    cab = extrude(outline, 1.16, 0.05).paint(tx.slab_sheet(doors[0], mirrored, tx.plain(tx.RED)))

    glass = Image.new("RGB", (256, 128), tx.GLASS)
    tx.pen(glass).polygon([(40, 128), (110, 0), (160, 0), (90, 128)], fill=tx.shade(tx.GLASS, 1.3))
    tx.pen(glass).line([(128, 0), (128, 128)], fill=tx.DARK, width=6)
    windscreen = box(0.04, 0.5, 1.0, 0.015).turn("z", 19.5).move(1.395, 1.19)
    grille = Image.new("RGB", (256, 128), tx.STEEL)
    for y in range(10, 128, 24):
        tx.pen(grille).rectangle([12, y, 244, y + 11], fill=tx.DARK)
    lamps = joined([cylinder(0.1, 0.08, 0.02).turn("z", 90).move(1.51, 0.66, z) for z in (-0.44, 0.44)])
    wheels = joined([wheel(0.3, 0.26).move(x, 0.3, z) for x in (-0.78, 0.92) for z in (-0.5, 0.5)])
    beacons = joined([ellipsoid(0.11, 0.11, 0.13, 24).move(1.02, 1.5, z) for z in (-0.34, 0.34)])
    light_bar = box(0.2, 0.06, 1.0, 0.02).move(1.02, 1.5)
    mirrors = joined([box(0.05, 0.22, 0.13, 0.02).move(1.42, 1.12, z) for z in (-0.72, 0.72)])
    stays = joined([rod((1.36, 1.2, 0.5 * s), (1.42, 1.2, 0.72 * s), 0.018) for s in (-1, 1)])

    low, high = np.array([-1.55, 1.28, 0.0]), np.array([0.98, 1.84, 0.0])
    rails = [rod(low, high, 0.035).move(z=z) for z in (0.12, 0.5)]
    steps = [low + (high - low) * t for t in np.linspace(0.04, 0.96, 12)]
    rungs = [cylinder(0.022, 0.38, segments=8).turn("x", 90).move(x, y, 0.31) for x, y, _ in steps]
    props = joined([cylinder(0.2, 0.2, 0.02).move(-1.0, 1.25, 0.31), box(0.1, 0.5, 0.46, 0.02).move(0.38, 1.42, 0.31)])
    reel = lathe([(0, -0.2), (0.3, -0.2), (0.3, -0.15), (0.1, -0.15), (0.1, 0.15), (0.3, 0.15), (0.3, 0.2), (0, 0.2)])
    hose = joined([torus(0.16, 0.055).move(y=y) for y in np.linspace(-0.1, 0.1, 3)])
    hose += joined([torus(0.22, 0.05).move(y=y) for y in np.linspace(-0.07, 0.07, 2)])
    cannon = rod((-0.05, 1.16, -0.3), (-0.05, 1.48, -0.3), 0.06) + rod((-0.2, 1.42, -0.3), (0.38, 1.66, -0.3), 0.05)
    return scene(
        [
            body,
            cab,
            windscreen.paint(tx.all_sides(glass)),
            box(0.06, 0.26, 0.66, 0.02).move(1.5, 0.66).paint(tx.all_sides(grille)),
            lamps.paint(tx.bands([(0.3, tx.STEEL), (0.6, tx.WHITE), (0.7, tx.STEEL), (1, tx.WHITE)])),
            box(0.14, 0.16, 1.24, 0.04).move(1.52, 0.44).paint(tx.plain(tx.WHITE)),
            box(2.9, 0.16, 1.0, 0.03).move(0, 0.38).paint(tx.plain(tx.DARK)),
            wheels.paint(tx.wheel_paint(tx.STEEL)),
            beacons.paint(tx.plain(tx.BLUE)),
            light_bar.paint(tx.plain(tx.WHITE)),
            mirrors.paint(tx.plain(tx.DARK)),
            stays.paint(tx.plain(tx.STEEL)),
            joined(rails + rungs).paint(tx.plain(tx.STEEL)),
            props.paint(tx.plain(tx.SLATE)),
            reel.turn("x", 90).move(-0.95, 1.46, -0.3).paint(tx.plain(tx.NAVY)),
            hose.turn("x", 90).move(-0.95, 1.46, -0.3).paint(tx.painted(tx.MUSTARD)),
            cannon.paint(tx.plain(tx.MAROON)),
        ]
    )
