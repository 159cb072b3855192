"""Sources that render meshes: the embedded objects, folders of meshes, and scans as released by their authors.

Of GSO and OmniObject3D the paper uses the 70 objects each that iFusion rendered, and 10 more, held out, of GSO. If
iFusion's renderings are available (`renderings`), the seen objects are theirs; otherwise they are drawn.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import trimesh
import yaml
from PIL import Image
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from lp_framework.data.files import ObjectLists, Origin, chosen, drawn, expecting, kept_lists, listed, names_below
from lp_framework.data.mesh_files.common import MissingColourWarning
from lp_framework.data.meshes import MeshObject, load_scene
from lp_framework.data.rendering.renderer import Renderer
from lp_framework.data.rendering.views import ViewProtocol, render_objects
from lp_framework.data.toy import toy_objects
from lp_framework.data.views import ObjectViews, RenderingsData, ViewSource
from lp_framework.errors import UserError, nearest
from lp_framework.registry import register


class Label(BaseModel):
    """An object's ambiguity class and whether a view of it has one correct longitude (None: as in `MeshObject`)."""

    model_config = ConfigDict(extra="forbid")

    ambiguity: Literal["unique", "twofold", "continuous"]
    unique_answer: bool | None = None
    reason: str | None = None


UNLABELLED = Label.model_construct(ambiguity="unlabelled")  # not allowed in files


def read_labels(path: Path, names: Collection[str], where: Path) -> dict[str, Label]:
    """Read the labels in a YAML file, by object; `names` are the objects in the folder `where`.

        bbq_sauce: {ambiguity: continuous, unique_answer: true, reason: "a bottle; its label is on one side"}
        butter: {ambiguity: twofold, reason: "a box that says something else on each side"}

    Warns of objects missing from the file, which stay unlabelled. `UserError` naming the file and object for a missing
    file, invalid YAML, an object not in the folder, or an invalid label.
    """
    with expecting(f"{path}: is not readable YAML"):
        # Strings only: names such as 42 and 007 stay as written.
        content = yaml.load(path.read_text(encoding="utf-8"), yaml.BaseLoader)
    if not isinstance(content, dict):
        raise UserError(f"{path}: must give every object its label, as in 'mug: {{ambiguity: unique}}'")
    for name in content:
        if name not in names:
            raise UserError(f"{path}: {where} has no object '{name}'{nearest(name, names)}")
    try:
        labels = TypeAdapter(dict[str, Label]).validate_python(content)
    except ValidationError as error:
        first = error.errors()[0]
        name, *keys = (str(each) for each in first["loc"])
        raise UserError(
            f"{path}: object '{name}': {': '.join([*keys, first['msg']])}, got {first['input']!r}"
        ) from error
    if left_out := sorted(set(names) - set(labels)):
        warnings.warn(f"{path}: has no label for {listed(left_out)}", stacklevel=2)
    return labels


class RenderedData(ViewSource):
    """Views in `path` that are rendered from meshes on first use, by a protocol with the settings `protocol`."""

    labels: Path | None = None  # a file with the objects' ambiguity classes

    def __init__(self, renderer: Renderer, path: str | Path, workers: int | None, **protocol: Any) -> None:
        self.renderer, self.path, self.workers = renderer, Path(path), workers
        self.protocol = ViewProtocol(**protocol)

    @abstractmethod
    def objects(self) -> list[MeshObject]:
        """The objects to render."""

    def names(self) -> list[str]:
        return sorted(obj.name for obj in self.objects())

    def prepare(self, check_meshes: bool = False) -> None:
        """Render missing views; existing ones must match the available files or, with `check_meshes`, their meshes."""
        render_objects(self.objects(), self.path, self.protocol, self.renderer, self.workers, check_meshes)

    def views(self, name: str, split: str) -> ObjectViews:
        """The views with the object's current label; with the label they were rendered with if it has none."""
        views, obj = super().views(name, split), self._by_name[name]
        if obj.ambiguity == "unlabelled" and self.labels is None:
            return views
        return replace(views, ambiguity=obj.ambiguity, unique_answer=obj.unique_answer)

    @cached_property
    def _by_name(self) -> dict[str, MeshObject]:
        return {obj.name: obj for obj in self.objects()}


