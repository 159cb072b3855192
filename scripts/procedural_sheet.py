"""Draw the contact sheet docs/pictures/procedural.png: one view of each of the first objects of `data=procedural`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image

from lp_framework.data.procedural import procedural_object
from lp_framework.data.rendering.pyrender_renderer import AutoRenderer
from lp_framework.geometry import camera_to_world

FILE = Path(__file__).parents[1] / "docs" / "pictures" / "procedural.png"
ROWS, COLUMNS, SIZE = 6, 10, 150  # the size of a view in pixels
POSE = (0.4, 0.5, 1.6)  # latitude, longitude (radians), radius (scene units)


def main() -> None:
    """Draw and save it."""
    renderer, camera = AutoRenderer(), camera_to_world(torch.tensor([POSE], dtype=torch.float64))
    sheet = Image.new("RGB", (COLUMNS * SIZE, ROWS * SIZE), "white")
    for index, (row, column) in enumerate(np.ndindex(ROWS, COLUMNS)):
        pixels = renderer.render(procedural_object(seed=0, index=index).load(), camera, SIZE, 49.1)[0]
        view = Image.fromarray(pixels)
        sheet.paste(view, (column * SIZE, row * SIZE), view)
    sheet.save(FILE, optimize=True)
    print(f"{FILE}: {FILE.stat().st_size / 1000:.0f} KB")


if __name__ == "__main__":
    main()
