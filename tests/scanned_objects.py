"""Textured objects as glb files of two kinds that people have: a scan in one piece, and a model of painted sheets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial


def picture(width: int, height: int, waves: float) -> Image.Image:
    """A smooth picture whose colours encode the position."""
    y, x = np.mgrid[0:height, 0:width] / max(width, height)
    colours = np.stack([0.2 + 0.6 * x, 0.2 + 0.6 * y, 0.5 + 0.4 * np.sin(waves * x) * np.cos(waves * y)], axis=-1)
    return Image.fromarray((255 * colours).astype(np.uint8))


def textured(mesh: trimesh.Trimesh, uv: NDArray[np.float64], image: Image.Image) -> trimesh.Trimesh:
    mesh.visual = TextureVisuals(uv=uv, material=PBRMaterial(baseColorTexture=image))
    return mesh


def around(mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """Texture coordinates `[n, 2]`: the direction around Y and the height, a seam at the back."""
    low, high = mesh.bounds
    x, y, z = mesh.vertices.T
    return np.stack([np.arctan2(x, z) / (2 * np.pi) + 0.5, (y - low[1]) / (high[1] - low[1])], axis=1)


def write_mug(folder: Path) -> Path:
    """One mesh with a texture: a hollow body, its vertices split at the seam of the texture, and a handle."""
    body = trimesh.creation.annulus(r_min=0.035, r_max=0.04, height=0.1, sections=48)
    bottom = trimesh.creation.cylinder(radius=0.038, height=0.006, sections=48)
    bottom.apply_translation([0, 0, -0.047])
    handle = trimesh.creation.torus(0.025, 0.006, major_sections=24, minor_sections=12)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    handle.apply_translation([0.055, 0, 0])
    mug = trimesh.util.concatenate([body, bottom, handle]).subdivide()
    mug.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))  # +Y is up
    mug.unmerge_vertices()
    uv = around(mug).reshape(-1, 3, 2)
    across = np.ptp(uv[..., 0], axis=1) > 0.5
    uv[across, :, 0] += uv[across, :, 0] < 0.5
    textured(mug, uv.reshape(-1, 2), picture(512, 512, 15))
    return export(trimesh.Scene(mug), folder / "mug.glb")


def write_bottle(folder: Path) -> Path:
    """Three meshes, each with its place: glass of one plain colour, a stopper, and a label with two painted sides."""
    glass = trimesh.creation.cylinder(radius=0.1, height=0.6, sections=32)
    glass.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=[20, 70, 40, 255]))
    stopper = trimesh.creation.cylinder(radius=0.05, height=0.1, sections=32)
    textured(stopper, stopper.vertices[:, :2] / 0.1 + 0.5, picture(32, 8, 3))
    columns, rows = np.meshgrid(np.linspace(0, 1, 17), np.linspace(0, 1, 9))
    uv = np.stack([columns, rows], axis=-1).reshape(-1, 2)
    corner = np.arange(9 * 17).reshape(9, 17)
    a, b, c, d = (each.reshape(-1) for each in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    points = np.stack([0.6 * (uv[:, 0] - 0.5), 0.1 * np.sin(3 * uv[:, 0]), 0.4 * (uv[:, 1] - 0.5)], axis=1)
    front = textured(trimesh.Trimesh(points, faces, process=False), uv, picture(512, 655, 25))
    back = textured(trimesh.Trimesh(points, faces[:, ::-1], process=False), uv, picture(64, 48, 3).rotate(180))
    scene = trimesh.Scene()
    upright = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
    for mesh, place in ((glass, [0, 0, 0]), (stopper, [0, 0.35, 0]), (front, [0, 0, 0.15]), (back, [0, 0, 0.15])):
        scene.add_geometry(mesh, transform=trimesh.transformations.translation_matrix(place) @ upright)
    return export(scene, folder / "bottle.glb")


def export(scene: trimesh.Scene, path: Path) -> Path:
    scene.export(path)
    return path
