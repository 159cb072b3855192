"""Sources that render meshes: the embedded objects, a folder of meshes."""

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
from lp_framework.data.sets.object_lists import drawn, kept_lists
from lp_framework.data.source import ViewSource
from lp_framework.data.toy import toy_objects
from lp_framework.data.views import ObjectViews
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
        """One object a mesh file, named after it, sorted by name; of a divided folder the seen or the unseen ones."""
        files = self._files
        if self.unseen or self.which == "unseen":
            names = [file.stem for file in files]
            how = {"unseen": self.unseen, "split_seed": self.split_seed}
            lists = kept_lists(self.path, how, lambda: drawn(names, None, self.unseen, self.split_seed, self.meshes))
            chosen = lists.named(self.which)
            files = [file for file in files if file.stem in chosen]
        return [self._object(file) for file in files]

    def _object(self, file: Path) -> MeshObject:
        label = self._labels.get(file.stem, Label("unlabelled"))
        return MeshObject(file.stem, label.ambiguity, partial(load_scene, file), label.unique_answer)

    @cached_property
    def _files(self) -> list[Path]:
        formats = sorted(f".{suffix}" for suffix in trimesh.available_formats())
        files = (f.name for f in self.meshes.glob("*") if f.suffix.lower() in formats and f.name[0] != ".")
        return [self.meshes / name for name in names_below(self.meshes, files, "meshes", ", ".join(formats))]

    @cached_property
    def _labels(self) -> dict[str, Label]:
        return {} if self.labels is None else read_labels(self.labels, {file.stem for file in self._files}, self.meshes)
