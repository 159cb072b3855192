"""Masks of photographs that have none: by rembg where it is installed and has its weights, else roughly by GrabCut."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import numpy as np
from PIL import Image

log = logging.getLogger(__name__)

ROUGH_SIDE = 512  # pixels of the longest side at which GrabCut works, for its time
MARGIN = 0.05  # of a side: the frame around the image that GrabCut takes for background
ROUNDS = 5  # of GrabCut
ROUGH = "a rough mask was made by GrabCut, since rembg {why}; an alpha channel, masks=FOLDER or rembg is better"


class MaskMaker(NamedTuple):
    """What makes masks: its name, and the function from an RGB image to opacity ("L")."""

    name: str
    mask: Callable[[Image.Image], Image.Image]


@cache
def mask_maker() -> MaskMaker:
    """By rembg (MIT licence) with U^2-Net (Apache-2.0, 176 MB), or, after a warning, by OpenCV's GrabCut."""
    try:
        from rembg import new_session, remove

        session = new_session("u2net")  # its default network is not free for commercial use
    except (ImportError, SystemExit):  # without onnxruntime it exits
        why = "is not installed (pip install 'lp_framework[masks]')"
    except (OSError, ValueError) as error:
        why = f"cannot get its weights ({error})"
    else:
        return MaskMaker("rembg", partial(remove, session=session, only_mask=True))
    log.warning(ROUGH.format(why=why))
    return MaskMaker("GrabCut", rough_mask)


def rough_mask(image: Image.Image) -> Image.Image:
    """The largest part of what GrabCut finds within a centred box; nothing ("L", all 0) where it finds none."""
    import cv2  # when needed, for it takes a while

    small = image.convert("RGB")
    small.thumbnail((ROUGH_SIDE, ROUGH_SIDE))
    pixels = np.ascontiguousarray(np.asarray(small)[..., ::-1])
    height, width = pixels.shape[:2]
    left, top = (max(1, round(MARGIN * side)) for side in (width, height))
    labels = np.zeros((height, width), np.uint8)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.setRNGSeed(0)
    try:
        cv2.grabCut(
            pixels, labels, (left, top, width - 2 * left, height - 2 * top), *models, ROUNDS, cv2.GC_INIT_WITH_RECT
        )
    except cv2.error:  # a picture without contrast, or of a few pixels
        return Image.new("L", image.size)
    found = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8)
    _, parts, stats, _ = cv2.connectedComponentsWithStats(found)
    if len(stats) > 1:
        found = (parts == 1 + stats[1:, cv2.CC_STAT_AREA].argmax()).astype(np.uint8)
    return Image.fromarray(found * 255).resize(image.size, Image.Resampling.BILINEAR)
