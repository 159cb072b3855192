"""Scanned objects as their authors release them, rendered by the paper's protocol: GSO and OmniObject3D.

The paper takes the 70 objects of each that iFusion rendered, and 10 more of GSO that are not trained on; it publishes
no lists. Where iFusion's renderings are at hand (`renderings`), the seen objects are those in there; else the choice is
seeded. It is written to `objects.json` beside the views and read from there afterwards (see `object_lists`).
"""

from __future__ import annotations

import io
from abc import abstractmethod
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import trimesh
from trimesh.resolvers import ZipResolver

from lp_framework.data.meshes import MeshObject, load_scene, normalise
from lp_framework.data.reading import expecting, names_below
from lp_framework.data.rendering.renderer import Renderer
from lp_framework.data.sets.rendered import MeshData
from lp_framework.errors import UserError
from lp_framework.registry import register

# x, y, z of a world with +Z up become Z, X, Y, as `real_cameras.z_up_to_y_up` has it for cameras.
_Z_UP_TO_Y_UP = np.eye(4)[[1, 2, 0, 3]]


class ScannedData(MeshData):
    """Objects of a download, rendered into `views`, by default `datasets/` and the name of the `release`."""

    release: ClassVar[str]
    what: ClassVar[str]  # there is in the download
    layout: ClassVar[str]  # where the mesh of an object is, two folders below the one that has its name

    def __init__(
        self,
        renderer: Renderer,
        path: str,
        views: str | None = None,
        renderings: str | None = None,
        seen: int = 70,
        unseen: int = 10,
        objects: Literal["seen", "unseen"] = "seen",
        split_seed: int = 0,
        resolution: int = 512,
        test_views: int = 8,
        train_views: int | None = None,
        latitude_step_degrees: float = 7.5,
        longitude_step_degrees: float = 15.0,
        depth: bool = False,
        workers: int | None = None,
    ) -> None:
        super().__init__(
            renderer, path, views or f"datasets/{self.release}", None, unseen, objects, split_seed, resolution,
            test_views, train_views, latitude_step_degrees, longitude_step_degrees, depth, workers,
        )  # fmt: skip
        self.seen, self.renderings = seen, None if renderings is None else Path(renderings)

    def file(self, name: str) -> Path:
        """The mesh of an object."""
        return self.meshes / self.layout.format(name=name, category=name.rpartition("_")[0])

    @staticmethod
    @abstractmethod
    def load(path: Path) -> trimesh.Scene:
        """An object's normalised scene, +Y up."""

    def available(self) -> list[str]:
        pattern = self.layout.format(name="*", category="*")
        names = (file.parts[-3] for file in self.meshes.glob(pattern))
        sound = (name for name in names if self.file(name).is_file())
        return names_below(self.meshes, sound, self.what, self.meshes / pattern)

    def object(self, name: str) -> MeshObject:
        return MeshObject(name, "unlabelled", partial(self.load, self.file(name)))


def load_gso(path: Path) -> trimesh.Scene:
    """The normalised scene of an object of GSO, turned from +Z up to +Y up.

    Raises `UserError` naming the file when the mesh or its texture is missing or does not load.
    """
    texture = path.parents[1] / "materials" / "textures" / "texture.png"
    for file in (path, texture):
        if not file.is_file():
            raise UserError(f"{file}: there is no such file; an object of GSO needs it")
    with expecting(f"{path}: does not load as a mesh"), path.open("rb") as opened:
        # The material names its texture without the folder.
        files = {file.name: io.BytesIO(file.read_bytes()) for file in (*path.parent.glob("*.mtl"), texture)}
        scene = trimesh.load_scene(opened, file_type="obj", resolver=ZipResolver(files))
        scene.apply_transform(_Z_UP_TO_Y_UP)
        return normalise(scene)


@register("data", "gso")
class GSOData(ScannedData):
    """Google Scanned Objects, `<path>/<Object>/meshes/model.obj`; rendered into `views` on first use."""

    release, what, layout = "gso", "objects of GSO", "{name}/meshes/model.obj"
    load = staticmethod(load_gso)


@register("data", "oo3d")
class OO3DData(ScannedData):
    """OmniObject3D, `<path>/<category>/<category_001>/Scan/Scan.obj`; rendered into `views` on first use."""

    release, what, layout = "oo3d", "scans of OmniObject3D", "{category}/{name}/Scan/Scan.obj"
    load = staticmethod(load_scene)  # has +Y up
