"""Furniture and containers, mostly made of boards: cabinets, tables, chairs, sofas, racks, boxes, lamps, taps."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from PIL import Image

from lp_framework.data.procedural.paint import plain
from lp_framework.data.procedural.shapes import Parts, board, four, pair
from lp_framework.data.procedural.solids import both, box, curve, cylinder, joined, lathe, rod, tube
from lp_framework.data.procedural.textures import chance, colour, material, pick


def timber(random: Generator) -> Image.Image:
    """Wood or paint."""
    return material(random, "brown", "white", "grey", "black", "pale", "deep", grained=0.5)


def cabinet(random: Generator) -> Parts:
    """A cabinet, bookcase or night stand: open in front, partly closed by drawers and doors."""
    x, y, z, w = random.uniform((0.4, 0.4, 0.3, 0.02), (1.1, 1.2, 0.7, 0.05))
    storeys = int(random.integers(1, 5))
    frame = pair(board(w, y, z).move((x - w) / 2)) + board(x, w, z).move(y=(w - y) / 2)
    for k in range(1, storeys + 1):
        frame += board(x, w, z).move(y=y * (k / storeys - 0.5) - w / 2)
    if chance(random, 0.4):
        frame += board(w, y - w, z - w).move(random.uniform(-0.2, 0.2) * x, z=-w / 2)
    if chance(random, 0.5):
        frame += board(x * 1.08, w, z * 1.1).move(y=y / 2)
    if chance(random, 0.5):
        frame += four(board(0.06, 0.12, 0.06).move(0.42 * x, -y / 2 - 0.06, 0.4 * z))
    paint, doors = timber(random), pick(random, (timber(random), timber(random)))
    parts = [(frame, paint)]
    side = pick(random, (0.0, 0.3)) * x
    closed = [k for k in range(storeys) if chance(random, 0.4)]
    if not closed or chance(random, 0.7):
        parts.append((board(x - w, y - w, w).move(z=(w - z) / 2), paint))
    for k in closed:
        middle = y * ((k + 0.5) / storeys - 0.5)
        parts.append((board(0.94 * x, 0.9 * y / storeys, w).move(0, middle, z / 2), doors))
        knob = cylinder(0.025, 0.06, 0.005, 16).turn("x", 90)
        parts.append((knob.move(side, middle, z / 2 + w), plain((60, 60, 62))))
    return parts


def table(random: Generator, alike: bool) -> Parts:
    """A table or bench; unless it looks `alike` after half a turn, a desk with drawers at one end."""
    x, y, z, w, leg = random.uniform((0.7, 0.35, 0.4, 0.03, 0.04), (1.2, 0.8, 0.7, 0.07, 0.1))
    legs = four(board(leg, y, leg).move((x - leg) / 2 - 0.02, -y / 2, (z - leg) / 2 - 0.02))
    if chance(random, 0.4):
        legs += both(board(x - leg, 0.05, 0.03).move(0, -0.7 * y, (z - leg) / 2 - 0.02))
    top, paint = (plain(colour(random)) if alike else timber(random) for _ in range(2))
    parts = [(board(x, w, z), top), (legs, paint)]
    if not alike:
        drawers, middle = int(random.integers(1, 4)), 0.28 * x * pick(random, (-1, 1))
        parts.append((board(0.35 * x, 0.25 * drawers * y, 0.9 * z).move(middle, -0.125 * drawers * y), paint))
        grips = [board(0.2 * x, 0.03, 0.05).move(middle, -(0.25 * k + 0.1) * y, 0.46 * z) for k in range(drawers)]
        parts.append((joined(grips), plain((70, 70, 74))))
    return parts


def chair(random: Generator) -> Parts:
    """A chair or an armchair."""
    x, z, seat, back, leg, thick = random.uniform((0.4, 0.4, 0.35, 0.35, 0.03, 0.03), (0.55, 0.5, 0.5, 0.6, 0.06, 0.1))
    paint, cloth, bars = timber(random), material(random), int(random.integers(1, 5))
    frame = four(board(leg, seat, leg).move((x - leg) / 2, seat / 2, (z - leg) / 2))
    rest = pair(board(0.04, back, 0.04).move((x - 0.04) / 2)) + board(x, 0.07, 0.03).move(y=back / 2)
    for k in range(bars):
        if chance(random, 0.5):
            rest += board(0.03, back, 0.03).move(((k + 1) / (bars + 1) - 0.5) * x)
        else:
            rest += board(x, 0.06, 0.03).move(y=((k + 1) / (bars + 1) - 0.5) * back)
    if chance(random, 0.4):
        rest = board(x, back, 0.04)
    rest = rest.move(y=back / 2).turn("x", random.uniform(-14, 0)).move(y=seat, z=0.02 - z / 2)
    if chance(random, 0.3):
        arm = board(0.04, 0.22, 0.04).move(x / 2, seat + 0.11, z / 2 - 0.03)
        frame += pair(arm + board(0.05, 0.04, z).move(x / 2, seat + 0.22))
    return [(frame, paint), (box(x, thick, z, 0.014, 2).move(y=seat), cloth), (rest, pick(random, (paint, cloth)))]


def sofa(random: Generator) -> Parts:
    """A sofa or an armchair, with cushions."""
    x, z, arm, back = random.uniform((0.6, 0.45, 0.08, 0.45), (1.2, 0.6, 0.16, 0.65))
    frame = box(x, 0.25, z, 0.05).move(y=0.125) + box(x, back, 0.15, 0.06).move(y=0.35, z=-z / 2)
    parts = [(frame + pair(box(arm, 0.42, z, 0.04).move(x / 2, 0.21)), material(random))]
    for k in range(int(random.integers(0, 4))):
        pillow = box(0.22, 0.22, 0.09, 0.044).turn("x", -20).move((k - 1) * 0.24 * x, 0.36, -0.3 * z)
        parts.append((pillow, material(random)))
    return parts


def rack(random: Generator) -> Parts:
    """Rods on a board, leaning trays on a post, or a rack of bent wire."""
    x, z, high = random.uniform((0.6, 0.3, 0.25), (1, 0.6, 0.5))
    kind, count, paint, other = random.random(), int(random.integers(3, 9)), timber(random), timber(random)
    base, places = board(x, random.uniform(0.04, 0.12), z), ((np.arange(count) + 0.5) / count - 0.5) * 0.9 * x
    if kind < 0.4:
        rows = (-0.15 * z, 0.35 * z)[: int(random.integers(1, 3))]
        tips = random.uniform((-0.04, 0.6 * high), (0.04, high), (count * len(rows), 2))
        feet = [(place, row) for row in rows for place in places]
        rods = [rod((u, 0, v), (u + lean, tall, v), 0.02, 10) for (u, v), (lean, tall) in zip(feet, tips, strict=True)]
        return [(base, paint), (joined(rods), pick(random, (paint, other)))]
    if kind < 0.7:
        tall, trays = random.uniform(0.7, 1.1), int(random.integers(2, 4))
        post = board(0.08, tall, 0.08).move(0, tall / 2, -0.2 * z)
        tray = board(x, 0.035, z).turn("x", random.uniform(8, 25)).move(z=0.1)
        stack = joined([tray.move(y=tall * (k + 1) / (trays + 0.5)) for k in range(trays)])
        return [(base.scale(x=0.8) + post, paint), (stack, other)]
    bends = np.array([(0, 0, -0.5), (0, 1, -0.5), (0, 1.05, 0.1), (0, 0.5, 0.3), (0, 0.3, 0.5)]) * (1, high, z)
    hoop, rail = tube(curve(bends, 16), 0.016, 8), rod((-x / 2, 0, 0), (x / 2, 0, 0), 0.018, 8)
    rails = rail.move(z=-z / 2) + rail.move(0, 0.3 * high, z / 2)
    return [(joined([rails, *(hoop.move(place) for place in places)]), material(random, "grey", "white", "black"))]


def container(random: Generator, alike: bool) -> Parts:
    """A box, tray or crate, open on top or at both ends; unless `alike` after half a turn, a caddy with a high end."""
    x, z, y, w = random.uniform((0.6, 0.4, 0.12, 0.02), (1, 0.7, 0.6, 0.04))
    paint, planks = plain(colour(random)) if alike else timber(random), pick(random, (1, 1, 2, 3))
    walls = board(x, w, z)
    for k in range(planks):
        high, middle = y / planks * (0.8 if planks > 1 else 1), (k + 0.5) * y / planks
        walls += both(board(x, high, w).move(0, middle, (z - w) / 2) + board(w, high, z - w).move((x - w) / 2, middle))
    if alike and chance(random, 0.3):  # a cube without ends
        walls = both(board(x, w, z).move(y=-z / 2) + board(w, z, z).move((x - w) / 2)) + board(x, w, z).move(y=z / 2)
    elif chance(random, 0.4):  # handles over the ends
        grip = board(w, 0.05, 0.5 * z).move((x - w) / 2, y + 0.1)
        walls += pair(grip) + four(board(w, 0.12, 0.04).move((x - w) / 2, y + 0.05, 0.22 * z))
    if not alike:
        tall, at, across = random.uniform((1.5, 0.1, -0.1), (2.2, 0.25, 0.1))
        walls += board(w, 0.9 * y, z - w).move(at * x, 0.5 * y) + board(w, tall * y, z).move((x - w) / 2, tall * y / 2)
        walls += board((0.5 + at) * x, 0.8 * y, w).move((at - 0.5) / 2 * x, 0.45 * y, across * z)
    return [(walls, paint)]


def lamp(random: Generator) -> Parts:
    """A desk lamp with a bent arm and its shade turned to one side."""
    foot, high, reach = random.uniform((0.16, 0.6, 0.25), (0.28, 0.9, 0.5))
    thick, wide, tilt = random.uniform((0.015, 0.13, 10), (0.03, 0.25, 60))
    path = curve([(0, 0, 0), (-0.1 * reach, 0.5 * high, 0), (0.2 * reach, high, 0), (reach, 0.97 * high, 0)], 20)
    cone = lathe([(0.04, 0.1), (0.06, 0.08), (wide, -0.15), (0.06, -0.1), (0.02, 0.0)], 32)
    stand = cylinder(foot, 0.05, 0.01, 32) + tube(path, thick, 12)
    return [(stand, material(random)), (cone.turn("z", tilt).move(reach, 0.97 * high), material(random))]


def tap(random: Generator) -> Parts:
    """A tap: a post with a spout to one side and a lever."""
    high, reach, wide = random.uniform((0.4, 0.4, 0.07), (0.8, 0.8, 0.14))
    level, thick = random.uniform(0.5, 0.9) * high, 0.5 * wide
    spout = box(reach, 2 * thick, 2 * thick, 0.01, 1).move(reach / 2, level)
    if chance(random, 0.5):
        path = [(0, level, 0), (0.4 * reach, high + 0.15, 0), (reach, level, 0), (reach, level - 0.1, 0)]
        spout = tube(curve(path, 16), thick, 14)
    post = pick(random, (cylinder(wide, high, 0.01, 28), box(2 * wide, high, 2 * wide, 0.01, 2))).move(y=high / 2)
    lever = board(0.06, 0.04, 0.3).turn("x", random.uniform(-40, 0)).move(0, high + 0.03, -0.1)
    metal = material(random, "grey", "white", "grey", "black")
    foot = cylinder(1.5 * wide, 0.04, 0.01, 28)
    return [(post + spout + foot, metal), (lever, pick(random, (metal, material(random))))]
