"""`renderer=auto`: pyrender where there is OpenGL, else raycast."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import trimesh
from numpy.typing import ArrayLike

from lp_framework.data.rendering.pyrender_renderer import PyrenderRenderer, offscreen_context
from lp_framework.data.rendering.raycast import RaycastRenderer
from lp_framework.data.rendering.renderer import Renderer, View
from lp_framework.errors import UserError
from lp_framework.registry import register


@register("renderer", "auto")
class AutoRenderer(Renderer):
    """pyrender where there is OpenGL, else raycast with a warning that says why."""

    def __init__(self) -> None:
        self.chosen: Renderer = PyrenderRenderer()
        try:
            offscreen_context()
        except UserError as error:
            warnings.warn(f"rendering with raycast instead of pyrender: {error}", stacklevel=2)
            self.chosen = RaycastRenderer()
        self.name = self.chosen.name

    def views(
        self, scene: trimesh.Scene, camera_to_world: ArrayLike, resolution: int, field_of_view_degrees: float
    ) -> Iterator[View]:
        return self.chosen.views(scene, camera_to_world, resolution, field_of_view_degrees)
