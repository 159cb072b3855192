"""`data=toy`: the celadon bottle."""

from __future__ import annotations

import numpy as np
import trimesh
from PIL import Image

from lp_framework.data.toy import textures as tx
from lp_framework.data.toy.shapes import curve, hollow, lathe, scene


def celadon_bottle() -> trimesh.Scene:
    """A plain glazed bottle: its colour depends on the height alone, darker where the glaze gathers."""
    outside = curve(
        [
            (0.3, 0),
            (0.33, 0.03),
            (0.31, 0.08),
            (0.44, 0.24),
            (0.5, 0.44),
            (0.4, 0.66),
            (0.19, 0.82),
            (0.14, 1.0),
            (0.15, 1.16),
            (0.24, 1.28),
        ],
        73,
    )
    profile, share = hollow(outside, 0.03)
    stops = np.array([0, 0.05, 0.09, 0.13, 0.3, 0.55, 0.8, 0.95, 0.985, 1.0, 1.02]) * share
    colours = [
        tx.BROWN,
        tx.BROWN,
        (92, 128, 108),
        (124, 166, 142),
        (150, 192, 164),
        (164, 204, 176),
        (146, 188, 162),
        (150, 190, 164),
        (176, 150, 110),
        (132, 100, 70),
        (70, 58, 46),
    ]
    heights = 1 - (np.arange(1024) + 0.5) / 1024
    column = np.stack([np.interp(heights, stops, channel) for channel in np.transpose(colours)], axis=1)
    glaze = np.broadcast_to(column[:, None].round().astype(np.uint8), (1024, 8, 3))
    return scene([lathe(profile, 96).paint(Image.fromarray(np.ascontiguousarray(glaze)))])
