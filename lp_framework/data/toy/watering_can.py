"""`data=toy`: the watering can."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image

from lp_framework.data.toy import textures as tx
from lp_framework.data.toy.shapes import (
    arc,
    arc_length,
    curve,
    ellipsoid,
    extrude,
    joined,
    lathe,
    rod,
    scene,
    torus,
    tube,
)


def watering_can() -> trimesh.Scene:
    """A watering can, spout to +X: sunflowers on its right, a ladybird on its left, where a trowel hangs."""
    picture = Image.new("RGB", (1024, 512), tx.TEAL)
    draw = tx.pen(picture)
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
    sieve = tx.bands(
        [
            (0.42, tx.ORANGE),
            (0.7, tx.BROWN),
            (0.76, tx.ORANGE),
            (0.82, tx.BROWN),
            (0.88, tx.ORANGE),
            (0.94, tx.BROWN),
            (1, tx.ORANGE),
        ]
    )
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
        [
            body,
            rims.paint(tx.plain(tx.MUSTARD)),
            spout.paint(tx.bands([(0.55, tx.TEAL), (0.6, tx.MUSTARD), (1, tx.TEAL)])),
            brace.paint(tx.plain(tx.STEEL)),
            rose.turn("z", -50).move(1.1, 0.97).paint(sieve),
            grip.paint(tx.plain(tx.RED)),
            arch.paint(tx.plain(tx.MUSTARD)),
            wrap.paint(tx.plain(tx.BROWN)),
            cover.paint(tx.plain(tx.shade(tx.TEAL, 1.15))),
            trowel.paint(tx.plain(tx.STEEL)),
            shaft.paint(tx.plain(tx.SLATE)),
            knob.paint(tx.painted(tx.RED)),
            hook.paint(tx.plain(tx.DARK)),
        ]
    )
