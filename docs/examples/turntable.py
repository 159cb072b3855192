"""A data set to copy: photographs from a turntable."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from lp_framework.data.files import names_below
from lp_framework.data.views import FIELD_OF_VIEW_DEGREES, ObjectViews, ViewSource
from lp_framework.errors import UserError, check_settings
from lp_framework.geometry import camera_to_world
from lp_framework.registry import register


@register("data", "turntable")
class Turntable(ViewSource):
    """Folders of cut-out photographs, one per object, at equal steps of a turntable.

    `OBJECT/000.png`, `OBJECT/001.png`, ... go once around the object. Every
    `test_every`-th one is a test view.
    """

    def __init__(
        self,
        path: str,
        latitude_degrees: float = 15.0,
        radius: float = 1.5,
        test_every: int = 4,
    ) -> None:
        enough = test_every >= 2
        check_settings("data", ("test_every", test_every, enough, "at least 2"))
        self.path, self.test_every = Path(path), test_every
        self.latitude, self.radius = math.radians(latitude_degrees), radius

    def names(self) -> list[str]:
        """The folders with photographs."""
        names = {file.parent.name for file in self.path.glob("*/*.png")}
        return names_below(self.path, names, "photographs", "OBJECT/*.png")

    def views(self, name: str, split: str) -> ObjectViews:
        """See `ViewSource.views`; the table turns the object's front to the left."""
        files = sorted((self.path / name).glob("*.png"))
        count = len(files)
        if count <= self.test_every:
            wanted = f"more than {self.test_every} photographs"
            raise UserError(f"{self.path / name}: needs {wanted}, has {count}")
        poses = torch.empty(count, 3, dtype=torch.float64)
        poses[:, 0] = self.latitude
        poses[:, 1] = torch.arange(count) * (2 * math.pi / count)
        poses[:, 2] = self.radius
        is_test = torch.arange(count) % self.test_every == 0
        kept = torch.nonzero(is_test == (split == "test")).flatten().tolist()
        field_of_view = math.radians(FIELD_OF_VIEW_DEGREES)
        return ObjectViews(
            name=name,
            split=split,
            ambiguity="unlabelled",
            unique_answer=None,
            files=[files[index] for index in kept],
            cameras=camera_to_world(poses[kept]),
            field_of_view=torch.full((len(kept),), field_of_view, dtype=torch.float64),
        )
