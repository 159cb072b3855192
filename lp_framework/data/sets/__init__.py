"""Sources of views: meshes to render, and published data sets in their authors' own formats."""

from lp_framework.data.sets import co3d, hopev2, omni3d, rendered

__all__ = ["co3d", "hopev2", "omni3d", "rendered"]
