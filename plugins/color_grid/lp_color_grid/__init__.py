"""An example plugin for lp_framework: the backbone `color_grid`."""

from __future__ import annotations

from torch import Tensor, nn

from lp_framework.errors import UserError
from lp_framework.models.backbones import Backbone
from lp_framework.registry import register


@register("backbone", "color_grid")
class ColorGrid(Backbone):
    """Mean colours on a coarse grid, and one trainable layer: a baseline that sees where colours are, but no shapes.

    The constructor's arguments are the settings (`backbone.grid=8`), and the first line above is the description in
    `lp plugins`. The trunk has no parameters, so it is `frozen`: its features are computed once per image and cached.
    """

    def __init__(self, grid: int = 4, features: int = 128, image_size: int = 64) -> None:
        super().__init__()
        if not 1 <= grid <= image_size:
            raise UserError(f"backbone.grid must be between 1 and image_size = {image_size}, got {grid}")
        self.image_size, self.trunk_dim, self.feature_dim, self.frozen = image_size, 3 * grid**2, features, True
        self.colors = nn.Sequential(nn.AdaptiveAvgPool2d(grid), nn.Flatten())
        self.head = nn.Sequential(nn.Linear(self.trunk_dim, features), nn.ReLU())

    def trunk_module(self) -> nn.Module:
        """The frozen part."""
        return self.colors

    def trunk_features(self, images: Tensor) -> Tensor:
        """Mean colours `[I, 3 * grid * grid]` of images `[I, 3, image_size, image_size]` in [-1, 1]."""
        return self.colors(images)
