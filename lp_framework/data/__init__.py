"""View sources, views on disk, and batches of pairs; importing the package registers sources and renderers."""

from lp_framework.data import procedural, views
from lp_framework.data.rendering import pyrender_renderer, raycast
from lp_framework.data.sets import co3d, hopev2, omni3d, rendered

__all__ = ["co3d", "hopev2", "omni3d", "procedural", "pyrender_renderer", "raycast", "rendered", "views"]
