from pathlib import Path

import pytest
import torch

from lp_framework import registry
from lp_framework.errors import UserError

registry.discover([Path(__file__).parents[1]])


def test_the_trunk_gives_the_mean_colour_of_each_cell():
    backbone = registry.build("backbone", {"name": "color_grid", "grid": 2, "image_size": 4})
    images = torch.rand(5, 3, 4, 4, generator=torch.Generator().manual_seed(0)) * 2 - 1
    features = backbone.trunk(images).view(5, 3, 2, 2)
    torch.testing.assert_close(features[:, :, 0, 1], images[:, :, :2, 2:].mean(dim=(2, 3)))


def test_images_of_any_size_become_features_and_all_parameters_learn():
    backbone = registry.build("backbone", {"name": "color_grid", "features": 7})
    features = backbone(torch.rand(2, 3, 100, 100))
    assert features.shape == (2, backbone.feature_dim) == (2, 7)
    features.sum().backward()
    assert all(parameter.grad is not None for parameter in backbone.parameters())


def test_a_grid_finer_than_the_image_is_refused():
    with pytest.raises(UserError, match="grid must be between 1 and image_size = 8, got 9"):
        registry.build("backbone", {"name": "color_grid", "grid": 9, "image_size": 8})
