"""Where views come from, views on disk, and batches of pairs; importing the package registers sources and renderers."""

from lp_framework.data import procedural, rendering, sets, views

__all__ = ["procedural", "rendering", "sets", "views"]
