"""Scanned objects as their authors release them, rendered by the paper's protocol: GSO and OmniObject3D.

The paper takes the 70 objects of each that iFusion rendered, and 10 more of GSO that are not trained on; it publishes
no lists. Where iFusion's renderings are at hand (`renderings`), the seen objects are those in there; else the choice is
seeded. It is written to `objects.json` beside the views and read from there afterwards (see `object_lists`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from trimesh.resolvers import FilePathResolver

from lp_framework.data.meshes import MeshObject, load_scene, normalise
from lp_framework.data.rendering.renderer import Renderer
from lp_framework.data.rendering.views import ViewProtocol
from lp_framework.data.sets.object_lists import ObjectLists, drawn, kept_lists
from lp_framework.data.sources import RenderedData
from lp_framework.data.views import object_names
from lp_framework.errors import UserError
from lp_framework.registry import register

# x, y, z of a world with +Z up become Z, X, Y, as `real_cameras.z_up_to_y_up` has it for cameras.
_Z_UP_TO_Y_UP = np.eye(4)[[1, 2, 0, 3]]


class ScannedData(RenderedData):
    """Objects of a download, `seen` ones to train on and `unseen` ones to evaluate on; `objects` says which are in use.

    The views go to `views`, by default `datasets/` and the name of the `release`.
    """

    release: str

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
        latitude_step_degrees: float = 7.5,
        longitude_step_degrees: float = 15.0,
        workers: int | None = None,
        cache: str = "datasets/cache",
        image_size: int = 256,
        batch_pairs: int = 1024,
        block: int = 8,
        validation_views: int = 8,
        seed: int = 0,
    ) -> None:
        folder = views if views is not None else f"datasets/{self.release}"
        super().__init__(folder, cache, image_size, batch_pairs, block, validation_views, seed)
        self.meshes, self.renderings = Path(path), None if renderings is None else Path(renderings)
        self.seen, self.unseen, self.which, self.split_seed = seen, unseen, objects, split_seed
        self.renderer, self.workers = renderer, workers
        self.protocol = ViewProtocol(
            resolution=resolution,
            test_views=test_views,
            latitude_step_degrees=latitude_step_degrees,
            longitude_step_degrees=longitude_step_degrees,
        )

    def available(self) -> list[str]:
        """Names of the objects in the download; `UserError`, with the file looked for, where there are none."""
        raise NotImplementedError

    def file(self, name: str) -> Path:
        """The mesh of an object."""
        raise NotImplementedError

    def loader(self, name: str) -> Callable[[], trimesh.Scene]:
        """What loads an object's normalised scene, +Y up."""
        raise NotImplementedError

    def objects(self) -> list[MeshObject]:
        """The seen or unseen objects, sorted by name."""
        how = {
            "seen": self.seen,
            "unseen": self.unseen,
            "split_seed": self.split_seed,
            "renderings": None if self.renderings is None else self.renderings.name,
        }
        names = kept_lists(self.path, how, self._choose).named(self.which)
        return [MeshObject(name, "unlabelled", self.loader(name)) for name in names]

    def _choose(self) -> ObjectLists:
        available = self.available()
        if self.renderings is None:
            return drawn(available, self.seen, self.unseen, self.split_seed, self.meshes)
        seen = object_names(self.renderings)
        missing = sorted(set(seen) - set(available))
        if missing:
            raise UserError(
                f"{self.meshes}: {len(missing)} of the {len(seen)} objects of {self.renderings} are missing, such as "
                f"{self.file(missing[0])}"
            )
        if not self.unseen:
            return ObjectLists(seen, [])
        others = [name for name in available if name not in seen]
        return ObjectLists(seen, drawn(others, 0, self.unseen, self.split_seed, self.meshes).unseen)


@register("data", "gso")
class GSOData(ScannedData):
    """Google Scanned Objects, `<path>/<Object>/meshes/model.obj`; rendered into `views` on first use."""

    release = "gso"

    def available(self) -> list[str]:
        """Names of the folders with a mesh."""
        if not self.meshes.is_dir():
            raise UserError(f"{self.meshes}: there is no such folder; give data.path=FOLDER with the objects of GSO")
        names = sorted(file.parts[-3] for file in self.meshes.glob("*/meshes/model.obj"))
        if not names:
            raise UserError(f"{self.meshes}: holds no object of GSO; looked for {self.file('OBJECT')}")
        return names

    def file(self, name: str) -> Path:
        return self.meshes / name / "meshes" / "model.obj"

    def loader(self, name: str) -> Callable[[], trimesh.Scene]:
        return partial(load_gso, self.file(name))


@register("data", "oo3d")
class OO3DData(ScannedData):
    """OmniObject3D, `<path>/<category>/<category_001>/Scan/Scan.obj`; rendered into `views` on first use."""

    release = "oo3d"

    def available(self) -> list[str]:
        """Names of the objects with a scan: those of their folders, such as "dinosaur_002"."""
        if not self.meshes.is_dir():
            raise UserError(f"{self.meshes}: there is no such folder; give data.path=FOLDER, OmniObject3D's raw_scans")
        names = sorted(file.parts[-3] for file in self.meshes.glob("*/*/Scan/Scan.obj"))
        names = [name for name in names if self.file(name).is_file()]
        if not names:
            raise UserError(f"{self.meshes}: holds no scan of OmniObject3D; looked for {self.file('CATEGORY_001')}")
        return names

    def file(self, name: str) -> Path:
        return self.meshes / name.rpartition("_")[0] / name / "Scan" / "Scan.obj"

    def loader(self, name: str) -> Callable[[], trimesh.Scene]:
        return partial(load_scene, self.file(name))  # has +Y up


class _GSOFiles(FilePathResolver):
    """Finds what lies beside the mesh, and the texture where GSO has it; its material names it without the folder."""

    def __init__(self, mesh: Path, texture: Path) -> None:
        super().__init__(str(mesh))
        self.texture = texture

    def get(self, name: str) -> bytes:
        if Path(name).name == self.texture.name:
            return self.texture.read_bytes()
        content: bytes = super().get(name)
        return content


def load_gso(path: Path) -> trimesh.Scene:
    """The normalised scene of an object of GSO, turned from +Z up to +Y up.

    Raises `UserError` naming the file when the mesh or its texture is missing or does not load.
    """
    texture = path.parents[1] / "materials" / "textures" / "texture.png"
    for file in (path, texture):
        if not file.is_file():
            raise UserError(f"{file}: there is no such file; an object of GSO needs it")
    try:
        with path.open("rb") as opened:
            scene = trimesh.load_scene(opened, file_type="obj", resolver=_GSOFiles(path, texture))
        scene.apply_transform(_Z_UP_TO_Y_UP)
        return normalise(scene)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    except Exception as error:  # the parsers of trimesh raise anything from KeyError to struct.error
        raise UserError(f"{path}: does not load as a mesh ({type(error).__name__}: {error})") from error
