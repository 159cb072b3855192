"""`renderer=raycast`: CPU ray casting without OpenGL, with the look of `renderer=pyrender`.

Embree finds the triangle that each ray hits. Shading is pyrender's formula for metalness 0 and roughness 1, and
textures use OpenGL's trilinear filter.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from lp_framework.data.mesh_files.common import CLAMP, REPEAT
from lp_framework.data.meshes import Surface, srgb_to_linear, surfaces
from lp_framework.data.rendering.renderer import AMBIENT, LIGHTS, SUPERSAMPLING, Renderer, View, downsample
from lp_framework.errors import optional_import
from lp_framework.registry import register

RAYS_AT_ONCE = 2**18  # limits memory use


@register("renderer", "raycast")
class RaycastRenderer(Renderer):
    """Ray casting on the CPU (embree), for machines without OpenGL."""

    name = "raycast"

    def views(
        self, scene: trimesh.Scene, camera_to_world: ArrayLike, resolution: int, field_of_view_degrees: float
    ) -> Iterator[View]:
        embree = optional_import("trimesh.ray.ray_pyembree", "renderer=raycast", "pip install embreex")
        parts = [_Part(surface) for surface in surfaces(scene)]
        corners = np.concatenate([part.surface.positions for part in parts]).astype(np.float64)
        mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
        twins = np.concatenate([part.surface.twins for part in parts])
        first_triangle = np.cumsum([0, *(len(part.origin) for part in parts)])
        normals = np.concatenate([part.normal for part in parts])
        intersector = embree.RayMeshIntersector(mesh)
        side = resolution * SUPERSAMPLING
        step = 2 * np.tan(np.radians(field_of_view_degrees) / 2) / side  # sample spacing on the image plane at depth 1
        for pose in np.asarray(camera_to_world, dtype=np.float64):
            samples, depth = np.zeros((side * side, 4), np.uint8), np.zeros(side * side, np.float32)
            for start in range(0, side * side, RAYS_AT_ONCE):
                index = np.arange(start, min(start + RAYS_AT_ONCE, side * side))  # row by row, from the top
                row, column = np.divmod(index, side)
                x, y = (column + 0.5 - side / 2) * step, (side / 2 - row - 0.5) * step
                rays = x[:, None] * pose[:3, 0] + y[:, None] * pose[:3, 1] - pose[:3, 2]  # [n, 3], depth 1
                triangle = intersector.intersects_first(np.broadcast_to(pose[:3, 3], rays.shape), rays)
                seen_from_behind = (normals[triangle] * rays).sum(axis=1) > 0
                swapped = (triangle >= 0) & seen_from_behind & (twins[triangle] >= 0)
                triangle = np.where(swapped, twins[triangle], triangle)
                for part, begin, end in zip(parts, first_triangle[:-1], first_triangle[1:], strict=True):
                    met = np.flatnonzero((triangle >= begin) & (triangle < end))
                    if len(met):
                        colour, depth[index[met]] = part.seen(triangle[met] - begin, rays[met], pose, step)
                        samples[index[met], :3] = colour * 255 + 0.5
                        samples[index[met], 3] = 255
            yield downsample(samples.reshape(side, side, 4), depth.reshape(side, side))


class _Part:
    """A surface with per-triangle data for shading hits."""

    def __init__(self, surface: Surface) -> None:
        self.surface = surface
        self.origin, second, third = surface.positions.astype(np.float64).reshape(-1, 3, 3).swapaxes(0, 1)
        edge1, edge2 = second - self.origin, third - self.origin
        self.normal = np.cross(edge1, edge2)
        # Barycentric coordinates of a point p in the plane: b_k = gradient_k . (p - origin), k = 1, 2.
        area = np.maximum((self.normal**2).sum(axis=1, keepdims=True), np.finfo(float).tiny)
        self.gradient1 = np.cross(edge2, self.normal) / area
        self.gradient2 = np.cross(self.normal, edge1) / area
        self.mips = None if surface.texture is None else _Mips(surface.texture, surface.wrap)

    def seen(
        self, triangle: NDArray[np.int64], rays: NDArray[np.float64], pose: NDArray[np.float64], step: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Colours `[n, 3]` in [0, 1], sRGB, and depths `[n]` where camera rays hit triangles of this surface."""
        surface, normal = self.surface, self.normal[triangle]
        facing = (normal * rays).sum(axis=1)
        facing = np.where(np.abs(facing) < 1e-12, 1e-12, facing)
        depth = (normal * (self.origin[triangle] - pose[:3, 3])).sum(axis=1) / facing
        gradients = self.gradient1[triangle], self.gradient2[triangle]
        from_origin = pose[:3, 3] + depth[:, None] * rays - self.origin[triangle]
        # Embree uses single precision: a ray close to an edge may hit just outside the triangle.
        weight1, weight2 = (np.clip((gradient * from_origin).sum(axis=1), 0, 1) for gradient in gradients)
        weights = np.stack([np.maximum(1 - weight1 - weight2, 0), weight1, weight2], axis=1).astype(np.float32)
        weights /= weights.sum(axis=1, keepdims=True)

        def interpolate(corners: NDArray[np.float32]) -> NDArray[np.float32]:
            return np.einsum("nk,nkc->nc", weights, corners.reshape(-1, 3, corners.shape[1])[triangle])

        towards_camera = np.where(facing > 0, -1, 1).astype(np.float32)[:, None]
        shading_normal = _unit(interpolate(surface.normals)) * towards_camera
        colour = np.broadcast_to(surface.colour, shading_normal.shape)
        if self.mips is not None and surface.texture_coordinates is not None:
            corners = surface.texture_coordinates.reshape(-1, 3, 2)[triangle].astype(np.float64)
            sides = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
            footprint = []  # movement on the texture per sample to the right or up
            for axis in (pose[:3, 0], pose[:3, 1]):
                moved = (depth * step)[:, None] * (axis - rays * ((normal @ axis) / facing)[:, None])
                footprint.append(
                    sum((g * moved).sum(axis=1)[:, None] * s for g, s in zip(gradients, sides, strict=True))
                )
            texels = self.mips.sample(interpolate(surface.texture_coordinates), np.stack(footprint, axis=1))
            colour = colour * srgb_to_linear(texels)
        lit = _shade(shading_normal, -_unit(rays.astype(np.float32)), colour, pose)
        if surface.corner_colours is not None:
            lit = lit * interpolate(surface.corner_colours)
        return np.clip(lit ** np.float32(1 / 2.2), 0, 1), (pose[:3, 3] - interpolate(surface.positions)) @ pose[:3, 2]


