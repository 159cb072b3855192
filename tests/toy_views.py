"""Views of the embedded objects on a transparent background, from anywhere."""

from __future__ import annotations

import math
from functools import cache

import torch
from PIL import Image

from lp_framework.data.rendering.raycast import RaycastRenderer
from lp_framework.data.toy import toy_objects
from lp_framework.geometry import camera_to_world


@cache
def toy_view(name: str, latitude: float, longitude: float) -> Image.Image:
    """An embedded object from a latitude and longitude (degrees), 256 pixels per side."""
    (toy,) = (each for each in toy_objects() if each.name == name)
    pose = torch.tensor([[math.radians(latitude), math.radians(longitude), 1.6]], dtype=torch.float64)
    return Image.fromarray(RaycastRenderer().render(toy.load(), camera_to_world(pose), 256, 49.1)[0])
