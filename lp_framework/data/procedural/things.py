"""Other household objects: books, tools, toys, appliances, shoes, bags, and random combinations of shapes."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from PIL import Image

from lp_framework.data.procedural.labels import brand, letter, panel
from lp_framework.data.procedural.paint import pen, plain, wheel_paint
from lp_framework.data.procedural.shapes import Parts, body, box_sheet, dented, four, handle, lump, pair
from lp_framework.data.procedural.solids import (
    Shape,
    arc,
    box,
    curve,
    cylinder,
    ellipsoid,
    extrude,
    joined,
    lathe,
    loft,
    rod,
    torus,
    tube,
    wheel,
)
from lp_framework.data.procedural.textures import chance, colour, ground, ink, material, pick


def book(random: Generator) -> Parts:
    """A book or folder, lying or upright: printed or plain covers, a spine, and pages."""
    wide, thick, w = *random.uniform((0.6, 0.08), (0.85, 0.35)), 0.025
    b, pages = brand(random), Image.new("RGB", (64, 64), colour(random, "white"))
    for k in range(0, 64, 4):
        pen(pages).line([(k, 0), (k, 64)], fill=(205, 200, 188))
    blank = plain(b.base)
    front, back = (panel(random, b, role, wide, 1) if chance(random, 0.75) else blank for role in ("front", "back"))
    edge = panel(random, b, "spine", thick, 1)
    cover = box(wide, 1, w, 0.008, 1)
    ridge, block = box(0.06, 1, thick, 0.025, 2).move(-wide / 2), box(wide - 0.14, 0.9, thick - 2 * w, 0.005, 1)
    parts = [(cover.move(z=(thick - w) / 2), box_sheet([front] + [blank] * 5)), (block, box_sheet([pages] * 6)),
             (cover.move(z=(w - thick) / 2), box_sheet([blank, blank, back, blank, blank, blank])),
             (ridge, box_sheet([blank, blank, blank, edge, blank, blank]))]  # fmt: skip
    return [(shape.turn("x", -90), paint) for shape, paint in parts] if chance(random, 0.5) else parts


def tool(random: Generator) -> Parts:
    """A hammer, screwdriver, spanner or brush, lying down."""
    long, kind = random.uniform(0.5, 0.8), int(random.integers(4))
    steel, paint = material(random, "grey", "black", "brown"), material(random, "vivid", "brown", "black", grained=0.3)
    grip = body([(0.09, 0.07, 0), (0.13, 0.1, 0.1), (0.1, 0.08, 0.6 * long), (0.07, 0.06, long)], 2.4, 24, 3)
    if kind == 0:  # a hammer
        claw = extrude([(0, -0.05), (0, 0.06), (-0.2, 0.02), (-0.28, -0.08), (-0.16, -0.04)], 0.1, 0.01).move(-0.06)
        head = box(0.26, 0.12, 0.12, 0.02).move(0.06) + cylinder(0.075, 0.06, 0.01, 20).turn("z", 90).move(0.22) + claw
    elif kind == 1:  # a screwdriver
        tip = body([(0.05, 0.05, 0), (0.1, 0.015, 0.1), (0.08, 0.01, 0.16)], count=16).move(y=0.7 * long)
        head, grip = rod((0, 0, 0), (0, 0.7 * long, 0), 0.025) + tip, grip.scale(1.2, 1, 1.4)
    elif kind == 2:  # a spanner
        jaws = np.concatenate([arc((0, 0), 0.15, -50, 230, 15), arc((0, 0.03), 0.075, 220, -40, 9)])
        head = extrude(jaws, 0.07, 0.006).move(0, 0.1) + torus(0.09, 0.035, 24).turn("x", 90).move(0, -long - 0.08)
        paint = steel
    else:  # a brush
        bristles = box(0.22, random.uniform(0.15, 0.3), 0.08, 0.01, 1).move(0, 0.15).turn("x", random.uniform(4, 12))
        head, grip = bristles, grip + box(0.24, 0.1, 0.1, 0.02).move(y=long) + torus(0.03, 0.012, 16).turn("x", 90)
    return [(grip.turn("x", 90), paint), (head.move(y=long).turn("x", 90), steel)]


def plush(random: Generator) -> Parts:
    """A soft toy animal, sitting or on four legs: a head with muzzle, ears, eyes, limbs, sometimes a collar or tail."""
    fur, skin = material(random, "brown", "vivid", "white", "grey", "pale", "black"), material(random)
    four_legs, fat, big, ear, droop = chance(random, 0.4), *random.uniform((0.24, 0.22, 0.12, 5), (0.36, 0.32, 0.3, 50))
    if four_legs:
        trunk, y, z = lump(random, 0.8 * fat, 0.75 * fat, 0.45).move(0, 0.42), 0.42 + random.uniform(0.15, 0.35), 0.5
        limbs = four(lump(random, 0.09, 0.22, 0.09).move(0.45 * fat, 0.2, 0.24))
    else:
        trunk, y, z = lump(random, fat, 0.38, 0.9 * fat).move(0, 0.38), 0.75 + 0.5 * big, 0.04
        limbs = pair(lump(random, 0.1, 0.1, 0.24).turn("y", random.uniform(5, 30)).move(0.7 * fat, 0.1, 0.28))
        arm = lump(random, 0.08, 0.22, 0.08)
        limbs += arm.turn("z", random.uniform(20, 80)).move(fat + 0.08, 0.5, 0.06)
        limbs += arm.turn("z", random.uniform(-80, -20)).move(-fat - 0.08, 0.5, 0.06)
    ears = pair(ellipsoid(0.09, ear, 0.04, 20).turn("z", -droop).move(0.6 * big, y + 0.7 * big + 0.6 * ear, z))
    muzzle = ellipsoid(0.5 * big, 0.4 * big, random.uniform(0.3, 0.7) * big, 20).move(0, y - 0.25 * big, z + 0.75 * big)
    eyes = pair(ellipsoid(0.035, 0.045, 0.03, 14).move(0.35 * big, y + 0.2 * big, z + 0.86 * big))
    nose = ellipsoid(0.05, 0.035, 0.03, 14).move(0, y - 0.12 * big, z + 1.2 * big)
    head = lump(random, big, 0.9 * big, 0.9 * big, 0.03).move(0, y, z)
    parts = [(trunk + limbs + head, fur), (ears + muzzle, skin), (eyes + nose, plain((22, 18, 20)))]
    if chance(random, 0.35):
        parts.append((torus(0.6 * big, 0.05, 24).move(0, y - 0.85 * big, z - 0.1 * big), material(random, "vivid")))
    if chance(random, 0.5):
        tail = lump(random, 0.07, 0.07, random.uniform(0.08, 0.3)).move(0, 0.3, -0.45 if four_legs else -fat - 0.05)
        parts.append((tail, fur))
    return parts


def vehicle(random: Generator) -> Parts:
    """A toy car, lorry, bus or engine that drives towards +X."""
    long, wide, high = random.uniform((0.9, 0.38, 0.16), (1.2, 0.5, 0.3))
    tall, at, radius = random.uniform((0.16, -0.25, 0.09), (0.4, 0.3, 0.15))
    b = brand(random)
    flank, panes = Image.new("RGB", (256, 96), b.base), Image.new("RGB", (96, 96), pick(random, (b.base, b.second)))
    letter(flank, b.name, (50, 20, 206, 76), b.second, b.font)
    pen(panes).rectangle([12, 20, 84, 62], fill=(60, 84, 104))
    base, roof = plain(b.base), plain(b.second)
    chassis = box(long, high, wide, 0.05).move(y=0.12 + high / 2)
    cabin = box(random.uniform(0.35, 0.6) * long, tall, 0.9 * wide, 0.05).move(at * long, 0.12 + high + 0.45 * tall)
    wheels = joined([wheel(radius, 0.09).move(x * long, radius, s * wide / 2) for x in (-0.32, 0.32) for s in (-1, 1)])
    lamps = joined([ellipsoid(0.03, 0.04, 0.04, 14).move(long / 2, 0.15 + 0.5 * high, s * 0.3 * wide) for s in (-1, 1)])
    load = pick(random, (box(0.4 * long, 0.25, 0.8 * wide, 0.03), cylinder(0.14, 0.4 * long, 0.02, 24).turn("z", 90),
                         cylinder(0.05, 0.25, 0.01, 16)))  # fmt: skip
    parts = [(chassis, box_sheet([flank, base, flank, base, base, base])), (cabin, box_sheet([panes] * 4 + [roof] * 2)),
             (wheels, wheel_paint(colour(random))), (lamps, plain((250, 236, 170)))]  # fmt: skip
    if chance(random, 0.6):
        parts.append((load.move(-0.3 * long if at > 0 else 0.33 * long, 0.25 + high), material(random)))
    return parts


def appliance(random: Generator) -> Parts:
    """A radio, oven, speaker, clock or telephone: a case with dials on its front, knobs, a handle, an aerial."""
    x, y, z = random.uniform((0.5, 0.35, 0.2), (1, 0.8, 0.5))
    base, count = colour(random), int(random.integers(1, 5))
    accent, dial = ink(random, base), Image.new("RGB", (256, 256), base)
    draw = pen(dial)
    for left, top, wide, high in random.uniform((10, 10, 50, 40), (150, 150, 95, 95), (int(random.integers(1, 4)), 4)):
        area, kind = (left, top, left + wide, top + high), int(random.integers(3))
        if kind == 0:  # a face with a hand
            draw.ellipse(area, fill=accent, outline=ink(random, accent), width=5)
            draw.line([left + wide / 2, top + high / 2, left + 0.8 * wide, top + 0.3 * high], ink(random, accent), 4)
        elif kind == 1:  # digits
            draw.rectangle(area, fill=(40, 60, 70), outline=accent, width=4)
            time = f"{random.integers(24)}:{random.integers(10, 60)}"
            letter(dial, time, area, (150, 250, 190), "DejaVuSansMono-Bold")
        else:  # a grille
            for line in np.arange(top, top + high, 9):
                draw.line([left, line, left + wide, line], fill=accent, width=4)
    letter(dial, brand(random).name, (80, 222, 176, 246), accent, "DejaVuSans-Bold")
    case = box(x, y, z, random.uniform(0.02, 0.4 * min(x, y, z)))
    knob = cylinder(0.045, 0.08, 0.01, 20).turn("x", 90).move(0, -0.32 * y, z / 2 + 0.03)
    knobs = joined([knob.move(x * (0.8 * (k + 0.5) / count - 0.4)) for k in range(count)])
    parts = [(case, box_sheet([dial] + [plain(base)] * 5)), (knobs, material(random, "grey", "black", "vivid"))]
    if chance(random, 0.4):
        grip = handle(0, -0.3 * x, 0.3 * x, 0.2, 0.025).turn("z", 90).move(y=y / 2 - 0.02)
        parts.append((grip, material(random, "grey", "black")))
    if chance(random, 0.3):
        parts.append((rod((0.4 * x, y / 2, -0.3 * z), (0.55 * x, y, -0.3 * z), 0.012), plain((160, 165, 170))))
    return parts


def shoe(random: Generator) -> Parts:
    """A shoe or boot with laces."""
    half = curve([(0, -0.5), (0.17, -0.42), (0.15, -0.1), (0.2, 0.25), (0.12, 0.47), (0, 0.5)], 20)
    outline = np.concatenate([half, half[-2:0:-1] * (-0.85, 1)])
    top = random.uniform(0.36, 0.7)
    rows = [(0.03, 0.47, 0.95), (0.12, 0.44, 0.95), (0.2, 0.25, 0.86), (0.25, 0.08, 0.76), (top, -0.05, 0.76)]
    x, z = outline.T
    rings = [np.stack([wide * x, 0 * x + y, z * (toe + 0.48) + (toe - 0.48) / 2], axis=1) for y, toe, wide in rows]
    laces = joined([rod((-0.08, 0.25, 0.22 - 0.06 * k), (0.08, 0.25, 0.2 - 0.06 * k), 0.014, 8) for k in range(4)])
    sole = extrude(outline, 0.09, 0.015).turn("x", 90)
    return [(sole, material(random, "white", "black", "brown")), (loft(np.stack(rings)), material(random)),
            (laces, plain(colour(random, "white", "vivid", "black")))]  # fmt: skip


def bag(random: Generator) -> Parts:
    """A handbag, shopping bag or case: a printed body, two handles, a pocket on one side."""
    x, y, z, grip = random.uniform((0.6, 0.5, 0.18, 0.14), (0.95, 0.9, 0.4, 0.25))
    b = brand(random)
    cloth = ground(random, 128, 128, b.base, b.second, 0.6)
    front, back = (panel(random, b, "front", x, y) if chance(random, 0.4) else cloth for _ in range(2))
    side = plain(b.base)
    loop = tube(np.c_[arc((0, y / 2 - 0.02), grip, 0, 180, 15), np.full(15, 0.3 * z)], 0.02, 10)
    pocket = box(random.uniform(0.4, 0.8) * x, random.uniform(0.3, 0.6) * y, 0.12, 0.03).move(0, -0.15 * y, z / 2)
    return [(box(x, y, z, random.uniform(0.03, 0.45 * z)), box_sheet([front, side, back, side, side, side])),
            (loop + loop.scale(z=-1), material(random, "brown", "black", "vivid")),
            (pocket, pick(random, (material(random), plain(b.second))))]  # fmt: skip


def primitive(random: Generator) -> Shape:
    """A simple shape in any orientation: a block, drum, lump, ring, turned or tapering piece, bent pipe, or star."""
    a, b, c = random.uniform(0.15, 0.6, 3)
    kind, count = int(random.integers(8)), int(random.integers(3, 10))
    if kind == 0:
        shape = box(a, b, c, random.uniform(0.01, 0.07))
    elif kind == 1:
        shape = cylinder(0.6 * a, b, 0.02, 32)
    elif kind == 2:
        shape = lump(random, 0.6 * a, 0.6 * b, 0.6 * c, 0.1)
    elif kind == 3:
        shape = torus(random.uniform(0.15, 0.3), random.uniform(0.03, 0.1), 32)
    elif kind == 4:
        radii = random.uniform(0.04, 0.3, 5)
        shape = lathe(curve(np.stack([radii, np.linspace(-b, b, 5)], axis=1), 17).clip((0.02, -1), (1, 1)), 32)
    elif kind == 5:
        shape = body([(a, c, -b / 2), (*random.uniform(0, 0.8, 2) * (a, c), b / 2)], pick(random, (2, 8)), 32)
    elif kind == 6:
        shape = tube(curve(np.cumsum(0.25 * random.normal(size=(4, 3)), axis=0), 20), random.uniform(0.03, 0.09), 12)
    else:
        angle, reach = np.arange(count) * 2 * np.pi / count, random.uniform(0.15, 0.4, count)
        outline = np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=1)
        shape = extrude(outline, random.uniform(0.08, 0.4), 0.01)
    tilt, heading = pick(random, (0, 0, 90, random.uniform(0, 180))), random.uniform(0, 360)
    return shape.turn(pick(random, ("x", "z")), tilt).turn("y", heading)


def composition(random: Generator) -> Parts:
    """Intersecting simple shapes in a few paints and patterns; half of the compositions are bent."""
    patterned = [ground(random, 128, 128, colour(random), colour(random), 1.0) for _ in range(2)]
    paints = (*patterned, material(random), material(random), material(random))
    places = random.uniform(-0.25, 0.25, (int(random.integers(2, 7)), 3))
    bend, seed = random.uniform(0, 0.12) * chance(random, 0.5), int(random.integers(2**31))
    shapes = [dented(primitive(random).move(*place), np.random.default_rng(seed), bend, 0.7) for place in places]
    return [(shape, pick(random, paints)) for shape in shapes]