def _unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def _shade(
    normal: NDArray[np.float32], view: NDArray[np.float32], colour: NDArray[np.float32], pose: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Light `[n, 3]` towards the camera: `compute_brdf` of pyrender's mesh.frag for metalness 0 and roughness 1, where
    the microfacet distribution D is 1 / pi and Smith's k is 1 / 2."""
    reflectance = np.float32(0.04)
    nv = np.clip(np.abs((normal * view).sum(axis=1)), 0.001, 1)
    out = AMBIENT * colour
    for direction, intensity in LIGHTS:
        towards = (pose[:3, :3] @ np.array(direction) / np.linalg.norm(direction)).astype(np.float32)
        half = _unit(view + towards)
        nl = np.clip(normal @ towards, 0.001, 1)
        vh = np.clip((view * half).sum(axis=1), 0, 1)
        fresnel = reflectance + (1 - reflectance) * (1 - vh) ** 5
        occlusion = nv / (nv * 0.5 + 0.5) * nl / (nl * 0.5 + 0.5)
        specular = fresnel * occlusion / np.float32(np.pi) / (4 * nl * nv + 0.001)
        diffuse = ((1 - fresnel) * (1 - reflectance) / np.float32(np.pi))[:, None] * colour
        out = out + (intensity * nl)[:, None] * (diffuse + specular[:, None])
    return out.astype(np.float32)


class _Mips:
    """A texture and its mip levels, concatenated in one array of texels, for OpenGL's trilinear filter."""

    def __init__(self, texture: NDArray[np.uint8], wrap: NDArray[np.int64] | None) -> None:
        self.wrap = (REPEAT, REPEAT) if wrap is None else wrap  # across and up
        levels = [texture]
        while max(texture.shape[:2]) > 1:
            rows, columns = (2 if side > 1 else 1 for side in texture.shape[:2])
            blocks = texture.reshape(texture.shape[0] // rows, rows, texture.shape[1] // columns, columns, 3)
            texture = (blocks.mean(axis=(1, 3)) + 0.5).astype(np.uint8)
            levels.append(texture)
        self.texels = np.concatenate([level.reshape(-1, 3) for level in levels])  # [n, 3]
        self.sizes = np.array([level.shape[1::-1] for level in levels])  # [levels, 2], width and height
        self.offsets = np.cumsum(self.sizes.prod(axis=1)) - self.sizes.prod(axis=1)  # [levels], of the first texels

    def sample(self, coordinates: NDArray[np.float32], footprint: NDArray[np.float64]) -> NDArray[np.float32]:
        """Values `[n, 3]` in [0, 1] at coordinates `[n, 2]`; `footprint` `[n, 2, 2]` is their change to the next sample
        to the right and up."""
        steps = np.linalg.norm(footprint * self.sizes[0], axis=2).max(axis=1)  # in texels
        level = np.clip(np.log2(np.maximum(steps, 1e-12)), 0, len(self.sizes) - 1)
        below = np.floor(level).astype(np.int64)
        above = np.minimum(below + 1, len(self.sizes) - 1)
        fraction = (level - below).astype(np.float32)[:, None]
        return (1 - fraction) * self._bilinear(coordinates, below) + fraction * self._bilinear(coordinates, above)

    def _bilinear(self, coordinates: NDArray[np.float32], level: NDArray[np.int64]) -> NDArray[np.float32]:
        width, height = self.sizes[level].T
        u, v = coordinates.astype(np.float64).T
        x, y = u * width - 0.5, (1 - v) * height - 0.5  # v points up, rows run down
        column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        right, down = (x - column).astype(np.float32)[:, None], (y - row).astype(np.float32)[:, None]

        def texel(r: NDArray[np.int64], c: NDArray[np.int64]) -> NDArray[np.float32]:
            index = self.offsets[level] + _wrapped(r, height, self.wrap[1]) * width + _wrapped(c, width, self.wrap[0])
            return self.texels[index].astype(np.float32) / 255

        top = (1 - right) * texel(row, column) + right * texel(row, column + 1)
        bottom = (1 - right) * texel(row + 1, column) + right * texel(row + 1, column + 1)
        return (1 - down) * top + down * bottom


def _wrapped(index: NDArray[np.int64], side: NDArray[np.int64], wrap: int) -> NDArray[np.int64]:
    """Wrap indices of texels that may lie outside a texture's `side`."""
    if wrap == CLAMP:
        return index.clip(0, side - 1)
    if wrap == REPEAT:
        return index % side
    mirrored = index % (2 * side)
    return np.minimum(mirrored, 2 * side - 1 - mirrored)
