"""Views per second of a renderer, with the mesh loaded once or loaded again for every view."""

from __future__ import annotations

import math
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lp_framework.benchmarks.harness import Section, work_of
from lp_framework.data.meshes import load_scene
from lp_framework.data.rendering.renderer import Renderer
from lp_framework.data.toy import toy_objects
from lp_framework.data.views import FIELD_OF_VIEW_DEGREES
from lp_framework.errors import UserError, among
from lp_framework.geometry import camera_to_world


def measure(section: Section, object: str, renderer: Renderer, views: int, resolution: int, rounds: int) -> None:
    """Render views around an embedded object with the chosen renderer, from a mesh file (GLB)."""
    objects = {each.name: each for each in toy_objects()}
    if object not in objects:
        raise UserError(f"rendering.object={object} is not one of the embedded objects{among(object, objects)}")
    cameras = around(views)
    section.title, section.contenders = "rendering: views of a mesh file", ("mesh loaded once", "for every view")
    section.note = f"{object}, {views} views of {resolution} x {resolution} pixels"
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{object}.glb"
        objects[object].load().export(file)
        once, each_time = (partial(draw, renderer, file, cameras, resolution) for draw in (drawn, drawn_one_by_one))
        works = {f"{renderer.name}, views per second": (work_of(views, once), work_of(views, each_time))}
        section.race(works, rounds, rate=True)


def around(views: int) -> Tensor:
    """Cameras `[V, 4, 4]` around an object, 20 degrees up, at radius 1.6."""
    longitude = torch.arange(views, dtype=torch.float64) * (2 * math.pi / views)
    poses = [torch.full_like(longitude, math.radians(20)), longitude, torch.full_like(longitude, 1.6)]
    return camera_to_world(torch.stack(poses, dim=-1))


def drawn(renderer: Renderer, file: Path, cameras: Tensor, resolution: int) -> NDArray[np.uint8]:
    """Views `[V, H, W, 4]` of a mesh file loaded once."""
    return renderer.render(load_scene(file), cameras, resolution, FIELD_OF_VIEW_DEGREES)


def drawn_one_by_one(renderer: Renderer, file: Path, cameras: Tensor, resolution: int) -> NDArray[np.uint8]:
    """The same in a plain loop that loads the file for every view."""
    return np.concatenate([drawn(renderer, file, each[None], resolution) for each in cameras])
