"""Renderings made to look like photographs that `data.photographs.prepare` has cut out, centred and scaled.

They add what real photographs have and renderings lack: a slight roll of the camera, varying light and exposure, blur,
JPEG artefacts, a slightly wrong mask, and the crop to the object, which loses its distance.
"""

from __future__ import annotations

import io
import itertools
import math
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image, ImageFilter

from lp_framework.data.cache import cached_array, pixels_on_white, sample_images, tracked, versioned_key
from lp_framework.data.files import content_key
from lp_framework.data.images import eight_bit
from lp_framework.data.photographs import EXTENT, SIZE, opened
from lp_framework.data.views import DEPTH_UNIT, ObjectViews
from lp_framework.errors import UserError
from lp_framework.keyed_random import stable_id

ROLL_DEGREES = 10.0  # maximum roll to either side
CELLS = 14  # per side of a view; each has its features and a 3-D point


def like_photograph(
    view: NDArray[np.uint8], points: NDArray[np.float32], random: Generator
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Make a rendering `[H, W, 4]`, with points `[H, W, 3]` (NaN where it is empty), look like a photograph: RGBA
    `[SIZE, SIZE, 4]` and the 3-D points `[SIZE, SIZE, 3]` seen in its pixels."""
    matrix = _to_crop(view[..., 3], math.radians(random.uniform(-ROLL_DEGREES, ROLL_DEGREES)), random)
    ground = tuple((random.uniform(0, 255) + random.uniform(-40, 40, 3)).clip(0, 255).astype(int).tolist())
    image = Image.fromarray(view)
    alpha = image.getchannel("A")
    scene = Image.composite(image.convert("RGB"), Image.new("RGB", image.size, ground), alpha)
    coefficients = tuple(matrix[:2].reshape(-1))
    size = (SIZE, SIZE)
    scene = scene.transform(size, Image.Transform.AFFINE, coefficients, Image.Resampling.BICUBIC, fillcolor=ground)
    alpha = alpha.transform(size, Image.Transform.AFFINE, coefficients, Image.Resampling.BICUBIC)
    scene = _lit(scene, random).filter(ImageFilter.GaussianBlur(random.uniform(0, 1.5)))
    compressed = io.BytesIO()
    scene.save(compressed, "JPEG", quality=int(random.integers(40, 96)))
    rgba = np.dstack([np.asarray(Image.open(compressed)), np.asarray(_masked(alpha, random))])
    return rgba, _warped(points, matrix)


def _to_crop(alpha: NDArray[np.uint8], roll: float, random: Generator) -> NDArray[np.float64]:
    """The affine map `[3, 3]` from pixels of the crop to those of a rendering, rolled by an angle (radians)."""
    rows, columns = np.nonzero(alpha >= 128)
    if len(rows) == 0:
        return np.diag([alpha.shape[1] / SIZE, alpha.shape[0] / SIZE, 1.0])
    cosine, sine = math.cos(roll), math.sin(roll)
    turn = np.array([[cosine, -sine], [sine, cosine]])  # the crop's axes in the rendering
    places = np.stack([columns, rows], axis=1) @ turn  # coordinates along the crop's axes
    low, high = places.min(axis=0), places.max(axis=0) + 1
    scale = (high - low).max() / EXTENT * random.uniform(0.95, 1.05)  # pixels of the rendering per pixel of the crop
    corner = (low + high) / 2 - scale * SIZE / 2 + random.uniform(-4, 4, 2) * scale
    matrix = np.eye(3)
    matrix[:2, :2], matrix[:2, 2] = turn * scale, turn @ corner
    return matrix


def _lit(image: Image.Image, random: Generator) -> Image.Image:
    """Vary exposure, contrast and tint, and add a light that falls off across the image."""
    levels = np.asarray(image, dtype=np.float32) / 255
    y, x = np.mgrid[-1 : 1 : SIZE * 1j, -1 : 1 : SIZE * 1j].astype(np.float32)
    angle = random.uniform(0, 2 * math.pi)
    falloff = 1 + random.uniform(0, 0.3) * (math.cos(angle) * x + math.sin(angle) * y)
    gain = np.exp(random.normal(0, 0.25)) * np.exp(random.normal(0, 0.06, 3))
    levels = levels ** np.exp(random.normal(0, 0.2)) * gain * falloff[..., None]
    return Image.fromarray((levels.clip(0, 1) * 255 + 0.5).astype(np.uint8))


def _masked(alpha: Image.Image, random: Generator) -> Image.Image:
    """Make the mask a little too wide or too narrow, and soft; sometimes keep it exact."""
    reach = int(random.integers(-2, 3))
    if reach > 0:
        alpha = alpha.filter(ImageFilter.MaxFilter(2 * reach + 1))
    elif reach < 0:
        alpha = alpha.filter(ImageFilter.MinFilter(-2 * reach + 1))
    return alpha.filter(ImageFilter.GaussianBlur(random.uniform(0, 1.5)))


def _warped(points: NDArray[np.float32], matrix: NDArray[np.float64]) -> NDArray[np.float32]:
    """The points at the pixels of the crop, from the nearest pixel of the rendering."""
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    x, y = np.tensordot(matrix[:2, :2], np.stack([columns, rows]), axes=1) + matrix[:2, 2][:, None, None]
    x, y = np.floor(x).astype(int), np.floor(y).astype(int)
    inside = (x >= 0) & (x < points.shape[1]) & (y >= 0) & (y < points.shape[0])
    result = points[y.clip(0, points.shape[0] - 1), x.clip(0, points.shape[1] - 1)]
    result[~inside] = np.nan
    return result


def decoded_renderings(
    views: Sequence[ObjectViews], share: float, size: int, folder: str | Path
) -> tuple[str, np.memmap]:
    """Key and array `[N]` of renderings with depth; `share` of the objects are made to look like photographs.

    A row has `pixels` (size, size, 3), uint8 on white; `points` (CELLS^2, 3), float16, seen in its cells, in the
    object's frame, NaN where empty; and `cropped`, whether it was made to look like a photograph.
    """
    files = [file for each in views for file in each.files]
    depths = [file.parents[1] / "depth" / file.name for file in files]
    if missing := [file for file in depths if not file.is_file()]:
        raise UserError(f"{missing[0]}: there is no such file; render the views with data.depth=true")
    record = np.dtype([("pixels", "u1", (size, size, 3)), ("points", "f2", (CELLS * CELLS, 3)), ("cropped", "?")])

    def decode(
        image: Image.Image, levels: Image.Image, camera: NDArray, field_of_view: float, random: Generator | None
    ) -> NDArray:
        pixels, points = np.asarray(eight_bit(image).convert("RGBA")), _points(levels, camera, field_of_view)
        if random is not None:
            pixels, points = like_photograph(pixels, points, random)
        row = np.zeros(1, record)
        row["pixels"] = pixels_on_white(Image.fromarray(pixels), size)
        row["points"], row["cropped"] = _in_cells(points), random is not None
        return row

    def blocks() -> Iterator[NDArray]:
        remaining = iter(depths)
        for each in tracked(views, "decoding renderings"):
            cropped = np.random.default_rng(stable_id(each.name)).random() < share
            for file, camera, angle in zip(each.files, each.cameras.numpy(), each.field_of_view.tolist(), strict=True):
                random = np.random.default_rng(stable_id(f"{each.name}/{file.name}")) if cropped else None
                with opened(file) as image, opened(next(remaining)) as levels:
                    yield decode(image, levels, camera, angle, random)

    seen_from = [(each.name, each.cameras.tolist(), each.field_of_view.tolist()) for each in views]
    key = content_key([*files, *depths], "renderings by object", share, size, CELLS, seen_from)
    soft, deep = sample_images()
    samples = [decode(soft, deep, np.eye(4), 1.0, each) for each in (None, np.random.default_rng(0))]
    return key, cached_array(folder, versioned_key(key, samples), len(files), blocks)


def _points(levels: Image.Image, camera: NDArray, field_of_view: float) -> NDArray[np.float32]:
    """The 3-D points `[H, W, 3]` seen in the pixels of a depth image, NaN where it is empty."""
    depth = np.asarray(levels).astype(np.float32) * np.float32(DEPTH_UNIT)
    height, width = depth.shape
    slope = math.tan(field_of_view / 2)
    x = ((np.arange(width) + 0.5) * 2 / width - 1) * slope
    y = (1 - (np.arange(height) + 0.5) * 2 / height) * slope
    rays = np.stack(np.broadcast_arrays(x[None], y[:, None], -1.0), axis=-1)
    points = rays * depth[..., None] @ camera[:3, :3].T + camera[:3, 3]
    points[depth == 0] = np.nan
    return points.astype(np.float32)


def _in_cells(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means `[CELLS^2, 3]` of the points `[H, W, 3]` in each cell, using every third pixel in both directions."""
    bounds = np.linspace(0, len(points), CELLS + 1).round().astype(int)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # from empty cells
        cells = [
            np.nanmean(points[top:bottom:3, left:right:3].reshape(-1, 3), axis=0)
            for top, bottom in itertools.pairwise(bounds)
            for left, right in itertools.pairwise(bounds)
        ]
    return np.stack(cells)
