"""The families of objects, the object for a given seed and index, and the choice `data=procedural`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import trimesh
from numpy.random import Generator

from lp_framework.data.meshes import Ambiguity, MeshObject
from lp_framework.data.procedural import crockery, furniture, groceries, things
from lp_framework.data.procedural.shapes import Parts
from lp_framework.data.procedural.solids import scene
from lp_framework.data.procedural.textures import pick
from lp_framework.data.rendering.renderer import Renderer
from lp_framework.data.sets.rendered import RenderedData
from lp_framework.errors import at_least
from lp_framework.registry import register


@dataclass(frozen=True)
class Family:
    """Objects of one kind, built from a generator by `build`, and one ambiguity class, which holds by construction.
    `share` is the weight relative to other families."""

    name: str
    build: Callable[[Generator], Parts]
    share: float
    ambiguity: Ambiguity = "unique"
    unique_answer: bool = True


FAMILIES = (
    Family("box", groceries.printed_box, 12, "twofold"),
    Family("box_alike", partial(groceries.printed_box, alike=True), 1, "twofold", False),
    Family("carton", groceries.carton, 4, "twofold"),
    Family("flat_bottle", partial(groceries.bottle, flat=True), 6, "twofold"),
    Family("bottle", partial(groceries.bottle, flat=False, resolved=True), 3, "continuous"),
    Family("plain_bottle", partial(groceries.bottle, flat=False, resolved=False), 2, "continuous", False),
    Family("tin", partial(groceries.tin, resolved=True), 6, "continuous"),
    Family("plain_tin", partial(groceries.tin, resolved=False), 1, "continuous", False),
    Family("square_tin", partial(groceries.tin, resolved=True, exponent=6.0), 2, "twofold"),
    Family("pouch", groceries.pouch, 3, "twofold"),
    Family("paste", groceries.paste_tube, 2),
    Family("jug", groceries.jug, 4),
    Family("mug", crockery.mug, 7),
    Family("bowl", partial(crockery.bowl, resolved=True), 2, "continuous"),
    Family("plain_bowl", partial(crockery.bowl, resolved=False), 2, "continuous", False),
    Family("vase", partial(crockery.vase, resolved=True), 1.5, "continuous"),
    Family("plain_vase", partial(crockery.vase, resolved=False), 1, "continuous", False),
    Family("pan", crockery.pan, 3),
    Family("pot", crockery.pot, 1, "twofold", False),
    Family("teapot", crockery.teapot, 4),
    Family("cutlery", crockery.cutlery, 2),
    Family("cabinet", furniture.cabinet, 5),
    Family("table", partial(furniture.table, alike=True), 1, "twofold", False),
    Family("desk", partial(furniture.table, alike=False), 2),
    Family("chair", furniture.chair, 3),
    Family("sofa", furniture.sofa, 1.5),
    Family("rack", furniture.rack, 3),
    Family("crate", partial(furniture.container, alike=True), 1, "twofold", False),
    Family("caddy", partial(furniture.container, alike=False), 3),
    Family("lamp", furniture.lamp, 2),
    Family("tap", furniture.tap, 1.5),
    Family("book", things.book, 4),
    Family("tool", things.tool, 4),
    Family("plush", things.plush, 4),
    Family("vehicle", things.vehicle, 3),
    Family("appliance", things.appliance, 3),
    Family("shoe", things.shoe, 1.5),
    Family("bag", things.bag, 2),
    Family("composition", things.composition, 6),
)
GOLDEN, SILVER = (5**0.5 - 1) / 2, 2**0.5 - 1


def procedural_object(seed: int, index: int) -> MeshObject:
    """Object `index` of `seed`, named after its family and both numbers; independent of the other objects."""
    family = family_of(seed, index)
    name = f"{family.name}_{seed}_{index:05d}"
    return MeshObject(name, family.ambiguity, partial(procedural_scene, seed, index), family.unique_answer)


def family_of(seed: int, index: int) -> Family:
    """The family of an object. Multiples of the golden ratio spread families evenly for any number of objects."""
    ends = np.cumsum([family.share for family in FAMILIES])
    place = (index * GOLDEN + seed * SILVER) % 1 * ends[-1]
    return FAMILIES[int(np.searchsorted(ends, place, side="right"))]


def procedural_scene(seed: int, index: int) -> trimesh.Scene:
    """The normalised scene of an object: half face +Z, the others a random direction; each has its own lighting."""
    random = np.random.default_rng([seed, index])
    parts = family_of(seed, index).build(random)
    heading = pick(random, (0.0, random.uniform(0, 360)))
    light = random.uniform(0.7, 1.0) * random.uniform(0.9, 1.0, 3)  # brightness and tint
    return scene(*(shape.turn("y", heading).paint(texture, light) for shape, texture in parts))


@register("data", "procedural")
class ProceduralData(RenderedData):
    """An unlimited supply of generated, textured household objects; each `objects_seed` gives different ones."""

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
        """The first objects of the seed, named after their family, the seed and their index."""
        return [procedural_object(self.seed, index) for index in range(self.count)]
