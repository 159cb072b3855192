"""Reading mesh files the way their authors' viewers do.

trimesh is the reader. Features that it ignores are converted to supported ones, or reported in a warning or an error;
nothing is silently drawn wrong.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from lp_framework.data.images import eight_bit
from lp_framework.data.mesh_files.common import FARTHEST, load, texture_bytes, warn
from lp_framework.data.mesh_files.gltf import read_gltf
from lp_framework.data.mesh_files.obj import read_obj
from lp_framework.errors import UserError


def read_mesh(path: Path, folders: Sequence[Path]) -> trimesh.Scene:
    """Read a mesh file as a scene; files that it refers to are searched for in `folders`.

    Warns of what is not drawn. Raises `UserError` for unsupported files, and any exception of the parsers.
    """
    match path.suffix.lower():
        case ".gltf" | ".glb":
            scene = read_gltf(path)
        case ".obj":
            scene = read_obj(path, folders)
        case ".ply":
            scene = read_ply(path, folders)
        case ".zip" | ".gz" | ".bz2":
            raise UserError(f"{path}: is an archive; unpack it, and give the folder of the meshes in it")
        case _:
            scene = trimesh.load_scene(str(path), process=False)
    meshes = [mesh for mesh in scene.geometry.values() if isinstance(mesh, trimesh.Trimesh)]
    for mesh in meshes:
        _clean(path, mesh)
    if left_out := sorted(set().union(*map(_left_out, meshes))):
        warn(path, f"ignored features of its materials: {', '.join(left_out)}")
    return scene


def read_ply(path: Path, folders: Sequence[Path]) -> trimesh.Scene:
    """Read a .ply file as a scene; its texture is searched for in `folders`."""
    content = path.read_bytes()
    header = content.partition(b"\nend_header")[0].decode("utf-8")
    names = list(dict.fromkeys(re.findall(r"^comment\s+TextureFile\s+(.*?)\s*$", header, re.MULTILINE | re.I)))
    if len(names) > 1:
        raise UserError(f"{path}: has {len(names)} textures, but only one can be read; save it as glTF or OBJ")
    textures = {name: texture_bytes(path, name, folders) for name in names}
    files: dict[str, bytes | str] = {name: data for name, data in textures.items() if data is not None}
    return load("ply", io.BytesIO(content), files, skip_materials=not files)


def _clean(path: Path, mesh: trimesh.Trimesh) -> None:
    """Remove faces with non-finite coordinates, and merge identical vertices."""
    faces = len(mesh.faces)
    if not np.isfinite(mesh.vertices).all():
        mesh.remove_infinite_values()
    if (lost := faces - len(mesh.faces)) and len(mesh.faces):
        warn(path, f"{lost} of {faces} triangles have infinite or undefined (NaN) corners; they are left out")
    uv = getattr(mesh.visual, "uv", None)
    if uv is not None and (lost := (~(np.abs(uv[mesh.faces]) < FARTHEST)).any(axis=(1, 2)).sum()):
        warn(path, f"{lost} of {faces} triangles have no valid texture coordinates; they show the texture's corner")
    # glTF's vertices are distinct by its standard, others if they have their own colours.
    coloured = getattr(mesh.visual, "kind", None) == "vertex" or "color" in mesh.vertex_attributes
    if path.suffix.lower() not in (".gltf", ".glb") and not coloured:
        with np.errstate(invalid="ignore"):  # non-finite texture coordinates
            mesh.process()


def _left_out(mesh: trimesh.Trimesh) -> set[str]:
    """Features of a mesh's material that no renderer draws. `ValueError` for a texture that none can draw."""
    material = getattr(mesh.visual, "material", None)
    if isinstance(material, PBRMaterial):
        image, factor, light = material.baseColorTexture, material.baseColorFactor, material.emissiveFactor
        clear = material.alphaMode in ("MASK", "BLEND") and (
            (factor is not None and factor[3] < 255)
            or (image is not None and image.convert("RGBA").getextrema()[3][0] < 255)
        )
    elif isinstance(material, SimpleMaterial):
        image, light = material.image, [float(level) for level in material.kwargs.get("ke", [])]
        opacity, transparency = (float(material.kwargs.get(key, [number])[-1]) for key, number in (("d", 1), ("tr", 0)))
        clear = opacity < 1 or transparency > 0 or "map_d" in material.kwargs
    else:
        return set()
    if image is not None:
        eight_bit(image)
    unmapped = image is not None and getattr(mesh.visual, "uv", None) is None
    shines = light is not None and np.any(light)
    found = {"transparency": clear, "emitted light": shines, "textures (it has no coordinates for them)": unmapped}
    return {what for what, is_so in found.items() if is_so}
