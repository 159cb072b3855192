"""Rendering: from meshes to views on disk. The renderers agree on light, silhouette and colour."""
