"""The twelve embedded objects: one function per object builds its normalized scene; one module per ambiguity class.

Toys with a front face +Z or drive towards +X. `make_embedded_objects.py` writes the scenes into the package.
"""

from embedded_objects.continuous import celadon_bottle, lotus_vase, soup_can
from embedded_objects.twofold import juice_carton, suitcase, tram
from embedded_objects.unique import cottage, duck, fire_engine, robot, sailboat, watering_can

TOYS = {
    toy.__name__: toy
    for toy in (
        *(fire_engine, cottage, robot, sailboat, duck, watering_can),
        *(tram, juice_carton, suitcase),
        *(soup_can, lotus_vase, celadon_bottle),
    )
}
