"""Views of objects and pairs of them; importing the package registers the data sets and the renderers."""

from lp_framework.data import sources
from lp_framework.data.rendering import auto, pyrender_renderer, raycast
from lp_framework.data.sets import co3d, hopev2, omni3d, scanned

__all__ = ["auto", "co3d", "hopev2", "omni3d", "pyrender_renderer", "raycast", "scanned", "sources"]
