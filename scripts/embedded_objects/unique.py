"""The embedded objects without symmetry."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image

from embedded_objects import textures as tx
from lp_framework.data.procedural.solids import (
    Array,
    Shape,
    arc,
    arc_length,
    box,
    curve,
    cylinder,
    ellipsoid,
    extrude,
    joined,
    lathe,
    loft,
    rod,
    rounded,
    scene,
    torus,
    tube,
    wheel,
)


def fire_engine() -> trimesh.Scene:
    """A fire engine heading for +X: ladder over its right flank, hose reel over its left."""
    right, draw = tx.canvas(950, 450, tx.RED, 0.04)
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

    left, draw = tx.canvas(950, 450, tx.RED, 0.04, seed=3)
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

    rear, draw = tx.canvas(600, 450, tx.MUSTARD)
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
        flank, draw = tx.canvas(500, 550, tx.RED, 0.04, seed)
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
    lamps = joined(cylinder(0.1, 0.08, 0.02).turn("z", 90).move(1.51, 0.66, z) for z in (-0.44, 0.44))
    wheels = joined(wheel(0.3, 0.26).move(x, 0.3, z) for x in (-0.78, 0.92) for z in (-0.5, 0.5))
    beacons = joined(ellipsoid(0.11, 0.11, 0.13, 24).move(1.02, 1.5, z) for z in (-0.34, 0.34))
    light_bar = box(0.2, 0.06, 1.0, 0.02).move(1.02, 1.5)
    mirrors = joined(box(0.05, 0.22, 0.13, 0.02).move(1.42, 1.12, z) for z in (-0.72, 0.72))
    stays = joined(rod((1.36, 1.2, 0.5 * s), (1.42, 1.2, 0.72 * s), 0.018) for s in (-1, 1))

    low, high = np.array([-1.55, 1.28, 0.0]), np.array([0.98, 1.84, 0.0])
    rails = [rod(low, high, 0.035).move(z=z) for z in (0.12, 0.5)]
    steps = [low + (high - low) * t for t in np.linspace(0.04, 0.96, 12)]
    rungs = [cylinder(0.022, 0.38, segments=8).turn("x", 90).move(x, y, 0.31) for x, y, _ in steps]
    props = joined([cylinder(0.2, 0.2, 0.02).move(-1.0, 1.25, 0.31), box(0.1, 0.5, 0.46, 0.02).move(0.38, 1.42, 0.31)])
    reel = lathe([(0, -0.2), (0.3, -0.2), (0.3, -0.15), (0.1, -0.15), (0.1, 0.15), (0.3, 0.15), (0.3, 0.2), (0, 0.2)])
    hose = joined(torus(0.16, 0.055).move(y=y) for y in np.linspace(-0.1, 0.1, 3))
    hose += joined(torus(0.22, 0.05).move(y=y) for y in np.linspace(-0.07, 0.07, 2))
    cannon = rod((-0.05, 1.16, -0.3), (-0.05, 1.48, -0.3), 0.06) + rod((-0.2, 1.42, -0.3), (0.38, 1.66, -0.3), 0.05)
    return scene(
        body,
        cab,
        windscreen.paint(tx.all_sides(glass)),
        box(0.06, 0.26, 0.66, 0.02).move(1.5, 0.66).paint(tx.all_sides(grille)),
        lamps.paint(tx.bands([(0.3, tx.STEEL), (0.6, tx.WHITE), (0.7, tx.STEEL), (1, tx.WHITE)])),
        box(0.14, 0.16, 1.24, 0.04).move(1.52, 0.44).paint(tx.WHITE),
        box(2.9, 0.16, 1.0, 0.03).move(0, 0.38).paint(tx.DARK),
        wheels.paint(tx.wheel_paint(tx.STEEL)),
        beacons.paint(tx.BLUE),
        light_bar.paint(tx.WHITE),
        mirrors.paint(tx.DARK),
        stays.paint(tx.STEEL),
        joined(rails + rungs).paint(tx.STEEL),
        props.paint(tx.SLATE),
        reel.turn("x", 90).move(-0.95, 1.46, -0.3).paint(tx.NAVY),
        hose.turn("x", 90).move(-0.95, 1.46, -0.3).paint(tx.painted(tx.MUSTARD)),
        cannon.paint(tx.MAROON),
    )


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
        lathe([(0, 0), (0.07, 0), (0.09, 0.2), (0.05, 0.2), (0.05, 0.1), (0, 0.1)], 20).move(-0.76, 1.84, z)
        for z in (0.02, 0.18)
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
    posts = joined(cylinder(0.035, 0.56, 0.0, 16).move(x, 0.4, 0.86) for x in (0.18, 0.58))
    porch = extrude([(-0.3, 0), (0.3, 0), (0, 0.24)], 0.42, 0.015).move(0.38, 0.68, 0.72)
    step = box(0.56, 0.08, 0.4, 0.02).move(0.38, 0.14, 0.74)
    boxes = joined(box(0.26, 0.07, 0.09, 0.015).move(x, 0.36, 0.59) for x in (-0.41, 0.01))
    blooms = [
        ellipsoid(0.045, 0.05, 0.045, 12).move(x + d, 0.42, 0.59) for x in (-0.41, 0.01) for d in (-0.09, 0, 0.09)
    ]

    lawn = tx.mottle(Image.new("RGB", (512, 512), tx.LEAF), 0.25, 9, 30)
    flagstone = cylinder(0.1, 0.03, 0.01, 20).scale(1.5, 1, 0.6).move(0.4, 0.12, 0.98)
    leaves = tx.mottle(Image.new("RGB", (256, 256), tx.FOREST), 0.35, 4, 14)
    crown = [(-0.72, 1.02, -0.86, 0.3), (-0.9, 0.78, -0.78, 0.24), (-0.52, 0.8, -0.9, 0.25), (-0.72, 1.28, -0.86, 0.2)]
    foliage = joined(ellipsoid(r, 0.9 * r, r, 24).move(x, y, z) for x, y, z, r in crown)
    bushes = joined(
        ellipsoid(r, r, r, 20).move(x, 0.12 + 0.6 * r, z)
        for x, z, r in [(0.95, 0.55, 0.2), (0.78, 0.68, 0.14), (-0.6, 0.7, 0.12)]
    )
    mailbox = box(0.12, 0.14, 0.2, 0.03).move(-0.86, 0.5, 0.84)
    stone = tx.painted(tx.STEEL, 3, 0.15)
    return scene(
        box(2.2, 0.12, 2.1, 0.05).move(0, 0.06).paint(tx.all_sides(lawn)),
        walls.paint(tx.box_sheet(front, right, back, left, plaster, plaster)),
        gable.paint(tx.slab_sheet(gable_right, gable_left, tx.plain(tx.CREAM))),
        slope.move(y=1.47).paint(tx.all_sides(tiles)),
        slope.turn("y", 180).move(y=1.47).paint(tx.all_sides(moss)),
        panels.paint(tx.all_sides(panel)),
        stack.paint(tx.all_sides(brick)),
        box(0.32, 0.07, 0.46, 0.015).move(-0.76, 1.81, 0.1).paint(tx.SLATE),
        pots.paint(tx.ORANGE),
        shed.paint(tx.box_sheet(boards, hatch, boards, boards, boards, boards)),
        shed_roof.paint(tx.all_sides(tx.shingles(tx.TEAL, 384, 384, 7, 8))),
        entrance.paint(tx.box_sheet(door, door, door, door, door, door)),
        posts.paint(tx.WHITE),
        porch.paint(tx.slab_sheet(tx.plain(tx.WHITE), tx.plain(tx.WHITE), tiles)),
        (step + flagstone).paint(stone),
        boxes.paint(tx.painted(tx.BROWN)),
        joined(blooms).paint(tx.PINK),
        rod((-0.72, 0.1, -0.84), (-0.72, 0.9, -0.86), 0.075).paint(tx.painted(tx.BROWN, 2, 0.3)),
        foliage.paint(leaves),
        bushes.paint(tx.mottle(Image.new("RGB", (256, 256), tx.LEAF), 0.35, 5, 14)),
        mailbox.paint(tx.BLUE),
        rod((-0.86, 0.1, 0.84), (-0.86, 0.46, 0.84), 0.03).paint(tx.BROWN),
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
        flank, draw = tx.canvas(400, 512, colour, 0.05, 2)
        draw.rectangle([0, 380, 400, 430], fill=tx.CREAM)
        tx.star(draw, 200, 240, 90, tx.CREAM)
        ribs.append(flank)
    for picture in (chest, spine, *ribs):
        tx.rivets(picture, 22, 70, 8, tx.STEEL)
    torso = box(0.86, 0.86, 0.62, 0.08).move(y=1.05).paint(tx.box_sheet(chest, ribs[1], spine, ribs[0], tin, tin))

    face, draw = tx.canvas(512, 400, tx.CREAM, 0.04, 4)
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
    pupils = joined(ellipsoid(0.045, 0.045, 0.03, 20).move(x + 0.015, 1.88, 0.325) for x in (-0.13, 0.13))
    dish = lathe([(0, 0), (0.08, 0.01), (0.16, 0.05), (0.21, 0.11), (0.18, 0.11), (0.07, 0.04), (0, 0.03)], 36)
    dish = dish.turn("z", 90).move(-0.42, 1.86) + rod((-0.3, 1.86, 0), (-0.52, 1.86, 0), 0.035)
    ear = cylinder(0.12, 0.12, 0.03, 32).turn("z", 90).move(0.36, 1.84)
    aerial = tube(curve([(0.18, 2.05, 0), (0.2, 2.2, 0), (0.28, 2.32, 0)], 10), 0.02)
    neck = joined(torus(0.14, 0.045).move(y=y) for y in (1.5, 1.55))

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
    legs = joined(hose([(x, 0.66, 0), (x, 0.5, 0), (x, 0.36, 0), (x, 0.2, 0)]) for x in (-0.22, 0.22))
    boots = [box(0.34, 0.24, 0.56, 0.09).move(x, 0.13, 0.08) for x in (-0.23, 0.23)]
    bow = [torus(0.1, 0.035).turn("x", 90).scale(1.15, 0.9, 1).move(x, 1.15, -0.56) for x in (-0.13, 0.13)]
    key = joined([*bow, rod((0, 1.15, -0.28), (0, 1.15, -0.56), 0.04)])
    return scene(
        torso,
        head.paint(tx.box_sheet(face, cheeks[1], nape, cheeks[0], tin, tin)),
        joined(eyes).paint(tx.MUSTARD),
        pupils.paint(tx.DARK),
        dish.paint(tx.STEEL),
        ear.paint(tx.RED),
        aerial.paint(tx.STEEL),
        ellipsoid(0.06, 0.06, 0.06, 20).move(0.29, 2.36).paint(tx.RED),
        neck.paint(tx.SLATE),
        joined([raised, hanging, legs]).paint(tx.STEEL),
        claw.paint(tx.ORANGE),
        fist.paint(tx.NAVY),
        handle.paint(tx.WOOD),
        mallet.paint(tx.bands([(0.32, tx.DARK), (0.68, tx.MAROON), (1, tx.DARK)])),
        shoulders[0].paint(tx.RED),
        shoulders[1].paint(tx.MUSTARD),
        boots[0].paint(tx.painted(tx.RED)),
        boots[1].paint(tx.painted(tx.MUSTARD)),
        key.paint(tx.MUSTARD),
    )


def sail(luff: Array, leech: Array, belly: float) -> Shape:
    """A billowing sail between two edges `[M, 3]`; texture: +Z face left, -Z face right."""
    across = np.linspace(0, 1, 17)[None, :, None]
    cloth = leech[:, None] + (luff - leech)[:, None] * across
    width = np.linalg.norm(luff - leech, axis=1)[:, None]
    cloth[..., 2] += belly * width * np.sin(np.pi * across[..., 0])
    thickness = np.array([0.0, 0.0, 0.012])
    return loft(np.concatenate([cloth + thickness, (cloth - thickness)[:, ::-1]], axis=1))


def sailboat() -> trimesh.Scene:
    """A sloop heading for +X, sails swung out: number and green stripe to starboard, star and red stripe to port."""
    t = np.linspace(0, 1, 25)[:, None]  # stern to bow
    beam = 0.5 * np.where(t < 0.45, 1 - 0.9 * (0.45 - t) ** 2, 1 - (abs(t - 0.45) / 0.552) ** 2.2)
    sheer = 0.34 + 0.3 * (t - 0.35) ** 2
    keel = -0.06 + 0.22 * (1 - np.minimum(t / 0.3, 1)) ** 2 + 0.3 * t**5
    phi = np.linspace(0, np.pi, 29)
    under_z, under_y = beam * np.cos(phi), sheer - (sheer - keel) * np.sin(phi) ** 0.7
    side = np.linspace(-1, 1, 14)[1:-1]
    deck_z, deck_y = beam * side, sheer + 0.03 * (1 - side**2) - 0.02
    z, y = np.concatenate([under_z, deck_z], axis=1), np.concatenate([under_y, deck_y], axis=1)
    x = np.broadcast_to(2.1 * t - 1.05, z.shape) + np.where(y > 0.2, 0.12 * t * (y - 0.2) / 0.2, 0)
    hull_picture, draw = tx.canvas(1024, 1024, tx.CREAM)
    gunwale = round(1024 * 28 / 41)  # the underbody ends here, the deck begins
    draw.rectangle([0, 0, 1024, 12], fill=tx.WOOD)
    draw.rectangle([0, 22, 1024, 40], fill=tx.FOREST)
    draw.rectangle([0, 150, 1024, gunwale - 150], fill=tx.MAROON)
    draw.rectangle([0, 142, 1024, 152], fill=tx.WHITE)
    draw.rectangle([0, gunwale - 142, 1024, gunwale], fill=tx.NAVY)
    draw.rectangle([0, gunwale - 152, 1024, gunwale - 142], fill=tx.WHITE)
    draw.rectangle([0, gunwale - 60, 1024, gunwale - 30], fill=tx.RED)
    draw.rectangle([0, gunwale - 12, 1024, gunwale], fill=tx.WOOD)
    tx.text(hull_picture, "MARIE", 640, 88, 74, tx.NAVY)
    deck = tx.planks(tx.WOOD, 1024, 1024 - gunwale, 12, 1)
    hull_picture.paste(deck, (0, gunwale))
    hull = loft(np.stack([x, y, z], axis=-1)).paint(hull_picture.rotate(90))

    f = np.linspace(0, 0.985, 25)[:, None]
    luff = np.concatenate([0 * f, 0.62 + 1.48 * f, 0 * f], axis=1)
    leech = np.concatenate([-1.0 * (1 - f) ** 0.8, 0.6 + 1.48 * f, 0 * f], axis=1)
    cloth, draw = tx.canvas(1024, 1024, tx.CREAM)
    for top in range(0, 1024, 256):
        draw.rectangle([512, top, 1024, top + 128], fill=tx.RED)
    tx.star(draw, 768, 730, 150, tx.NAVY)
    tx.star(draw, 768, 730, 105, tx.MUSTARD)
    for top in range(90, 1024, 150):
        draw.line([(0, top), (511, top)], fill=tx.shade(tx.CREAM, 0.85), width=5)
    draw.rectangle([0, 900, 511, 1024], fill=tx.TEAL)
    tx.text(cloth, "42", 235, 690, 300, tx.TEAL)
    main = (sail(luff, leech, 0.13) + rod((0, 0.58, 0), (-1.06, 0.58, 0), 0.028)).turn("y", 28).move(x=0.1)

    stay = np.concatenate([1.1 - 0.94 * f, 0.5 + 1.5 * f, 0 * f], axis=1)
    clew = np.concatenate([0.22 + 0 * f, 0.62 + 1.38 * f, 0.42 * (1 - f)], axis=1)
    jib_cloth, draw = tx.canvas(512, 512, tx.MUSTARD)
    draw.rectangle([256, 0, 512, 512], fill=tx.NAVY)
    for top in range(0, 512, 64):
        draw.rectangle([0, top, 255, top + 26], fill=tx.ORANGE)
        draw.rectangle([256, top, 512, top + 14], fill=tx.SKY)

    cabin_front = tx.painted(tx.WHITE, 1, 0.03)
    ports = Image.new("RGB", (512, 256), tx.WHITE)
    for px in (110, 256, 402):
        tx.dot(tx.pen(ports), px, 128, 58, tx.MUSTARD)
        tx.dot(tx.pen(ports), px, 128, 42, tx.GLASS)
    cabin = box(0.62, 0.2, 0.5, 0.06).move(0.3, 0.43)
    roof = box(0.68, 0.05, 0.56, 0.02).move(0.3, 0.54)
    buoy = torus(0.11, 0.038).turn("x", 90).move(-0.32, 0.34, 0.5)
    buoy_paint = Image.new("RGB", (512, 64), tx.WHITE)
    for k in range(4):
        tx.pen(buoy_paint).rectangle([k * 128, 0, k * 128 + 63, 64], fill=tx.RED)
    fenders = joined(ellipsoid(0.05, 0.12, 0.05, 16).move(px, 0.24, -0.49) for px in (-0.55, -0.2, 0.2))
    tiller = tube(curve([(-1.12, 0.5, 0), (-0.9, 0.52, 0.03), (-0.62, 0.5, 0.1)], 10), 0.022)
    rudder = extrude([(-1.22, -0.12), (-1.0, -0.12), (-1.02, 0.5), (-1.16, 0.5)], 0.05, 0.015)
    pennant = extrude([(0, 0), (0, 0.16), (-0.36, 0.1)], 0.02, 0.004).turn("y", 25).move(0.1, 2.14)
    fin = extrude([(-0.3, -0.34), (0.2, -0.34), (0.34, 0.04), (-0.36, 0.04)], 0.09, 0.03)
    return scene(
        hull,
        main.paint(cloth),
        sail(stay, clew, 0.1).paint(jib_cloth),
        rod((0.1, 0.3, 0), (0.1, 2.32, 0), 0.032).paint(tx.BROWN),
        rod((1.12, 0.5, 0), (0.1, 2.1, 0), 0.008, 8).paint(tx.SLATE),
        rod((-1.04, 0.46, 0), (0.1, 2.28, 0), 0.008, 8).paint(tx.SLATE),
        cabin.paint(tx.box_sheet(ports, cabin_front, ports, cabin_front, cabin_front, cabin_front)),
        roof.paint(tx.TEAL),
        buoy.paint(buoy_paint),
        fenders.paint(tx.SKY),
        tiller.paint(tx.BROWN),
        rudder.paint(tx.painted(tx.WOOD)),
        pennant.paint(tx.RED),
        fin.paint(tx.SLATE),
    )


def duck() -> trimesh.Scene:
    """A pull-along duck heading for +X, cap askew, its left wing lifted; red wheels on the right, blue on the left."""
    along = [-0.86, -0.74, -0.52, -0.15, 0.22, 0.5, 0.62, 0.65]
    heights = [1.02, 0.93, 0.78, 0.68, 0.68, 0.76, 0.82, 0.84]
    half_heights = [0.015, 0.1, 0.24, 0.36, 0.38, 0.3, 0.16, 0.01]
    half_widths = [0.03, 0.14, 0.32, 0.44, 0.44, 0.33, 0.18, 0.01]
    stations = curve(np.transpose([along, heights, half_heights, half_widths]), 41)
    angle = np.linspace(0, 2 * np.pi, 41)[:-1]
    x, centre, high, wide = (column[:, None] for column in stations.T)
    rings = np.stack(
        [x + 0 * angle, centre - high * np.cos(angle), wide * np.sin(angle)], axis=-1
    )  # keel, +Z, back, -Z
    feathers, draw = tx.canvas(1024, 1024, tx.MUSTARD)
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
    whites = joined(ellipsoid(0.085, 0.1, 0.06, 24).turn("y", -40 * s).move(0.64, 1.4, 0.235 * s) for s in (-1, 1))
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
    ribbon = joined(ellipsoid(0.13, 0.025, 0.05, 20).turn("z", 25 * s).move(0.2, 1.5, 0.32) for s in (-1, 1))
    knot = ellipsoid(0.09, 0.09, 0.09, 20).move(0.62, 0.98)
    tie = [ellipsoid(0.06, 0.1, 0.15, 24).turn("x", 15 * s).move(0.6, 0.98, 0.15 * s) for s in (-1, 1)]
    scarf = torus(0.25, 0.065).turn("z", -14).move(0.4, 1.03)

    board = tx.planks(tx.WOOD, 768, 384, 3, 4)
    base = box(1.5, 0.12, 0.7, 0.05).move(0, 0.26)
    wheels = [joined(wheel(0.2, 0.12).move(x, 0.2, z) for x in (-0.5, 0.5)) for z in (0.42, -0.42)]
    axles = joined(rod((x, 0.2, -0.46), (x, 0.2, 0.46), 0.03) for x in (-0.5, 0.5))
    string = tube(curve([(0.74, 0.26, 0), (0.86, 0.2, 0.02), (0.98, 0.22, 0.06), (1.08, 0.34, 0.1)], 24), 0.014, 8)
    return scene(
        body,
        head.paint(head_paint),
        joined([bill, jaw]).paint(tx.painted(tx.ORANGE)),
        whites.paint(tx.WHITE),
        pupils.paint(tx.DARK),
        folded.paint(scallops[0]),
        lifted.paint(scallops[1]),
        brim.turn("x", 14).move(**cap).paint(tx.NAVY),
        crown.turn("x", 14).move(**cap).paint(tx.WHITE),
        ellipsoid(0.06, 0.06, 0.06, 16).move(0.4, 1.84, 0.12).paint(tx.RED),
        ribbon.paint(tx.NAVY),
        joined([knot, *tie]).paint(tx.TEAL),
        scarf.paint(tx.TEAL),
        base.paint(tx.all_sides(board)),
        wheels[0].paint(tx.wheel_paint(tx.CREAM, tx.RED)),
        wheels[1].paint(tx.wheel_paint(tx.CREAM, tx.BLUE)),
        axles.paint(tx.SLATE),
        string.paint(tx.CREAM),
        ellipsoid(0.08, 0.08, 0.08, 20).move(1.1, 0.38, 0.11).paint(tx.RED),
    )


def watering_can() -> trimesh.Scene:
    """A watering can, spout to +X: sunflowers on its right, a ladybird on its left, where a trowel hangs."""
    picture, draw = tx.canvas(1024, 512, tx.TEAL)
    draw.rectangle([0, 400, 1024, 512], fill=tx.FOREST)
    for x in range(0, 1024, 16):
        draw.polygon([(x, 405), (x + 8, 370 + 20 * (x // 16 % 2)), (x + 16, 405)], fill=tx.FOREST)
    for x, y, r in [(400, 210, 66), (520, 150, 84), (640, 230, 62)]:
        draw.line([(x, y), (x, 410)], fill=tx.LEAF, width=12)
        draw.ellipse([x, 330, x + 60, 356], fill=tx.LEAF)
        tx.flower(draw, x, y, r, tx.MUSTARD, tx.BROWN)
    for x in (0, 1024):  # the ladybird sits on the seam
        tx.dot(draw, x, 215, 112, tx.CREAM)
        draw.ellipse([x - 80, 150, x + 80, 290], fill=tx.RED)
        draw.pieslice([x - 80, 150, x + 80, 290], 150, 210, fill=tx.DARK)
        draw.line([(x - 80, 220), (x + 80, 220)], fill=tx.DARK, width=6)
        for dx, dy in [(-20, -35), (-20, 35), (30, -30), (30, 30), (5, -55), (5, 55)]:
            tx.dot(draw, x + dx, 220 + dy, 12, tx.DARK)
    for x in (720, 790, 850):
        tx.flower(draw, x, 320 - (x % 100), 34, tx.PINK, tx.WHITE)
    picture = tx.mottle(picture, 0.04, 2)
    outside = [(0, 0), (0.5, 0), (0.54, 0.03), (0.53, 0.1), (0.45, 0.86), (0.47, 0.9)]
    inside = [(0.44, 0.9), (0.44, 0.74), (0, 0.74)]
    profile = np.array(outside + inside)
    share = arc_length(profile)
    body = lathe(profile, 72).paint(tx.band(picture, share[2], share[5], tx.shade(tx.TEAL, 0.6)))

    rims = joined([torus(0.53, 0.035, 72).move(y=0.05), torus(0.465, 0.03, 72).move(y=0.9)])
    path = curve([(0.36, 0.16, 0), (0.66, 0.3, 0), (0.88, 0.66, 0), (1.12, 1.0, 0)], 25)
    spout = tube(path, np.linspace(0.13, 0.06, 25), 24)
    brace = rod((0.42, 0.82, 0), (0.9, 0.7, 0), 0.022)
    rose = lathe([(0, -0.02), (0.06, 0), (0.17, 0.2), (0.17, 0.23), (0.13, 0.26), (0, 0.28)], 36)
    holes = ((0.42, tx.ORANGE), (0.7, tx.BROWN), (0.76, tx.ORANGE), (0.82, tx.BROWN), (0.88, tx.ORANGE))
    sieve = tx.bands([*holes, (0.94, tx.BROWN), (1, tx.ORANGE)])
    grip = tube(curve([(-0.44, 0.78, 0), (-0.72, 0.86, 0), (-0.9, 0.6, 0), (-0.8, 0.3, 0), (-0.5, 0.16, 0)], 33), 0.05)
    arch = tube(curve([(-0.4, 0.88, 0), (-0.3, 1.2, 0), (0, 1.32, 0), (0.28, 1.2, 0), (0.4, 0.88, 0)], 33), 0.045)
    wrap = tube(curve([(-0.17, 1.275, 0), (0, 1.32, 0), (0.16, 1.28, 0)], 13), 0.065)
    cover = extrude(np.concatenate([arc((0, 0), 0.46, -90, 90, 25)]), 0.05, 0.01).turn("x", -90).move(0.01, 0.88)
    blade = curve([(0, 0), (0.11, 0.08), (0.12, 0.3), (0, 0.5)], 12)
    outline = np.concatenate([blade, blade[-2:0:-1] * (-1, 1)])
    trowel = extrude(outline, 0.04, 0.012).turn("z", 180).move(0, 0.68, -0.57).turn("y", 46)
    shaft = rod((0, 0.66, -0.57), (0, 0.82, -0.57), 0.022).turn("y", 46)
    knob = ellipsoid(0.05, 0.15, 0.05, 20).move(0, 0.93, -0.57).turn("y", 46)
    hook = torus(0.06, 0.015, 24).turn("z", 90).move(0, 0.84, -0.51).turn("y", 46)
    return scene(
        body,
        rims.paint(tx.MUSTARD),
        spout.paint(tx.bands([(0.55, tx.TEAL), (0.6, tx.MUSTARD), (1, tx.TEAL)])),
        brace.paint(tx.STEEL),
        rose.turn("z", -50).move(1.1, 0.97).paint(sieve),
        grip.paint(tx.RED),
        arch.paint(tx.MUSTARD),
        wrap.paint(tx.BROWN),
        cover.paint(tx.plain(tx.shade(tx.TEAL, 1.15))),
        trowel.paint(tx.STEEL),
        shaft.paint(tx.SLATE),
        knob.paint(tx.painted(tx.RED)),
        hook.paint(tx.DARK),
    )