@register("data", "toy")
class ToyData(RenderedData):
    """Twelve embedded objects that ship with this package: six unique, three twofold, three continuous."""

    def __init__(
        self,
        renderer: Renderer,
        path: str = "datasets/toy",
        resolution: int = 256,
        test_views: int = 8,
        train_views: int | None = None,
        latitude_step_degrees: float = 7.5,
        longitude_step_degrees: float = 15.0,
        depth: bool = False,
        workers: int | None = None,
        objects: str | Sequence[str] | None = None,
    ) -> None:
        super().__init__(
            renderer, path, workers, resolution=resolution, test_views=test_views, train_views=train_views,
            latitude_step_degrees=latitude_step_degrees, longitude_step_degrees=longitude_step_degrees, depth=depth,
        )  # fmt: skip
        self.wanted = objects

    def objects(self) -> list[MeshObject]:
        every = {obj.name: obj for obj in toy_objects()}
        return [every[name] for name in chosen([*every], self.wanted, "data=toy")]


@register("data", "meshes")
class MeshData(RenderedData):
    """A folder of meshes in any format that trimesh reads, rendered into `views`.

    `unseen` of its objects are held out from training; `objects` selects these or the others, or names individual
    objects. `labels` is a YAML file with their ambiguity classes (see `read_labels`). The axis `up` of the files
    becomes our +Y.
    """

    seen: int | None = None  # number of training objects, by default all except the unseen ones
    renderings: Path | None = None  # a folder of views of the training objects, which are drawn by default

    def __init__(
        self,
        renderer: Renderer,
        path: str,
        views: str | None = None,
        labels: str | None = None,
        up: Literal["y", "z"] = "y",
        unseen: int = 0,
        objects: str | Sequence[str] = "seen",
        split_seed: int = 0,
        resolution: int = 512,
        test_views: int = 8,
        train_views: int | None = None,
        latitude_step_degrees: float = 7.5,
        longitude_step_degrees: float = 15.0,
        depth: bool = False,
        workers: int | None = None,
    ) -> None:
        self.meshes, self.labels = Path(path), None if labels is None else Path(labels)
        self.up, self.unseen, self.wanted, self.split_seed = up, unseen, objects, split_seed
        super().__init__(
            renderer, views or f"datasets/{self.meshes.resolve().name}", workers, resolution=resolution,
            test_views=test_views, train_views=train_views, latitude_step_degrees=latitude_step_degrees,
            longitude_step_degrees=longitude_step_degrees, depth=depth,
        )  # fmt: skip

    def objects(self) -> list[MeshObject]:
        """The selected objects, sorted by name; for seen and unseen ones see `kept_lists`."""
        if self.wanted not in ("seen", "unseen"):
            names = chosen([*self.files, "seen", "unseen"], self.wanted, self.meshes)
            return [self._object(name) for name in names]
        if self.seen is None and not self.unseen and self.wanted == "seen":
            return [self._object(name) for name in self.files]
        how = {key: getattr(self, key) for key in ("seen", "unseen", "split_seed")}
        how["renderings"] = None if self.renderings is None else self.renderings.name
        lists = kept_lists(self.path, how, self._choose)
        names = lists.unseen if self.wanted == "unseen" else lists.seen
        if not names:
            raise UserError(f"data.objects={self.wanted}: there are none; set data.unseen to their number")
        return [self._object(name) for name in names]

    def _choose(self) -> ObjectLists:
        if self.renderings is None:
            return drawn([*self.files], self.seen, self.unseen, self.split_seed, self.meshes)
        seen = RenderingsData(str(self.renderings)).names()
        if missing := sorted({*seen} - {*self.files}):
            of_these = f"{len(missing)} of the {len(seen)} objects of {self.renderings}"
            raise UserError(f"{self.meshes}: {of_these} are missing, such as {missing[0]}")
        others = [name for name in self.files if name not in seen]
        unseen = drawn(others, 0, self.unseen, self.split_seed, self.meshes).unseen if self.unseen else []
        return ObjectLists(seen, unseen)

    def loader(self, file: Path) -> Callable[[], trimesh.Scene]:
        """The function that loads a mesh."""
        return partial(load_scene, file, self.up)

    def origin(self, file: Path) -> Origin:
        """A mesh, beside the materials, buffers and images that any mesh in the folder may use."""
        return Origin([file], self._beside, self.up)

    @cached_property
    def _beside(self) -> Origin:
        return Origin(self._parts(self.meshes))

    def _parts(self, folder: Path) -> list[Path]:
        """The files in a folder that meshes may refer to."""
        suffixes, views = {".mtl", ".bin", *Image.registered_extensions()}, self.path.resolve()
        found = (file for file in folder.resolve().rglob("*") if file.suffix.lower() in suffixes and file.is_file())
        return sorted(file for file in found if not file.is_relative_to(views) and file.name[0] != ".")

    def _object(self, name: str) -> MeshObject:
        file, label = self.files.get(name, self.meshes / name), self._labels.get(name, UNLABELLED)
        origin = self.origin(file) if file.is_file() else None
        return MeshObject(name, label.ambiguity, self.loader(file), label.unique_answer, origin)

    @cached_property
    def files(self) -> dict[str, Path]:
        """The meshes in the folder by object; `UserError`, with the expected files, if there are none."""
        formats = sorted(f".{suffix}" for suffix in trimesh.available_formats())
        names = (f.name for f in self.meshes.glob("*") if f.suffix.lower() in formats and f.name[0] != ".")
        files: dict[str, Path] = {}
        for name in names_below(self.meshes, names, "meshes", ", ".join(formats)):
            file = self.meshes / name
            if files.setdefault(file.stem, file) != file:
                raise UserError(f"{self.meshes}: several objects have the same name: {file.stem}")
        return files

    @cached_property
    def _labels(self) -> dict[str, Label]:
        return {} if self.labels is None else read_labels(self.labels, self.files, self.meshes)


