"""Shared by the readers: finding the files that a mesh file refers to, as other viewers do, or warning if missing."""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.exchange.load import mesh_loaders
from trimesh.resolvers import ZipResolver
from trimesh.visual.material import SimpleMaterial, empty_material

from lp_framework.errors import UserError

LINEAR_COLOUR = "_LINEAR_COLOUR"  # a vertex attribute of trimesh: linear colours [V, 3 | 4] in [0, 1]
WRAP = "wrap"  # key in a mesh's metadata: the wrap modes of its texture, across and up
FARTHEST = 1e6  # larger texture coordinates are meaningless in single precision
REPEAT, CLAMP, MIRROR = 10497, 33071, 33648  # OpenGL's constants, also used by glTF


class MissingColourWarning(UserWarning, UserError):
    """A mesh file refers to a missing texture or material, or leaves a part without colour; also a `UserError`, which
    `warnings` can raise."""


def warn(path: Path, what: str, category: type[UserWarning] = UserWarning) -> None:
    """Warn of `what` is not drawn as specified in the mesh file `path`."""
    warnings.warn(f"{path}: {what}", category, stacklevel=3)


def find(name: str, folders: Iterable[Path]) -> Path | None:
    """Find the file that `name` in a mesh file refers to, below one of `folders`: as written, with backslashes, with
    `%20` for a space, with different letter case, or, as a last resort, by its last component alone."""
    spellings = [spelling.strip('"').replace("\\", "/") for spelling in (name, unquote(name))]
    for spelling in (*spellings, *(spelling.rpartition("/")[2] for spelling in spellings)):
        for folder in folders:
            if (found := _in_any_case(folder, spelling)) is not None:
                return found
    return None


def _in_any_case(folder: Path, name: str) -> Path | None:
    for part in PurePosixPath(name).parts:
        if not os.path.exists(folder / part) and os.path.isdir(folder):  # Path.exists raises for an invalid name
            part = next((each for each in sorted(os.listdir(folder)) if each.lower() == part.lower()), part)
        folder = folder / part
    return folder if os.path.isfile(folder) else None


def readable_image(data: bytes | None) -> bool:
    """Whether Pillow can read these bytes as an image."""
    try:
        with Image.open(io.BytesIO(data or b"")) as image:
            image.load()
    except Exception:  # its decoders raise any exception from OSError to struct.error
        return False
    return True


def warn_of_texture(path: Path, name: str) -> None:
    """Warn that a texture of the mesh file `path` cannot be drawn."""
    missing = f"its texture {name} is missing or not a readable image; what it covers is drawn without it"
    warn(path, missing, MissingColourWarning)


def texture_bytes(path: Path, name: str, folders: Iterable[Path]) -> bytes | None:
    """Read a texture of the mesh file `path`; None, after a warning, if it is not a readable image."""
    found = find(name, folders)
    data = None if found is None else found.read_bytes()
    if readable_image(data):
        return data
    warn_of_texture(path, name)
    return None


def load(kind: str, file: io.IOBase, files: dict[str, bytes | str], **options: Any) -> trimesh.Scene:
    """The scene that trimesh reads from an open file that may refer to `files`; vertices are not merged yet."""
    content = mesh_loaders[kind](file, resolver=ZipResolver(files), **options)
    for mesh in content.get("geometry", {"": content}).values():
        mesh["process"] = False
        if "visual" in mesh and hash(getattr(mesh["visual"], "material", None)) == hash(empty_material()):
            mesh["visual"].material = SimpleMaterial()  # replaces a grey texture
        for key in ("vertex_colors", "face_colors"):
            if mesh.get(key) is not None:
                mesh[key] = _eight_bit_levels(np.asarray(mesh[key]))
    return trimesh.load_scene(content)


def _eight_bit_levels(colours: NDArray[Any]) -> NDArray[np.uint8]:
    """Convert colours to 8 bits from 8 or 16 bits, or from numbers up to 1 or up to 255."""
    if colours.dtype == np.uint16:
        colours = colours / 257
    elif colours.dtype.kind == "f" and not (colours > 1.5).any():
        colours = colours * 255
    return np.rint(np.nan_to_num(colours).clip(0, 255)).astype(np.uint8)
