"""The embedded objects: twelve procedural toys, so that the main job needs no download.

Every toy is a module with one function, which builds its normalised scene in well under a second from `shapes` and
`textures`. Toys with a front face +Z or drive towards +X.
"""

from __future__ import annotations

from lp_framework.data.meshes import MeshObject
from lp_framework.data.toy.celadon_bottle import celadon_bottle
from lp_framework.data.toy.cottage import cottage
from lp_framework.data.toy.duck import duck
from lp_framework.data.toy.fire_engine import fire_engine
from lp_framework.data.toy.juice_carton import juice_carton
from lp_framework.data.toy.lotus_vase import lotus_vase
from lp_framework.data.toy.robot import robot
from lp_framework.data.toy.sailboat import sailboat
from lp_framework.data.toy.soup_can import soup_can
from lp_framework.data.toy.suitcase import suitcase
from lp_framework.data.toy.tram import tram
from lp_framework.data.toy.watering_can import watering_can

__all__ = ["toy_objects"]


def toy_objects() -> list[MeshObject]:
    """The embedded objects, each with its ambiguity class."""
    return [
        MeshObject("fire_engine", "unique", fire_engine),
        MeshObject("cottage", "unique", cottage),
        MeshObject("robot", "unique", robot),
        MeshObject("sailboat", "unique", sailboat),
        MeshObject("duck", "unique", duck),
        MeshObject("watering_can", "unique", watering_can),
        MeshObject("tram", "twofold", tram),
        MeshObject("juice_carton", "twofold", juice_carton),
        MeshObject("suitcase", "twofold", suitcase),
        MeshObject("soup_can", "continuous", soup_can, unique_answer=True),  # its label tells the longitude
        MeshObject("lotus_vase", "continuous", lotus_vase),  # its pattern repeats 16 times
        MeshObject("celadon_bottle", "continuous", celadon_bottle),  # plain
    ]
