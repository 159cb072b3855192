"""The data sets by name: the embedded objects, a folder of meshes, a folder of views."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Literal

import trimesh

from lp_framework.data.meshes import MeshObject, load_scene
from lp_framework.data.module import PairDataModule
from lp_framework.data.rendering.renderer import Renderer
from lp_framework.data.rendering.views import ViewProtocol, render_objects
from lp_framework.data.sets.object_labels import Label, read_labels
from lp_framework.data.sets.object_lists import drawn, kept_lists
from lp_framework.data.toy import toy_objects
from lp_framework.data.views import ObjectViews
from lp_framework.errors import UserError
from lp_framework.registry import register


class RenderedData(PairDataModule):
    """Views that are rendered from meshes on first use, by the paper's protocol."""

    renderer: Renderer
    protocol: ViewProtocol
    workers: int | None

    def objects(self) -> list[MeshObject]:
        """The objects to render."""
        raise NotImplementedError

    def names(self) -> list[str]:
        """The objects of this data set alone, whatever else has been rendered into `path`."""
        return sorted(obj.name for obj in self.objects())

    def prepare_data(self) -> None:
        """Render what is missing, then as every data set. Meshes whose views are there are not loaded."""
        render_objects(self.objects(), self.path, self.protocol, self.renderer, self.workers, check_meshes=False)
        super().prepare_data()

    def render(self) -> None:
        """Render the objects that are not there yet; the meshes of the others must be those they were made from."""
        render_objects(self.objects(), self.path, self.protocol, self.renderer, self.workers)

    def _on_disk(self, split: str) -> list[ObjectViews]:
        """The views, with the labels of the objects where these have any, whatever the views were rendered with."""
        labelled = {obj.name: obj for obj in self.objects() if obj.ambiguity != "unlabelled"}
        return [
            replace(views, ambiguity=obj.ambiguity, unique_answer=obj.unique_answer)
            if (obj := labelled.get(views.name))
            else views
            for views in super()._on_disk(split)
        ]


@register("data", "toy")
class ToyData(RenderedData):
    """Twelve embedded objects that this package makes: six unique, three twofold, three continuous."""

    def __init__(
        self,
        renderer: Renderer,
        path: str = "datasets/toy",
        resolution: int = 256,
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
        super().__init__(path, cache, image_size, batch_pairs, block, validation_views, seed)
        self.renderer, self.workers = renderer, workers
        self.protocol = ViewProtocol(
            resolution=resolution,
            test_views=test_views,
            latitude_step_degrees=latitude_step_degrees,
            longitude_step_degrees=longitude_step_degrees,
        )

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
        self.meshes, self.labels = Path(path), None if labels is None else Path(labels)
        folder = views if views is not None else f"datasets/{self.meshes.resolve().name}"
        super().__init__(folder, cache, image_size, batch_pairs, block, validation_views, seed)
        self.unseen, self.which, self.split_seed = unseen, objects, split_seed
        self.renderer, self.workers = renderer, workers
        self.protocol = ViewProtocol(
            resolution=resolution,
            test_views=test_views,
            latitude_step_degrees=latitude_step_degrees,
            longitude_step_degrees=longitude_step_degrees,
        )

    def objects(self) -> list[MeshObject]:
        """One object a mesh file, named after it, sorted by name; of a divided folder the seen or the unseen ones."""
        files = self._files
        if self.unseen or self.which == "unseen":
            names = [file.stem for file in files]
            lists = kept_lists(
                self.path,
                {"unseen": self.unseen, "split_seed": self.split_seed},
                lambda: drawn(names, None, self.unseen, self.split_seed, self.meshes),
            )
            files = [file for file in files if file.stem in lists.named(self.which)]
        return [self._object(file) for file in files]

    def _object(self, file: Path) -> MeshObject:
        label = self._labels.get(file.stem, Label("unlabelled"))
        return MeshObject(file.stem, label.ambiguity, partial(load_scene, file), label.unique_answer)

    @cached_property
    def _files(self) -> list[Path]:
        if not self.meshes.is_dir():
            raise UserError(f"{self.meshes}: there is no such folder of meshes; give data.path=FOLDER")
        formats = {f".{suffix}" for suffix in trimesh.available_formats()}
        files = sorted(file for file in self.meshes.iterdir() if file.suffix.lower() in formats and file.name[0] != ".")
        if not files:
            raise UserError(f"{self.meshes}: holds no mesh file (known formats: {', '.join(sorted(formats))})")
        return files

    @cached_property
    def _labels(self) -> dict[str, Label]:
        return {} if self.labels is None else read_labels(self.labels, {file.stem for file in self._files}, self.meshes)


@register("data", "renderings")
class RenderingsData(PairDataModule):
    """A folder of views in iFusion's layout, such as its published renderings of GSO and OO3D."""

    def __init__(
        self,
        path: str,
        cache: str = "datasets/cache",
        image_size: int = 256,
        batch_pairs: int = 1024,
        block: int = 8,
        validation_views: int = 8,
        seed: int = 0,
    ) -> None:
        super().__init__(path, cache, image_size, batch_pairs, block, validation_views, seed)
