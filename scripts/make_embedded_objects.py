"""Rebuild the embedded objects: lp_framework/data/toy/NAME.npz, read by `lp_framework.data.toy`."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import trimesh
from embedded_objects import TOYS
from numpy.typing import NDArray

FOLDER = Path(__file__).parents[1] / "lp_framework" / "data" / "toy"


def packed(scene: trimesh.Scene) -> dict[str, NDArray]:
    """The arrays of a scene whose meshes all have textures; a shared texture is stored once."""
    meshes, textures = list(scene.geometry.values()), []
    parts = []
    for mesh in meshes:
        image = mesh.visual.material.baseColorTexture
        if image not in textures:
            textures.append(image)
        parts.append((len(mesh.vertices), len(mesh.faces), textures.index(image)))
    faces = np.concatenate([mesh.faces for mesh in meshes])
    arrays = {
        "parts": np.array(parts, np.int32),
        "vertices": np.concatenate([mesh.vertices for mesh in meshes]),
        "uv": np.concatenate([mesh.visual.uv for mesh in meshes]),
        "face_steps": np.diff(faces, axis=0, prepend=0).astype(np.int32),
    }
    for index, image in enumerate(textures):
        encoded = io.BytesIO()
        image.save(encoded, "webp", lossless=True, quality=100, method=6)
        arrays[f"texture_{index}"] = np.frombuffer(encoded.getbuffer(), np.uint8)
    return arrays


def main() -> None:
    """Write the objects; the files are reproducible."""
    for name, make in TOYS.items():
        file = FOLDER / f"{name}.npz"
        with zipfile.ZipFile(file, "w") as archive:
            for key, array in packed(make()).items():
                content = io.BytesIO()
                np.save(content, array)
                entry = zipfile.ZipInfo(f"{key}.npy")  # dated 1980, for reproducible files
                how = zipfile.ZIP_STORED if key.startswith("texture") else zipfile.ZIP_LZMA
                archive.writestr(entry, content.getvalue(), how)
        print(f"{file}: {file.stat().st_size / 1000:.0f} KB")


if __name__ == "__main__":
    main()
