"""Renderings made to look like photographs, and the 3-D points seen in their pixels."""

import json
import math
from dataclasses import replace

import numpy as np
import painted_cube
import pytest
import torch
from PIL import Image

from lp_framework.data.photographic import CELLS, decoded_renderings, like_photograph
from lp_framework.data.photographs import SIZE
from lp_framework.data.rendering.views import ViewProtocol
from lp_framework.data.views import DEPTH_UNIT, read_views
from lp_framework.errors import UserError
from lp_framework.geometry import camera_to_world

FIELD_OF_VIEW = 0.7  # radians


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """A folder with one object, four views of the painted box with their depths."""
    root = tmp_path_factory.mktemp("box")
    folder, frames = root / "box" / "train", []
    focal = SIZE / 2 / math.tan(FIELD_OF_VIEW / 2)
    intrinsics = torch.tensor([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]], dtype=torch.float64)
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for number in range(4):
        pose = torch.tensor([0.5 - 0.2 * number, 1.7 * number, 1.8], dtype=torch.float64)
        camera = camera_to_world(pose)
        colours, mask = painted_cube.photograph(camera, intrinsics, (SIZE, SIZE))
        Image.fromarray(np.dstack([colours, mask])).save(folder / "rgb" / f"{number:03d}.png")
        points = (colours.astype(np.float64) - 128) / 200
        depth = -((points - camera[:3, 3].numpy()) @ camera[:3, :3].numpy())[..., 2]  # along the optical axis
        levels = np.where(mask > 0, np.rint(depth / DEPTH_UNIT), 0).astype(np.uint16)
        Image.fromarray(levels).save(folder / "depth" / f"{number:03d}.png")
        frames.append({"file_path": f"{number:03d}.png", "transform_matrix": camera.tolist()})
    (folder / "transform.json").write_text(json.dumps({"camera_angle_x": FIELD_OF_VIEW, "frames": frames}))
    return root


def test_points_are_those_that_the_cells_show(box, tmp_path):
    """The box's colours tell its points: a cell's mean colour is that of its mean point, but for rims and edges."""
    _, views = decoded_renderings([read_views(box, "box", "train")], 0.0, SIZE, tmp_path)
    assert not views["cropped"].any()
    pixels = np.array(views["pixels"], dtype=np.float64)
    bounds = np.linspace(0, SIZE, CELLS + 1).round().astype(int)
    apart = []
    for view in range(4):
        for cell in range(CELLS * CELLS):
            row, column = divmod(cell, CELLS)
            patch = pixels[view, bounds[row] : bounds[row + 1], bounds[column] : bounds[column + 1]]
            point = views["points"][view, cell].astype(np.float64)
            assert np.isfinite(point).all() == np.isfinite(point).any()
            if (patch < 250).any(axis=-1).all():  # all of it shows the box
                apart.append(np.abs((patch.mean(axis=(0, 1)) - 128) / 200 - point).max())
            if (patch == 255).all():
                assert np.isnan(point).all()
    assert len(apart) > 60 and np.median(apart) < 0.01 and max(apart) < 0.06


def test_the_share_of_photographs_is_drawn_by_name_and_keeps_the_points_on_the_box(box, tmp_path):
    _, views = decoded_renderings([read_views(box, "box", "train")], 1.0, SIZE, tmp_path)
    assert views["cropped"].all()
    points = views["points"].astype(np.float64)
    seen = np.isfinite(points).all(axis=-1)
    assert seen.mean() > 0.2
    half = np.array(painted_cube.SIDES) / 2
    assert (np.abs(points[seen]) <= half + 0.01).all()
    _, again = decoded_renderings([read_views(box, "box", "train")], 1.0, SIZE, tmp_path / "other")
    np.testing.assert_array_equal(views["pixels"], again["pixels"])


def test_renderings_of_other_cameras_depths_and_sizes_are_decoded_anew(box, tmp_path):
    views = read_views(box, "box", "train")
    key, _ = decoded_renderings([views], 0.5, SIZE, tmp_path)
    small, pixels = decoded_renderings([views], 0.5, 64, tmp_path)
    assert pixels["pixels"].shape == (4, 64, 64, 3)
    nearer, _ = decoded_renderings([replace(views, cameras=views.cameras * 1.1)], 0.5, SIZE, tmp_path)
    wider, _ = decoded_renderings([replace(views, field_of_view=views.field_of_view + 0.1)], 0.5, SIZE, tmp_path)
    file = box / "box" / "train" / "depth" / "001.png"
    kept = file.read_bytes()
    Image.fromarray(np.full((SIZE, SIZE), 9_000, np.uint16)).save(file)
    deeper, _ = decoded_renderings([views], 0.5, SIZE, tmp_path)
    file.write_bytes(kept)
    assert len({key, small, nearer, wider, deeper}) == 5


def test_views_without_depth_are_named(box, tmp_path):
    views = read_views(box, "box", "train")
    (box / "box" / "train" / "depth" / "002.png").rename(tmp_path / "002.png")
    with pytest.raises(UserError, match=r"002\.png: there is no such file; render the views with data\.depth=true"):
        decoded_renderings([views], 0.5, SIZE, tmp_path)
    (tmp_path / "002.png").rename(box / "box" / "train" / "depth" / "002.png")


def test_with_another_field_of_view_an_object_looks_as_large():
    protocol = ViewProtocol(field_of_view_range=[25.0, 70.0])
    fields = [protocol.of_object(f"object {number}") for number in range(50)]
    angles = [each.field_of_view_degrees for each in fields]
    assert min(angles) < 30 and max(angles) > 65 and all(25 <= angle <= 70 for angle in angles)
    sizes = [each.nearest_radius * math.tan(math.radians(each.field_of_view_degrees) / 2) for each in fields]
    expected = protocol.nearest_radius * math.tan(math.radians(protocol.field_of_view_degrees) / 2)
    assert sizes == pytest.approx([expected] * 50)
    assert ViewProtocol().of_object("any") == ViewProtocol()


def test_photograph_of_a_rendering_shows_the_same_points_where_its_pixels_show_them():
    """A disc whose points tell their own place: after crop and roll they lie as far apart as before."""
    y, x = np.mgrid[:256, :256].astype(np.float32)
    inside = (x - 120) ** 2 + (y - 140) ** 2 < 50**2
    view = np.dstack([np.full((256, 256, 3), 90, np.uint8), np.where(inside, 255, 0).astype(np.uint8)])
    points = np.dstack([x, y, np.zeros_like(x)]).astype(np.float32)
    points[~inside] = np.nan
    image, seen = like_photograph(view, points, np.random.default_rng(3))
    rows, columns = np.nonzero(np.isfinite(seen[..., 0]))
    assert abs(max(np.ptp(rows), np.ptp(columns)) - 200) < 15  # the object fills 200 of 256 pixels, about
    assert (image[..., 3][rows, columns] > 127).mean() > 0.95
    places = np.stack([columns, rows], axis=1).astype(np.float64)
    shown = seen[rows, columns, :2].astype(np.float64)
    fit, *_ = np.linalg.lstsq(np.column_stack([places, np.ones(len(places))]), shown, rcond=None)
    linear = fit[:2].T
    scale = np.sqrt(abs(np.linalg.det(linear)))
    assert scale == pytest.approx(100 / 200, rel=0.07)
    np.testing.assert_allclose(linear @ linear.T, scale**2 * np.eye(2), atol=0.01)  # a turn, no shear
    assert abs(math.degrees(math.atan2(linear[1, 0], linear[0, 0]))) <= 10.5
