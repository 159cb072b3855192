"""The embedded objects: twelve toys that ship as arrays, so that the main commands need no download.

`NAME.npz` holds an object, with all its parts in one array each: `vertices` `[V, 3]` and `uv` `[V, 2]` (float64), and
`face_steps` `[F, 3]`, differences between consecutive faces, which take less space. `parts` `[P, 3]` has each part's
number of vertices, number of faces and texture; `texture_0` and so on are lossless WebP.
`scripts/make_embedded_objects.py` creates the files. Toys with a front face +Z or drive towards +X.
"""

from __future__ import annotations

import io
from functools import partial
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from lp_framework.data.meshes import MeshObject


def toy_objects() -> list[MeshObject]:
    """The embedded objects, each with its ambiguity class."""
    unique = ("fire_engine", "cottage", "robot", "sailboat", "duck", "watering_can")
    return [
        *(MeshObject(name, "unique", partial(_load, name)) for name in unique),
        *(MeshObject(name, "twofold", partial(_load, name)) for name in ("tram", "juice_carton", "suitcase")),
        MeshObject("soup_can", "continuous", partial(_load, "soup_can"), unique_answer=True),  # resolved by its label
        MeshObject("lotus_vase", "continuous", partial(_load, "lotus_vase")),  # its pattern repeats 16 times
        MeshObject("celadon_bottle", "continuous", partial(_load, "celadon_bottle")),  # plain
    ]


def _load(name: str) -> trimesh.Scene:
    """The normalised scene of an embedded object."""
    with np.load(Path(__file__).with_name(f"{name}.npz")) as file:
        arrays = dict(file)
    parts, faces = arrays["parts"], arrays["face_steps"].cumsum(axis=0)
    last_vertex, last_face = parts[:, :2].cumsum(axis=0).T
    meshes = []
    for (vertices, triangles, texture), v, f in zip(parts, last_vertex, last_face, strict=True):
        image = Image.open(io.BytesIO(arrays[f"texture_{texture}"].tobytes())).convert("RGB")
        material = PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0)  # matte
        visual = TextureVisuals(uv=arrays["uv"][v - vertices : v], material=material)
        own = arrays["vertices"][v - vertices : v]
        meshes.append(trimesh.Trimesh(own, faces[f - triangles : f], visual=visual, process=False))
    return trimesh.Scene(meshes)
