"""`renderer=pyrender`: offscreen OpenGL by EGL or OSMesa; and `renderer=auto`, which falls back to raycast.

pyrender's shader decodes textures from sRGB and multiplies the lit result by vertex colours, assumed to be linear. With
metalness 0 and roughness 1 its material is a Lambertian surface with a faint sheen.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from lp_framework.data.meshes import Surface, surfaces
from lp_framework.data.rendering.raycast import RaycastRenderer
from lp_framework.data.rendering.renderer import AMBIENT, LIGHTS, SUPERSAMPLING, Renderer, View, downsample
from lp_framework.errors import UserError
from lp_framework.registry import register

if TYPE_CHECKING:
    import pyrender

PLATFORMS = ("egl", "osmesa")
NEAR, FAR = 0.01, 100.0  # scene units


@register("renderer", "pyrender")
class PyrenderRenderer(Renderer):
    """Offscreen OpenGL (EGL, else OSMesa), in software or on a GPU."""

    name = "pyrender"

    def views(
        self, scene: trimesh.Scene, camera_to_world: ArrayLike, resolution: int, field_of_view_degrees: float
    ) -> Iterator[View]:
        context = offscreen_context()
        import pyrender

        camera = pyrender.PerspectiveCamera(yfov=np.radians(field_of_view_degrees), znear=NEAR, zfar=FAR)
        stage = pyrender.Scene(bg_color=[0, 0, 0, 0], ambient_light=[AMBIENT] * 3)
        stage.add(pyrender.Mesh(_primitives(surfaces(scene))))
        camera_node = stage.add(camera)
        for towards, intensity in LIGHTS:
            source = pyrender.DirectionalLight(color=[1.0, 1.0, 1.0], intensity=intensity)
            pose = trimesh.geometry.align_vectors([0, 0, 1], towards)  # its +Z axis points towards the light
            stage.add(source, pose=pose, parent_node=camera_node)
        for pose in np.asarray(camera_to_world, dtype=np.float64):
            stage.set_pose(camera_node, pose)
            context.viewport_width = context.viewport_height = resolution * SUPERSAMPLING
            yield downsample(*context.render(stage, flags=pyrender.RenderFlags.RGBA))


def _primitives(parts: list[Surface]) -> list[pyrender.Primitive]:
    """Draw each triangle twice, once flipped with its normals, unless another triangle backs it; culling then leaves
    the visible side."""
    import pyrender

    primitives = []
    for surface in parts:
        coordinates, colours, texture = surface.texture_coordinates, surface.corner_colours, None
        if surface.texture is not None:
            sampler = None if surface.wrap is None else pyrender.Sampler(wrapS=surface.wrap[0], wrapT=surface.wrap[1])
            texture = pyrender.Texture(sampler=sampler, source=surface.texture, source_channels="RGB")
        material = pyrender.MetallicRoughnessMaterial(
            baseColorFactor=[*surface.colour, 1.0],
            baseColorTexture=texture,
            metallicFactor=0.0,
            roughnessFactor=1.0,
        )
        corners = np.arange(len(surface.positions)).reshape(-1, 3)
        turned = corners[surface.twins < 0, ::-1]
        for order, sign in ((corners.reshape(-1), 1), (turned.reshape(-1), -1)):
            if not len(order):
                continue
            attributes = [surface.positions[order], sign * surface.normals[order]]
            attributes += [each[order] for each in (coordinates, colours) if each is not None]
            shared, index = np.unique(np.hstack(attributes), axis=0, return_inverse=True)  # so each is transformed once
            primitives.append(
                pyrender.Primitive(
                    positions=shared[:, :3],
                    normals=shared[:, 3:6],
                    texcoord_0=None if coordinates is None else shared[:, 6:8],
                    color_0=None if colours is None else shared[:, -3:],
                    indices=index.reshape(-1, 3),
                    material=material,
                )
            )
    return primitives


@cache
def offscreen_context() -> pyrender.OffscreenRenderer:
    """The process's only OpenGL context, as closing one of pyrender's closes them all; `UserError` without OpenGL."""
    chosen = os.environ.get("PYOPENGL_PLATFORM")
    reasons = []
    for platform in (chosen,) if chosen else PLATFORMS:
        os.environ["PYOPENGL_PLATFORM"] = platform
        try:
            return _open_context()
        except Exception as error:  # missing library, device or driver: each raises its own exception
            reasons.append(f"{platform}: {type(error).__name__}: {error}")
            _forget_opengl()
    if not chosen:
        del os.environ["PYOPENGL_PLATFORM"]
    raise UserError(
        f"renderer=pyrender finds no OpenGL on this machine ({'; '.join(reasons)}); "
        "install libegl1 with a Mesa driver or libosmesa6, or choose renderer=raycast"
    )


def _open_context() -> pyrender.OffscreenRenderer:
    """A context without pyrender's multisampling: like raycast we supersample ourselves, which leaves each sample
    either opaque or transparent; doing both would make software OpenGL three times slower."""
    import pyrender

    allocate = pyrender.renderer.glRenderbufferStorageMultisample
    pyrender.renderer.glRenderbufferStorageMultisample = lambda target, _, *sizes: allocate(target, 0, *sizes)
    return pyrender.OffscreenRenderer(64, 64)


def _forget_opengl() -> None:
    """Unload PyOpenGL, which binds to a platform on first import, so that the next platform can be tried."""
    for module in [name for name in sys.modules if name.partition(".")[0] in ("OpenGL", "pyrender")]:
        del sys.modules[module]


@register("renderer", "auto")
class AutoRenderer(Renderer):
    """Use pyrender if OpenGL is available, else raycast with a warning that says why."""

    def __new__(cls) -> Renderer:  # type: ignore[misc]  # one of the two
        """Create one of the two renderers."""
        try:
            offscreen_context()
        except UserError as error:
            warnings.warn(f"rendering with raycast instead of pyrender: {error}", stacklevel=2)
            return RaycastRenderer()
        return PyrenderRenderer()
