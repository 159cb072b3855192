"""Procedural objects without end: textured things as they stand about a house, each made from two numbers.

Read from the bottom up: `paint` and `solids`, `textures` (colours, patterns, pictures), `labels` (prints of packages)
and `shapes`, then the families (`groceries`, `crockery`, `furniture`, `things`), and `objects`, which picks among them.
"""

from __future__ import annotations

from lp_framework.data.procedural.objects import FAMILIES, Family, ProceduralData, procedural_object

__all__ = ["FAMILIES", "Family", "ProceduralData", "procedural_object"]
