"""Reading mesh files as their authors' viewers do.

trimesh is the reader. What it passes over is put into terms that it reads, or named in a warning or an error: never
drawn wrong in silence.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh

from lp_framework.data.mesh_files.common import CLAMP, LINEAR_COLOUR, MIRROR, REPEAT, WRAP, MissingColourWarning, warn
from lp_framework.data.mesh_files.gltf import read_gltf
from lp_framework.data.mesh_files.obj import read_obj
from lp_framework.data.mesh_files.ply import read_ply

__all__ = ["CLAMP", "LINEAR_COLOUR", "MIRROR", "REPEAT", "WRAP", "MissingColourWarning", "read_mesh", "warn"]


def read_mesh(path: Path, folders: Sequence[Path]) -> trimesh.Scene:
    """The scene of a mesh file; the files that it names are looked for in `folders`.

    Warns of what is not drawn. Raises `UserError` for what makes the file unreadable, and whatever the parsers raise.
    """
    match path.suffix.lower():
        case ".gltf" | ".glb":
            scene = read_gltf(path)
        case ".obj":
            scene = read_obj(path, folders)
        case ".ply":
            scene = read_ply(path, folders)
        case _:
            scene = trimesh.load_scene(str(path), process=False)
    for mesh in scene.geometry.values():
        if isinstance(mesh, trimesh.Trimesh):
            _mend(path, mesh)
    return scene


def _mend(path: Path, mesh: trimesh.Trimesh) -> None:
    """Leave out faces at places that are not numbers, and merge vertices that are the same."""
    faces = len(mesh.faces)
    if not np.isfinite(mesh.vertices).all():
        mesh.remove_infinite_values()
    if lost := faces - len(mesh.faces):
        warn(path, f"{lost} of {faces} triangles have corners at infinity or nowhere (NaN); they are left out")
    uv = getattr(mesh.visual, "uv", None)
    if uv is not None and (lost := (~np.isfinite(uv[mesh.faces])).any(axis=(1, 2)).sum()):
        warn(path, f"{lost} of {faces} triangles have no proper texture coordinates; they show the texture's corner")
    # glTF's vertices are distinct by its standard, others where their colours are.
    coloured = getattr(mesh.visual, "kind", None) == "vertex" or "color" in mesh.vertex_attributes
    if path.suffix.lower() not in (".gltf", ".glb") and not coloured:
        with np.errstate(invalid="ignore"):  # texture coordinates that are not numbers
            mesh.process()
