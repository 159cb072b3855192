"""`data=toy`: the tram."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image

from lp_framework.data.toy import textures as tx
from lp_framework.data.toy.shapes import both, box, cylinder, ellipsoid, joined, loft, plan, rod, scene, tube


def tram() -> trimesh.Scene:
    """A tram along X: red on one flank and teal on the other, a mustard head and a navy tail."""

    def flank(colour: tx.Colour, trim: tx.Colour) -> Image.Image:
        picture = tx.mottle(Image.new("RGB", (840, 320), tx.CREAM), 0.03, 1)
        draw = tx.pen(picture)
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
        end = tx.mottle(Image.new("RGB", (280, 320), colour), 0.03, 2)
        draw = tx.pen(end)
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
        [
            cylinder(0.17, 0.1, 0.02, 32).turn("x", 90).move(x, 0.17, z)
            for x in (-0.95, -0.5, 0.5, 0.95)
            for z in (-0.4, 0.4)
        ]
    )
    bogies = joined([box(0.7, 0.1, 0.9, 0.03).move(x, 0.19) for x in (-0.725, 0.725)])
    bumper = box(0.12, 0.1, 0.6, 0.04).move(length / 2, 0.3)
    lamps = joined([ellipsoid(0.05, 0.07, 0.07, 20).move(length / 2 - 0.01, 0.44, z) for z in (-0.22, 0.22)])
    vents = both(box(0.5, 0.12, 0.46, 0.04).move(0.86, 1.5)) + box(0.5, 0.06, 0.6, 0.02).move(0, 1.47)
    arms = joined([rod((0.24 * s, 1.5, z), (0.44 * s, 1.68, z), 0.02) for s in (-1, 1) for z in (-0.16, 0.16)])
    arms += joined([rod((0.44 * s, 1.68, z), (0.06 * s, 1.9, z), 0.016) for s in (-1, 1) for z in (-0.16, 0.16)])
    arms += joined([rod((0.44 * s, 1.68, -0.16), (0.44 * s, 1.68, 0.16), 0.016) for s in (-1, 1)])
    across = np.linspace(-1, 1, 15)
    bow = np.stack([0 * across, 1.91 - 0.05 * across**4, 0.34 * across], axis=1)
    shoes = joined([tube(bow, 0.02, 10).move(x) for x in (-0.06, 0.06)])
    return scene(
        [
            walls.paint(livery),
            roof.paint(tx.plain(tx.STEEL)),
            gutter.paint(tx.plain(tx.CREAM)),
            skirt.paint(tx.plain(tx.DARK)),
            wheels.paint(
                tx.bands([(0.08, tx.STEEL), (0.2, tx.SLATE), (0.8, tx.DARK), (0.92, tx.SLATE), (1, tx.STEEL)])
            ),
            bogies.paint(tx.plain(tx.SLATE)),
            both(bumper).paint(tx.plain(tx.SLATE)),
            lamps.paint(tx.plain(tx.WHITE)),
            lamps.turn("y", 180).paint(tx.plain(tx.RED)),
            vents.paint(tx.plain(tx.SLATE)),
            arms.paint(tx.plain(tx.MAROON)),
            shoes.paint(tx.plain(tx.DARK)),
        ]
    )
