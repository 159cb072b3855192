"""Scanned objects as Google Scanned Objects and OmniObject3D are released: one painted box each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

# A box of 1 x 2 x 4 whose highest face is painted: u, v of a corner are 0.9 where its z is 4, else 0.1.
CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 2) for z in (0, 4)]
FACES = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]


def obj_text(material: str, order: tuple[int, int, int] = (0, 1, 2)) -> str:
    """The box as OBJ, its axes in another order."""
    lines = [f"mtllib {material}", "usemtl material_0"]
    lines += ["v " + " ".join(str(corner[axis]) for axis in order) for corner in CORNERS]
    lines += [f"vt {0.9 if z else 0.1} {0.9 if z else 0.1}" for *_, z in CORNERS]
    lines += ["f " + " ".join(f"{index}/{index}" for index in face.split()) for face in FACES]
    return "\n".join(lines) + "\n"


def texture() -> Image.Image:
    """Red where u and v are large (v runs upwards), blue elsewhere."""
    pixels = np.full((8, 8, 3), (0, 0, 255), np.uint8)
    pixels[:4, 4:] = (255, 0, 0)
    return Image.fromarray(pixels)


def write_gso(root: Path, *names: str) -> Path:
    """Objects as Google Scanned Objects are released: the material names a texture that lies elsewhere."""
    for name in names:
        for folder in ("meshes", "materials/textures", "thumbnails"):
            (root / name / folder).mkdir(parents=True)
        (root / name / "model.config").write_text("<model/>")
        (root / name / "model.sdf").write_text("<sdf/>")
        (root / name / "meshes" / "model.obj").write_text(obj_text("model.mtl"))
        (root / name / "meshes" / "model.mtl").write_text("newmtl material_0\nKd 1 1 1\nmap_Kd texture.png\n")
        texture().save(root / name / "materials" / "textures" / "texture.png")
    return root


def write_oo3d(root: Path, *names: str) -> Path:
    """Raw scans of OmniObject3D, +Y up: z, x, y of the box are x, y, z of the file in turn."""
    for name in names:
        folder = root / name.rpartition("_")[0] / name / "Scan"
        folder.mkdir(parents=True)
        (folder / "Scan.obj").write_text(obj_text("Scan.mtl", order=(1, 2, 0)))
        (folder / "Scan.mtl").write_text("newmtl material_0\nmap_Kd Scan.jpg\n")
        texture().save(folder / "Scan.jpg", quality=95)
    return root
