"""Sources that render meshes: the embedded objects, folders of meshes."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import trimesh

from lp_framework.data.meshes import MeshObject, load_scene
from lp_framework.data.reading import names_below
from lp_framework.data.rendering.renderer import Renderer
from lp_framework.data.rendering.views import ViewProtocol, render_objects
from lp_framework.data.sets.object_labels import Label, read_labels
from lp_framework.data.sets.object_lists import ObjectLists, drawn, kept_lists
from lp_framework.data.source import ViewSource
from lp_framework.data.toy import toy_objects
from lp_framework.data.views import ObjectViews, object_names
from lp_framework.errors import UserError
from lp_framework.registry import register


class RenderedData(ViewSource):
    """Views that are rendered from meshes on first use, into `path`, by a protocol with the settings `protocol`."""

    def __init__(self, renderer: Renderer, path: str | Path, workers: int | None, **protocol: Any) -> None:
        self.renderer, self.path, self.workers = renderer, Path(path), workers
        self.protocol = ViewProtocol(**protocol)

    @abstractmethod
    def objects(self) -> list[MeshObject]:
        """The objects to render."""

    def names(self) -> list[str]:
        return sorted(obj.name for obj in self.objects())

    def prepare(self) -> None:
        """Render what is missing. Meshes whose views are there are not loaded."""
        render_objects(self.objects(), self.path, self.protocol, self.renderer, self.workers, check_meshes=False)

    def render(self) -> None:
        """Render what is missing; the meshes of the others must be those that their views were made from."""
        render_objects(self.objects(), self.path, self.protocol, self.renderer, self.workers)

    def views(self, name: str, split: str) -> ObjectViews:
        """The views, with the label of the object where it has any, whatever the views were rendered with."""
        views, obj = super().views(name, split), self._by_name[name]
        if obj.ambiguity == "unlabelled":
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
    ) -> None:
        super().__init__(
            renderer, path, workers, resolution=resolution, test_views=test_views, train_views=train_views,
            latitude_step_degrees=latitude_step_degrees, longitude_step_degrees=longitude_step_degrees, depth=depth,
        )  # fmt: skip

    def objects(self) -> list[MeshObject]:
        """The embedded objects."""
        return toy_objects()


@register("data", "meshes")
class MeshData(RenderedData):
    """A folder of meshes, in any formats that trimesh reads; rendered into `views`.

    `unseen` of its objects are kept from training; `objects` says whether these or the others are in use. `labels` is
    a YAML file with their ambiguity classes (see `object_labels`).
    """

    seen: int | None = None  # how many there are to train on, all but the unseen ones by default
    renderings: Path | None = None  # a folder of views of those to train on, which are drawn by default

    def __init__(
        self,
        renderer: Renderer,
        path: str,
        views: str | None = None,
        labels: str | None = None,
        unseen: int = 0,
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
        self.meshes, self.labels = Path(path), None if labels is None else Path(labels)
        self.unseen, self.which, self.split_seed = unseen, objects, split_seed
        super().__init__(
            renderer, views or f"datasets/{self.meshes.resolve().name}", workers, resolution=resolution,
            test_views=test_views, train_views=train_views, latitude_step_degrees=latitude_step_degrees,
            longitude_step_degrees=longitude_step_degrees, depth=depth,
        )  # fmt: skip

    def objects(self) -> list[MeshObject]:
        """The objects in use, sorted by name (see `object_lists`)."""
        if self.seen is None and not self.unseen and self.which == "seen":
            return [self.object(name) for name in self.available()]
        how = {key: getattr(self, key) for key in ("seen", "unseen", "split_seed")}
        how["renderings"] = None if self.renderings is None else self.renderings.name
        return [self.object(name) for name in kept_lists(self.path, how, self._choose).named(self.which)]

    def _choose(self) -> ObjectLists:
        available = self.available()
        if self.renderings is None:
            return drawn(available, self.seen, self.unseen, self.split_seed, self.meshes)
        seen = object_names(self.renderings)
        if missing := sorted({*seen} - {*available}):
            of_these = f"{len(missing)} of the {len(seen)} objects of {self.renderings}"
            raise UserError(f"{self.meshes}: {of_these} are missing, such as {missing[0]}")
        others = [name for name in available if name not in seen]
        unseen = drawn(others, 0, self.unseen, self.split_seed, self.meshes).unseen if self.unseen else []
        return ObjectLists(seen, unseen)

    def available(self) -> list[str]:
        """Names of the objects in the folder; `UserError`, with the files looked for, where there are none."""
        return list(self._files)

    def object(self, name: str) -> MeshObject:
        """The object of a name."""
        load = partial(load_scene, self._files.get(name, self.meshes / name))
        if label := self._labels.get(name):
            return MeshObject(name, label.ambiguity, load, label.unique_answer)
        return MeshObject(name, "unlabelled", load)

    @cached_property
    def _files(self) -> dict[str, Path]:
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
        return {} if self.labels is None else read_labels(self.labels, self._files, self.meshes)
