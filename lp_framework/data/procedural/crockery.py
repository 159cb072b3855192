"""Crockery and kitchenware: mugs, bowls, plates, vases, pans, pots, teapots, cutlery."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from PIL import Image

from lp_framework.data.procedural import textures as tx
from lp_framework.data.procedural.labels import brand, panel
from lp_framework.data.procedural.paint import pen, plain
from lp_framework.data.procedural.shapes import Parts, around, body, handle, pair, stick, vessel
from lp_framework.data.procedural.solids import Array, arc, box, curve, cylinder, ellipsoid, extrude, lathe, rod, tube
from lp_framework.data.procedural.textures import chance, colour, colour_at, ground, ink, material, pick

GLAZES = ("white", "white", "white", "pale", "vivid", "deep", "brown", "grey", "black")


def glaze(random: Generator) -> Image.Image:
    """A texture for round objects that is constant or periodic around them: plain, horizontal bands, a frieze."""
    base, kind = colour(random, pick(random, GLAZES)), random.random()
    image = Image.new("RGB", (512, 512), base)
    if kind < 0.3:
        for top in random.uniform(0, 512, int(random.integers(1, 6))):
            pen(image).rectangle([0, top, 512, top + random.uniform(6, 60)], fill=colour(random))
    elif kind < 0.65:
        high = int(random.integers(60, 320))
        strip = tx.frieze(random, 512, high, pick(random, (8, 16, 32)), base)
        image.paste(strip, (0, int(random.integers(0, 512 - high))))
    return image


def scene_around(random: Generator) -> Image.Image:
    """A texture for round objects without repetition around them: pictures, or prints side by side."""
    image, kind = Image.new("RGB", (512, 512), colour(random, pick(random, GLAZES))), random.random()
    if kind < 0.6:
        base = colour_at(image)
        for u in np.arange(5) / 5:
            tile = Image.new("RGB", (160, 160), base)
            tx.picture(random, tile, 80, 80, 76, base)
            low = random.uniform(0.3, 0.55)
            stick(tile, u, low, low + 0.35, random.uniform(0.14, 0.19), image)
    else:
        b, busy = brand(random), 0.3 if kind < 0.8 else 1.0
        prints = [panel(random, b, role, random.uniform(0.7, 1.4), 1) for role in ("front", "story", "front")]
        prints.append(ground(random, 256, 256, b.base, ink(random, b.base), busy))
        around(prints, 0.1, 0.9, image)
    return image


def outside(random: Generator, foot: float, belly: float, rim: float, height: float) -> Array:
    """Outer profile (radius, height) of a vessel, from its foot to its rim."""
    widest, knee = random.uniform(0.4, 0.7), 0.4 * foot + 0.6 * belly
    knots = [(foot, 0), (knee, 0.18 * height), (belly, widest * height), (rim, height)]
    return np.concatenate([[(0.98 * foot, 0)], curve(knots, 10)])


def mug(random: Generator) -> Parts:
    """A mug or cup with a handle, printed, patterned or plain, sometimes on a saucer."""
    high, foot = random.uniform((0.6, 0.2), (1.1, 0.36))
    profile = np.array([(0.38, 0), (0.4, 0.03), (0.4, 0.5 * high), (0.4, high)])
    if chance(random, 0.6):
        belly, rim = random.uniform((max(foot, 0.32), 0.36), 0.45)
        profile = outside(random, foot, belly, rim, high)
    image = scene_around(random) if chance(random, 0.5) else glaze(random)
    low, top = random.uniform((0.1, 0.75), (0.3, 0.92)) * high
    x = float(np.interp([low, top], profile[:, 1], profile[:, 0]).min()) - 0.02
    grip = handle(x, low, top, *random.uniform((0.18, 0.03, 0.9), (0.32, 0.05, 1.6)))
    turn = pick(random, (0, 0, 180, random.uniform(0, 360)))
    paint = plain(colour_at(image) if chance(random, 0.8) else colour(random))
    parts = [(vessel(profile), image), (grip.turn("y", turn), paint)]
    if chance(random, 0.15):
        saucer = vessel([(0.3, -0.1), (0.45, -0.08), (0.62, 0.0), (0.68, 0.03)], 0.02, lined=True)
        parts.append((saucer, glaze(random)))
    return parts


def bowl(random: Generator, resolved: bool) -> Parts:
    """A bowl, a dish or a plate."""
    foot, high, flat = random.uniform(0.18, 0.4), random.uniform(0.25, 0.6), chance(random, 0.4)
    profile = outside(random, foot, random.uniform(0.4, 0.5), 0.5, high)
    if flat:
        profile = np.array([(foot, 0), (foot + 0.03, 0.3), (0.45, 0.8), (0.5, 1)]) * (1, 0.3 * high)
    lined = resolved or flat or chance(random, 0.5)
    return [(vessel(profile, 0.02, lined), scene_around(random) if resolved else glaze(random))]


def vase(random: Generator, resolved: bool) -> Parts:
    """A vase, an urn, a candlestick or a turned wooden piece."""
    radii = random.uniform(0.12, 0.42, int(random.integers(4, 7)))
    heights = np.linspace(0, random.uniform(0.8, 1.2), len(radii))
    profile = curve(np.stack([radii, heights], axis=1), 20).clip((0.06, 0))
    return [(vessel(profile, 0.02), scene_around(random) if resolved else glaze(random))]


def pan(random: Generator) -> Parts:
    """A frying pan or saucepan with a long handle."""
    high, wide, long, rise = random.uniform((0.07, 0.3, 0.35, 0), (0.4, 0.42, 0.75, 0.15))
    path = curve([(wide - 0.02, 0.85 * high, 0), (wide + 0.3 * long, high + rise, 0), (wide + long, high, 0)], 12)
    grip = tube(path, np.linspace(0.025, random.uniform(0.03, 0.05), 12), 12).scale(z=random.uniform(1, 1.6))
    dish = vessel([(0.8 * wide, 0), (0.86 * wide, 0.02), (wide, high)], 0.015)
    return [(dish, material(random, "black", "grey", "deep")), (grip, material(random, "black", "brown", grained=0.4))]


def pot(random: Generator) -> Parts:
    """A cooking pot with two handles and a lid, unchanged by half a turn."""
    high, paint, other = random.uniform(0.25, 0.6), plain(colour(random)), plain(colour(random))
    grips, knob = pair(handle(0.4, 0.6 * high, 0.85 * high, 0.14, 0.025, 2.5)), cylinder(0.05, 0.08, 0.015, 20)
    lid = lathe([(0.42, high), (0.43, high + 0.02), (0.25, high + 0.05), (0, high + 0.06)], 48)
    pot = vessel([(0.38, 0), (0.41, 0.03), (0.42, high)])
    return [(pot, paint), (grips + knob.move(y=high + 0.1), other), (lid, pick(random, (paint, other)))]


def teapot(random: Generator) -> Parts:
    """A teapot, kettle, coffee pot or watering can: a spout, a handle at the back or over the top, usually a lid."""
    high, belly, foot, rim = random.uniform((0.45, 0.3, 0.2, 0.14), (0.9, 0.42, 0.32, 0.26))
    image = scene_around(random) if chance(random, 0.45) else glaze(random)
    paint = plain(colour_at(image))
    reach, level, mouth, thick = random.uniform((0.15, 0.3, 0.85, 0.06), (0.4, 0.6, 1.1, 0.1)) * (1, high, high, 1)
    path = [(-belly + 0.08, level, 0), (-belly - 0.4 * reach, level + 0.1, 0), (-belly - reach, mouth, 0)]
    spout = tube(curve(path, 12), np.linspace(thick, 0.03, 12), 14)
    grip = handle(0.75 * belly, 0.2 * high, 0.9 * high, random.uniform(0.25, 0.4), 0.03, 1.3)
    if chance(random, 0.35):
        grip = tube(np.c_[arc((0, high), random.uniform(0.22, 0.3), 0, 180, 15), np.zeros(15)], 0.025, 12)
    parts = [(vessel(outside(random, foot, belly, rim, high)), image), (spout, paint)]
    parts.append((grip, paint if chance(random, 0.5) else material(random, "black", "brown", grained=0.5)))
    if chance(random, 0.8):
        lid = np.array([(1, -0.01), (1.05, 0.01), (0.5, 0.06), (0.15, 0.07), (0.2, 0.12), (0, 0.13)]) * (rim, 1)
        parts.append((lathe(lid + np.array([0, high]), 32), paint))
    return parts


def cutlery(random: Generator) -> Parts:
    """A spoon, fork, knife or spatula, or several of them side by side."""
    steel = material(random, "grey", "grey", "black", "brown", "vivid", grained=0.2)
    grip = steel if chance(random, 0.5) else material(random, "brown", "black", "vivid", grained=0.4)
    parts: Parts = []
    for k in range(pick(random, (1, 1, 2, 3))):
        long, z = random.uniform((0.45, -0.06), (0.65, 0.06))
        shaft = body([(0.05, 0.02, 0), (0.06, 0.025, 0.3 * long), (0.03, 0.02, long)], 2.5, 20, 3).turn("x", 90)
        tine = rod((0, 0, 0.1), (0, 0.02, 0.32), 0.011, 8)
        tines = pair(tine.move(0.017) + tine.move(0.05)) + box(0.12, 0.02, 0.14, 0.008, 1).move(z=0.05)
        blade = extrude([(-0.03, 0), (0.03, 0), (0.045, 0.3), (0.0, 0.45), (-0.03, 0.4)], 0.016, 0.004).turn("x", 90)
        spoon, spatula = ellipsoid(0.09, 0.035, 0.14, 20).move(z=0.1), box(0.22, 0.018, 0.3, 0.008, 1).move(z=0.14)
        head = pick(random, (tines, blade, spoon, spatula)).move(z=long)
        parts += [(shaft.move(0.24 * k, 0, z), grip), (head.move(0.24 * k, 0, z), steel)]
    return parts