class ScannedData(MeshData):
    """Objects of a download, rendered into `views`, by default `datasets/` and the name of the `release`."""

    release: ClassVar[str]
    what: ClassVar[str]  # the kind of objects in the download
    layout: ClassVar[str]  # glob of the meshes, each two folders below the one named after its object
    axis: ClassVar[Literal["y", "z"]] = "y"  # the up axis

    def __init__(
        self,
        renderer: Renderer,
        path: str,
        views: str | None = None,
        renderings: str | None = None,
        seen: int = 70,
        unseen: int = 10,
        objects: str | Sequence[str] = "seen",
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
            renderer, path, views or f"datasets/{self.release}", None, self.axis, unseen, objects, split_seed,
            resolution, test_views, train_views, latitude_step_degrees, longitude_step_degrees, depth, workers,
        )  # fmt: skip
        self.seen, self.renderings = seen, None if renderings is None else Path(renderings)

    def loader(self, file: Path) -> Callable[[], trimesh.Scene]:
        return partial(load_scan, file, self.up)

    @cached_property
    def files(self) -> dict[str, Path]:
        found = {file.parts[-3]: file for file in self.meshes.glob(self.layout)}
        return {name: found[name] for name in names_below(self.meshes, found, self.what, self.meshes / self.layout)}

    def origin(self, file: Path) -> Origin:
        """A mesh and the other files in its object's folder."""
        return Origin([file, *self._parts(file.parents[1])])


def load_scan(path: Path, up: Literal["y", "z"]) -> trimesh.Scene:
    """Load a scan by `load_scene`; `UserError` if its material or texture is missing.

    GSO's materials name their textures without the folder in which they are released.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", MissingColourWarning)
        return load_scene(path, up, [path.parents[1] / "materials" / "textures"])


@register("data", "gso")
class GSOData(ScannedData):
    """Google Scanned Objects, `<path>/<Object>/meshes/model.obj`, +Z up; rendered into `views` on first use."""

    release, what, layout, axis = "gso", "objects of GSO", "*/meshes/model.obj", "z"


@register("data", "oo3d")
class OO3DData(ScannedData):
    """OmniObject3D, `<path>/<category>/<category_001>/Scan/Scan.obj`; rendered into `views` on first use."""

    release, what, layout = "oo3d", "scans of OmniObject3D", "*/*/Scan/Scan.obj"
