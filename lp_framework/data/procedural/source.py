"""`data=procedural`: as many objects as are asked for, rendered on first use."""

from __future__ import annotations

from lp_framework.data.meshes import MeshObject
from lp_framework.data.procedural.objects import procedural_object
from lp_framework.data.rendering.renderer import Renderer
from lp_framework.data.sets.rendered import RenderedData
from lp_framework.errors import at_least
from lp_framework.registry import register


@register("data", "procedural")
class ProceduralData(RenderedData):
    """Textured household objects without end, made by this package; those of another `objects_seed` are all others."""

    def __init__(
        self,
        renderer: Renderer,
        path: str = "datasets/procedural",
        objects: int = 500,
        objects_seed: int = 0,
        resolution: int = 256,
        test_views: int = 8,
        train_views: int = 16,
        lowest_latitude_degrees: float = -30.0,
        highest_latitude_degrees: float = 30.0,
        field_of_view_range: list[float] | None = None,
        depth: bool = False,
        workers: int | None = None,
    ) -> None:
        at_least(1, "data", objects=objects)
        at_least(0, "data", objects_seed=objects_seed)
        self.count, self.seed = objects, objects_seed
        super().__init__(
            renderer, path, workers, resolution=resolution, test_views=test_views, train_views=train_views,
            lowest_latitude_degrees=lowest_latitude_degrees, highest_latitude_degrees=highest_latitude_degrees,
            field_of_view_range=field_of_view_range, depth=depth,
        )  # fmt: skip

    def objects(self) -> list[MeshObject]:
        """The first objects of the seed, named after their family, the seed and their number."""
        return [procedural_object(self.seed, index) for index in range(self.count)]
