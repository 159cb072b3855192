"""Rendering: from meshes to views on disk. The renderers agree on light, silhouette and colour."""

from lp_framework.data.rendering import pyrender_renderer, raycast

__all__ = ["pyrender_renderer", "raycast"]
