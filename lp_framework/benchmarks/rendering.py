"""Views a second of the renderers, with a mesh that is loaded once and with one that is loaded for every view."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.benchmarks.contest import Match, Work, compete
from lp_framework.benchmarks.section import Section
from lp_framework.data.meshes import MeshObject, load_scene
from lp_framework.data.rendering.renderer import Renderer
from lp_framework.errors import UserError
from lp_framework.geometry import camera_to_world

ONCE, LOOP = "mesh loaded once", "for every view"
FIELD_OF_VIEW_DEGREES = 49.1


def measure(
    obj: MeshObject, renderers: Mapping[str, Renderer], views: int, resolution: int, rounds: int, device: torch.device
) -> Iterator[Section]:
    """Views of an object around it, from a mesh file (GLB); renderers that cannot work here are named in the note."""
    cameras = around(views)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{obj.name}.glb"
        obj.load().export(file)
        matches, missing = [], []
        for name, renderer in renderers.items():
            try:
                renderer.render(obj.load(), cameras[:1], 8, FIELD_OF_VIEW_DEGREES)
            except UserError as error:
                missing.append(str(error))
                continue
            once, each_time = (
                _work(draw, renderer, file, cameras, resolution) for draw in (views_once, views_each_time)
            )
            matches.append(Match(name, f"{name}, views a second", once, each_time))
        if not matches:
            raise UserError(f"there is nothing to render with here: {'; '.join(missing)}")
        note = "; ".join([f"{obj.name}, {views} views of {resolution} x {resolution} pixels", *missing])
        yield from compete("rendering: views of a mesh file", (ONCE, LOOP), matches, rounds, device, note)


def around(views: int) -> Tensor:
    """Cameras `[V, 4, 4]` around an object, 20 degrees up, at radius 1.6."""
    longitude = torch.arange(views, dtype=torch.float64) * (2 * math.pi / views)
    poses = [torch.full_like(longitude, math.radians(20)), longitude, torch.full_like(longitude, 1.6)]
    return camera_to_world(torch.stack(poses, dim=-1))


def views_once(renderer: Renderer, file: Path, cameras: Tensor, resolution: int) -> NDArray[np.uint8]:
    """Views `[V, H, W, 4]` of a mesh file that is loaded once."""
    return renderer.render(load_scene(file), cameras, resolution, FIELD_OF_VIEW_DEGREES)


def views_each_time(renderer: Renderer, file: Path, cameras: Tensor, resolution: int) -> NDArray[np.uint8]:
    """The same as a plain loop, which loads the file for every view."""
    views = [renderer.render(load_scene(file), each[None], resolution, FIELD_OF_VIEW_DEGREES) for each in cameras]
    return np.concatenate(views)


def _work(
    draw: Callable[[Renderer, Path, Tensor, int], NDArray[np.uint8]],
    renderer: Renderer,
    file: Path,
    cameras: Tensor,
    resolution: int,
) -> Work:
    return lambda: len(draw(renderer, file, cameras, resolution))
