"""`data=toy`: the sailboat."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image

from lp_framework.data.toy import textures as tx
from lp_framework.data.toy.shapes import (
    Array,
    Shape,
    box,
    curve,
    ellipsoid,
    extrude,
    joined,
    loft,
    rod,
    scene,
    torus,
    tube,
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
    hull_picture = Image.new("RGB", (1024, 1024), tx.CREAM)
    draw = tx.pen(hull_picture)
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
    cloth = Image.new("RGB", (1024, 1024), tx.CREAM)
    draw = tx.pen(cloth)
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
    jib_cloth = Image.new("RGB", (512, 512), tx.MUSTARD)
    draw = tx.pen(jib_cloth)
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
    fenders = joined([ellipsoid(0.05, 0.12, 0.05, 16).move(px, 0.24, -0.49) for px in (-0.55, -0.2, 0.2)])
    tiller = tube(curve([(-1.12, 0.5, 0), (-0.9, 0.52, 0.03), (-0.62, 0.5, 0.1)], 10), 0.022)
    rudder = extrude([(-1.22, -0.12), (-1.0, -0.12), (-1.02, 0.5), (-1.16, 0.5)], 0.05, 0.015)
    pennant = extrude([(0, 0), (0, 0.16), (-0.36, 0.1)], 0.02, 0.004).turn("y", 25).move(0.1, 2.14)
    fin = extrude([(-0.3, -0.34), (0.2, -0.34), (0.34, 0.04), (-0.36, 0.04)], 0.09, 0.03)
    return scene(
        [
            hull,
            main.paint(cloth),
            sail(stay, clew, 0.1).paint(jib_cloth),
            rod((0.1, 0.3, 0), (0.1, 2.32, 0), 0.032).paint(tx.plain(tx.BROWN)),
            rod((1.12, 0.5, 0), (0.1, 2.1, 0), 0.008, 8).paint(tx.plain(tx.SLATE)),
            rod((-1.04, 0.46, 0), (0.1, 2.28, 0), 0.008, 8).paint(tx.plain(tx.SLATE)),
            cabin.paint(tx.box_sheet(ports, cabin_front, ports, cabin_front, cabin_front, cabin_front)),
            roof.paint(tx.plain(tx.TEAL)),
            buoy.paint(buoy_paint),
            fenders.paint(tx.plain(tx.SKY)),
            tiller.paint(tx.plain(tx.BROWN)),
            rudder.paint(tx.painted(tx.WOOD)),
            pennant.paint(tx.plain(tx.RED)),
            fin.paint(tx.plain(tx.SLATE)),
        ]
    )
