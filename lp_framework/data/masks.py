"""Masks of photographs: what masks of any kind mark, and masks that are made where there are none.

Masks are made by rembg where it is installed and has its weights, else roughly by GrabCut.
"""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import binary_dilation, find_objects, label, minimum_filter

from lp_framework.errors import UserError

log = logging.getLogger(__name__)

HALF = 128  # opacity, of 255, from which on a pixel is the object's
MOST_LABELS = 16  # a grey mask of more levels is soft, a coloured one of more colours is a picture
GREY = 16  # levels between the channels of a mask up to which it is grey: JPEG adds a little colour
THICK = 9  # pixels; an area of one level as wide as this is no soft edge
CELLS = 256  # squares along the longer side of an image; parts with an empty square between them are separate
STRAY = 0.25  # of the largest part; a smaller one that lies apart from it is a stray
ROUGH_SIDE = 512  # pixels of the longest side at which GrabCut works, for its time
MARGIN = 0.05  # of a side: the frame around the image that GrabCut takes for background
ROUNDS = 5  # of GrabCut
ROUGH = "a rough mask was made by GrabCut, since rembg {why}; an alpha channel, masks=FOLDER or rembg is better"


def alpha_opacity(alpha: Image.Image) -> Image.Image | None:
    """The opacity that an alpha channel ("L") stands for; None where nothing is less than half opaque."""
    values = np.asarray(alpha)
    low, high = int(values.min()), int(values.max())
    if low >= HALF:
        return None
    # The least level is background, 127 in ID-Pose's cut-outs; of just two the other one is opaque, be it 1.
    two = low < high and bool(((values == low) | (values == high)).all())
    return _stretched(values, low, high if two else 255)


def mask_opacity(mask: Image.Image, name: str) -> Image.Image | None:
    """The opacity ("L") that a mask of any mode stands for; None where it marks no background.

    Its alpha channel tells, where that has background, else its grey levels: the least is background, 255 or 65535 is
    opaque, and of just two levels the larger one. Colours, and levels that are no soft mask's, are labels: black, or
    the least level, is background and all others are the object, with a warning where there are several. `UserError`,
    which calls the photograph `name`, for a coloured picture.
    """
    if mask.has_transparency_data and (opacity := alpha_opacity(mask.convert("RGBA").getchannel("A"))):
        return opacity
    values, coloured = _levels(mask, name)
    levels = np.unique(values).astype(np.int64)
    low, high = int(levels[0]), int(levels[-1])
    full = 255 if high <= 255 else max(65535, high)
    if low > 0 and (coloured or low == high or 2 * low > full):
        return None
    if len(levels) != 2 and not coloured and not _are_labels(values, levels, full):
        return _stretched(values, low, full)
    if len(levels) > 2:
        warnings.warn(f"{name}: its mask has {len(levels) - 1} labels; all are taken for the object", stacklevel=2)
    return _stretched(values > low, 0, 1)


def _levels(mask: Image.Image, name: str) -> tuple[NDArray[Any], bool]:
    """The grey levels `[H, W]` of a mask, or numbers of its colours, black's being 0, and whether it is coloured."""
    if mask.mode.startswith(("I", "F")):
        values = np.nan_to_num(np.asarray(mask)).clip(0)
        shares = mask.mode == "F" and values.max() <= 1
        return np.rint(values * (65535.0 if shares else 1.0)).astype(np.int64), False
    colours = mask.convert("RGB")
    pixels = np.asarray(colours)
    if int(np.ptp(pixels, axis=2).max()) <= GREY:
        return np.asarray(mask.convert("L")), False
    if colours.getcolors(MOST_LABELS) is None:
        wanted = "a mask is black and white, or has one colour for each label"
        raise UserError(f"{name}: its mask is a picture of more than {MOST_LABELS} colours; {wanted}")
    return pixels.astype(np.int32) @ np.array([65536, 256, 1], dtype=np.int32), True


def _are_labels(values: NDArray[Any], levels: NDArray[Any], full: int) -> bool:
    """Whether the levels `[L]` of a grey mask `[H, W]` number things: a soft mask has many, or few in thin edges."""
    if not 1 < len(levels) <= MOST_LABELS:
        return False
    dark = levels[2 * levels < full]
    return len(dark) == len(levels) or any(minimum_filter(values == each, THICK).any() for each in dark[1:])


def _stretched(values: NDArray[Any], low: int, full: int) -> Image.Image:
    opacity = (values.astype(np.float32) - low) * (255 / (full - low))
    return Image.fromarray(np.rint(opacity).astype(np.uint8))


def without_strays(opacity: Image.Image, name: str) -> Image.Image:
    """The opacity ("L") without small parts that lie apart from the object and would enlarge its frame; a warning,
    which calls the photograph `name`, tells of them, and of large ones, which stay."""
    opaque = np.asarray(opacity) >= HALF
    cell = math.ceil(max(opaque.shape) / CELLS)
    counts = opaque.astype(np.int32)
    for axis, side in enumerate(opaque.shape):
        counts = np.add.reduceat(counts, range(0, side, cell), axis=axis)
    parts, count = label(counts > 0, np.ones((3, 3)))
    if count < 2:
        return opacity
    sizes = np.bincount(parts.ravel(), counts.ravel())
    largest = int(sizes.argmax())
    boxes = np.array([[down.start, across.start, -down.stop, -across.stop] for down, across in find_objects(parts)])
    apart = 1 + np.nonzero((boxes < boxes[largest - 1]).any(axis=1))[0]
    strays = apart[sizes[apart] < STRAY * sizes[largest]]
    if len(apart) > len(strays):
        others = f"{len(apart) - len(strays) + 1} separate parts, which are all taken for the object"
        warnings.warn(f"{name}: its mask has {others}", stacklevel=2)
    if not len(strays):
        return opacity
    pixels = f"{int(sizes[strays].sum())} pixels that lie apart from the object; they are left out"
    warnings.warn(f"{name}: its mask has {pixels}", stacklevel=2)
    left_out = binary_dilation(np.isin(parts, strays), np.ones((3, 3)))  # with their soft edges
    left_out = left_out.repeat(cell, axis=0).repeat(cell, axis=1)[: opaque.shape[0], : opaque.shape[1]]
    return Image.fromarray(np.where(left_out, np.uint8(0), np.asarray(opacity)))


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
