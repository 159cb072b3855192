"""Rendering: from meshes to views on disk. The renderers agree on light, silhouette and colour."""

from lp_framework.data.rendering import auto, pyrender_renderer, raycast

__all__ = ["auto", "pyrender_renderer", "raycast"]
