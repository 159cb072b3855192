"""Embedded objects whose shape is symmetric under a half turn but whose texture is not."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image

from embedded_objects import textures as tx
from lp_framework.data.procedural.solids import (
    both,
    box,
    curve,
    cylinder,
    ellipsoid,
    extrude,
    joined,
    loft,
    plan,
    rod,
    rounded,
    scene,
    tube,
)


def tram() -> trimesh.Scene:
    """A tram along X: red on one flank and teal on the other, a mustard head and a navy tail."""

    def flank(colour: tx.Colour, trim: tx.Colour) -> Image.Image:
        picture, draw = tx.canvas(840, 320, tx.CREAM, 0.03, 1)
        draw.rectangle([0, 170, 840, 320], fill=colour)
        draw.rectangle([0, 170, 840, 180], fill=trim)
        draw.rectangle([0, 296, 840, 304], fill=trim)
        for x in (20, 140, 360, 480, 700):
            draw.rounded_rectangle([x, 40, x + 104, 150], radius=14, fill=tx.DARK)
            draw.rounded_rectangle([x + 6, 46, x + 98, 144], radius=10, fill=tx.GLASS)
            draw.polygon([(x + 20, 144), (x + 56, 46), (x + 76, 46), (x + 40, 144)], fill=tx.shade(tx.GLASS, 1.25))
            draw.line([(x + 6, 72), (x + 98, 72)], fill=tx.DARK, width=4)
        for x in (252, 596):
            draw.rectangle([x, 34, x + 92, 308], fill=tx.DARK)
            for leaf in (x + 5, x + 49):
                draw.rectangle([leaf, 40, leaf + 38, 302], fill=tx.shade(colour, 0.75))
                draw.rounded_rectangle([leaf + 6, 50, leaf + 32, 220], radius=6, fill=tx.GLASS)
        return picture

    red, teal = flank(tx.RED, tx.MUSTARD), flank(tx.TEAL, tx.WHITE)
    tx.text(red, "CITY LINE", 470, 240, 46, tx.WHITE)
    tx.text(red, "5", 130, 240, 80, tx.MUSTARD)
    tx.pen(teal).rounded_rectangle([352, 196, 588, 286], radius=12, fill=tx.MUSTARD)
    tx.text(teal, "TEA  &  JAM", 470, 241, 34, tx.MAROON)
    for x in (40, 110, 180):
        tx.flower(tx.pen(teal), x, 240, 28, tx.PINK, tx.WHITE)
    ends = []
    for colour, trim, word in ((tx.MUSTARD, tx.RED, "5"), (tx.NAVY, tx.SKY, "DEPOT")):
        end, draw = tx.canvas(280, 320, colour, 0.03, 2)
        draw.polygon([(0, 170), (140, 260), (280, 170), (280, 205), (140, 295), (0, 205)], fill=trim)
        draw.rounded_rectangle([18, 52, 262, 156], radius=18, fill=tx.DARK)
        draw.rounded_rectangle([26, 60, 136, 148], radius=12, fill=tx.GLASS)
        draw.rounded_rectangle([144, 60, 254, 148], radius=12, fill=tx.GLASS)
        draw.rounded_rectangle([60, 6, 220, 44], radius=8, fill=tx.DARK)
        tx.text(end, word, 140, 25, 30, tx.MUSTARD)
        ends.append(end)
    livery = tx.wrapped(red, ends[0], teal, ends[1])

    length, width, radius = 2.8, 0.98, 0.34
    walls = loft(np.stack([plan(length, width, radius, y) for y in (0.26, 0.3, 0.9, 1.3)]))
    angles = np.radians(np.linspace(0, 78, 8))
    insets = [(0.3 * (1 - np.cos(a)), 1.3 + 0.16 * np.sin(a)) for a in angles]
    roof = loft(np.stack([plan(length - 2 * e, width - 2 * e, radius, y) for e, y in insets]))
    gutter = tube(plan(length + 0.02, width + 0.02, radius, 1.3), 0.025, 10, closed=True)
    skirt = loft(np.stack([plan(length - 0.2, width - 0.12, radius - 0.05, y) for y in (0.16, 0.3)]))
    wheels = joined(
        cylinder(0.17, 0.1, 0.02, 32).turn("x", 90).move(x, 0.17, z)
        for x in (-0.95, -0.5, 0.5, 0.95)
        for z in (-0.4, 0.4)
    )
    bogies = joined(box(0.7, 0.1, 0.9, 0.03).move(x, 0.19) for x in (-0.725, 0.725))
    bumper = box(0.12, 0.1, 0.6, 0.04).move(length / 2, 0.3)
    lamps = joined(ellipsoid(0.05, 0.07, 0.07, 20).move(length / 2 - 0.01, 0.44, z) for z in (-0.22, 0.22))
    vents = both(box(0.5, 0.12, 0.46, 0.04).move(0.86, 1.5)) + box(0.5, 0.06, 0.6, 0.02).move(0, 1.47)
    arms = joined(rod((0.24 * s, 1.5, z), (0.44 * s, 1.68, z), 0.02) for s in (-1, 1) for z in (-0.16, 0.16))
    arms += joined(rod((0.44 * s, 1.68, z), (0.06 * s, 1.9, z), 0.016) for s in (-1, 1) for z in (-0.16, 0.16))
    arms += joined(rod((0.44 * s, 1.68, -0.16), (0.44 * s, 1.68, 0.16), 0.016) for s in (-1, 1))
    across = np.linspace(-1, 1, 15)
    bow = np.stack([0 * across, 1.91 - 0.05 * across**4, 0.34 * across], axis=1)
    shoes = joined(tube(bow, 0.02, 10).move(x) for x in (-0.06, 0.06))
    return scene(
        walls.paint(livery),
        roof.paint(tx.STEEL),
        gutter.paint(tx.CREAM),
        skirt.paint(tx.DARK),
        wheels.paint(tx.bands([(0.08, tx.STEEL), (0.2, tx.SLATE), (0.8, tx.DARK), (0.92, tx.SLATE), (1, tx.STEEL)])),
        bogies.paint(tx.SLATE),
        both(bumper).paint(tx.SLATE),
        lamps.paint(tx.WHITE),
        lamps.turn("y", 180).paint(tx.RED),
        vents.paint(tx.SLATE),
        arms.paint(tx.MAROON),
        shoes.paint(tx.DARK),
    )


def juice_carton() -> trimesh.Scene:
    """A gable-top carton: an orange on its front, a glass on its back, small print and stripes on its flanks."""
    x, z, height = 0.86, 0.66, 0.92
    front, draw = tx.canvas(688, 736, tx.SKY)
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

    back, draw = tx.canvas(688, 736, tx.MUSTARD)
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

    left, draw = tx.canvas(528, 736, tx.CREAM)
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

    right, draw = tx.canvas(528, 736, tx.NAVY)
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
        body.paint(print_sheet),
        gable.paint(slopes),
        fin.paint(fin_print),
        base.paint(tx.NAVY),
    )


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
    straps = joined(belt.move(s * 0.4) for s in (-1, 1))
    caps = joined(
        box(0.17, 0.17, 0.15, 0.07).move(sx * (wide / 2 - 0.07), sy * (tall / 2 - 0.07), sz * (deep / 2 - 0.06))
        for sx in (-1, 1)
        for sy in (-1, 1)
        for sz in (-1, 1)
    )
    buckles = joined(box(0.17, 0.12, 0.03, 0.014).move(s * 0.4, 0.12, deep / 2 + 0.02) for s in (-1, 1))
    tongues = joined(box(0.03, 0.15, 0.04, 0.01).move(s * 0.4, 0.12, deep / 2 + 0.025) for s in (-1, 1))
    locks = joined(box(0.13, 0.05, 0.13, 0.015).move(s * 0.2, tall / 2 + 0.005) for s in (-1, 1))
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
        shell,
        seam,
        straps.paint(tx.slab_sheet(leather, leather, stitched)),
        caps.paint(tx.all_sides(leather)),
        both(buckles).paint(tx.STEEL),
        both(tongues).paint(tx.BROWN),
        locks.paint(tx.STEEL),
        grip.paint(leather),
        feet.paint(tx.DARK),
    )
