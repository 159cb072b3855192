"""The embedded objects: twelve procedural toys, so that the main job needs no download.

Every toy is a function, which builds its normalised scene in well under a second from `shapes` and `textures`; they are
in modules by ambiguity class. Toys with a front face +Z or drive towards +X.
"""

from __future__ import annotations

from lp_framework.data.meshes import MeshObject
from lp_framework.data.toy.continuous import celadon_bottle, lotus_vase, soup_can
from lp_framework.data.toy.twofold import juice_carton, suitcase, tram
from lp_framework.data.toy.unique import cottage, duck, fire_engine, robot, sailboat, watering_can

__all__ = ["toy_objects"]


def toy_objects() -> list[MeshObject]:
    """The embedded objects, each with its ambiguity class."""
    unique = [fire_engine, cottage, robot, sailboat, duck, watering_can]
    return [
        *(MeshObject(toy.__name__, "unique", toy) for toy in unique),
        *(MeshObject(toy.__name__, "twofold", toy) for toy in (tram, juice_carton, suitcase)),
        MeshObject("soup_can", "continuous", soup_can, unique_answer=True),  # its label tells the longitude
        MeshObject("lotus_vase", "continuous", lotus_vase),  # its pattern repeats 16 times
        MeshObject("celadon_bottle", "continuous", celadon_bottle),  # plain
    ]
