"""An unlimited supply of procedural objects: textured household objects, each generated from two numbers.

Read bottom-up: `paint` and `solids`, `textures` (colours, patterns, pictures), `labels` (prints of packages) and
`shapes`, then the families (`groceries`, `crockery`, `furniture`, `things`), and `objects`, which chooses among them.
"""

from __future__ import annotations

from lp_framework.data.procedural.objects import FAMILIES, Family, ProceduralData, procedural_object

__all__ = ["FAMILIES", "Family", "ProceduralData", "procedural_object"]
