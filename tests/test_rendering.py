import errno
import json
import math
import os
import shutil
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from filelock import FileLock
from PIL import Image
from scanned_objects import write_bottle, write_mug

from lp_framework.data.meshes import MeshObject, load_scene, normalise
from lp_framework.data.rendering import pyrender_renderer
from lp_framework.data.rendering.pyrender_renderer import AutoRenderer, PyrenderRenderer, offscreen_context
from lp_framework.data.rendering.raycast import RaycastRenderer
from lp_framework.data.rendering.renderer import Renderer, View, downsample
from lp_framework.data.rendering.views import ViewProtocol, render_object, render_objects
from lp_framework.data.sets import rendered
from lp_framework.data.sets.rendered import MeshData
from lp_framework.errors import UserError
from lp_framework.geometry import camera_to_world, to_ifusion, view_pose

FIELD_OF_VIEW = 49.1  # degrees


def open_gl() -> None:
    try:
        offscreen_context()
    except UserError as error:
        pytest.skip(str(error))


@pytest.fixture(params=[PyrenderRenderer, RaycastRenderer], ids=lambda cls: cls.name)
def renderer(request) -> Renderer:
    if request.param is PyrenderRenderer:
        open_gl()
    return request.param()


def cameras(*poses_degrees: tuple[float, float, float]) -> torch.Tensor:
    """Camera matrices of (latitude, longitude, radius), in degrees."""
    poses = torch.tensor(poses_degrees, dtype=torch.float64)
    return camera_to_world(torch.cat([torch.deg2rad(poses[:, :2]), poses[:, 2:]], dim=1))


def ball(centre: tuple[float, float, float], radius: float, colour: tuple[int, int, int]) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    mesh.apply_translation(centre)
    mesh.visual.vertex_colors = [*colour, 255]
    return mesh


def textured_box() -> trimesh.Trimesh:
    """A box with a smooth, colourful texture whose sides are no powers of two, the whole image on each face."""
    box = trimesh.creation.box(extents=(1.0, 0.7, 0.5))
    box.unmerge_vertices()
    y, x = np.mgrid[0:150, 0:200] / 200
    image = np.stack([x, y, 0.5 + 0.5 * np.sin(20 * x) * np.cos(15 * y)], axis=-1)
    normals = np.abs(np.repeat(box.face_normals, 3, axis=0))
    axes = np.argsort(normals, axis=1)[:, :2]  # the two directions along the face
    uv = np.take_along_axis(box.vertices, axes, axis=1) + 0.5
    box.visual = trimesh.visual.TextureVisuals(uv=uv, image=Image.fromarray((255 * image).astype(np.uint8)))
    return box


def vertex_coloured_torus() -> trimesh.Trimesh:
    torus = trimesh.creation.torus(0.35, 0.15)
    torus.visual.vertex_colors = np.c_[(torus.vertices * 255 + 128).clip(0, 255), np.full(len(torus.vertices), 255)]
    return torus


# ---------------------------------------------------------------- geometry of the image


@pytest.mark.parametrize("pose", [(0, 0, 1.5), (20, 40, 1.3), (-30, 100, 2.0), (10, 200, 1.7), (-7.5, 345, 1.2)])
def test_known_points_appear_where_a_pinhole_camera_sees_them(renderer, pose):
    points = {(255, 0, 0): (0.4, 0.1, 0.0), (0, 255, 0): (-0.05, 0.45, 0.1), (0, 0, 255): (0.1, -0.3, 0.35)}
    resolution = 128
    focal = resolution / 2 / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    (matrix,) = cameras(pose).numpy()
    for colour, point in points.items():
        scene = trimesh.Scene([ball(point, 0.04, colour)])
        (image,) = renderer.render(scene, matrix[None], resolution, FIELD_OF_VIEW)
        x, y, z = matrix[:3, :3].T @ (np.array(point) - matrix[:3, 3])
        expected = resolution / 2 + focal * x / -z, resolution / 2 - focal * y / -z
        weight = image[..., 3] / 255.0
        rows, columns = np.mgrid[0:resolution, 0:resolution] + 0.5
        found = (columns * weight).sum() / weight.sum(), (rows * weight).sum() / weight.sum()
        assert np.abs(np.subtract(found, expected)).max() < 0.25, (colour, found, expected)
        assert image[image[..., 3] == 255][:, :3].argmax(axis=1).tolist().count(colour.index(255)) > 10


RED, GREEN, BLUE, YELLOW, WHITE, BLACK = (
    (230, 20, 20), (20, 230, 20), (20, 20, 230), (230, 230, 20), (230, 230, 230), (5, 5, 5),
)  # fmt: skip


def painted_box() -> trimesh.Trimesh:
    """A cube: +X red, -X green, +Z blue, -Z yellow, +Y white, -Y black."""
    box = trimesh.creation.box()
    paint = {
        (1, 0, 0): RED,
        (-1, 0, 0): GREEN,
        (0, 0, 1): BLUE,
        (0, 0, -1): YELLOW,
        (0, 1, 0): WHITE,
        (0, -1, 0): BLACK,
    }
    box.visual.face_colors = [[*paint[tuple(normal.round().astype(int))], 255] for normal in box.face_normals]
    return box


def nearest_paint(pixel: np.ndarray) -> tuple[int, int, int]:
    assert pixel[3] == 255
    hue = pixel[:3] / max(pixel[:3].max(), 60)  # shading changes the brightness
    paints = [RED, GREEN, BLUE, YELLOW, WHITE, BLACK]
    return min(paints, key=lambda paint: np.abs(hue - np.array(paint) / max(*paint, 60)).sum())


def test_each_side_is_seen_from_its_side_and_up_is_up_and_right_is_right(renderer):
    views = cameras((0, 0, 3), (0, 90, 3), (0, 180, 3), (0, 270, 3), (40, 45, 3), (-40, 45, 3))
    images = renderer.render(trimesh.Scene(painted_box()), views, 64, FIELD_OF_VIEW)
    assert images.shape == (6, 64, 64, 4) and images.dtype == np.uint8
    assert [nearest_paint(image[32, 32]) for image in images[:4]] == [BLUE, RED, YELLOW, GREEN]
    from_above, from_below = images[4:]
    assert nearest_paint(from_above[22, 32]) == WHITE and nearest_paint(from_below[42, 32]) == BLACK
    # From between +Z and +X the side facing +Z lies to the left, the one facing +X to the right.
    for image, row in ((from_above, 40), (from_below, 24)):
        assert nearest_paint(image[row, 26]) == BLUE and nearest_paint(image[row, 38]) == RED


def test_field_of_view_spans_the_image(renderer):
    half = math.tan(math.radians(FIELD_OF_VIEW) / 2)  # half the width seen at distance 1
    for scale, filled in ((1.01, True), (0.97, False)):
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * half * scale
        square = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]])
        (image,) = renderer.render(trimesh.Scene(square), cameras((0, 0, 1)), 64, FIELD_OF_VIEW)
        alpha = image[..., 3]
        assert (alpha == 255).all() == filled
        assert (alpha[1:-1, 1:-1] == 255).all() and (alpha == alpha[::-1]).all() and (alpha == alpha[:, ::-1]).all()


# ---------------------------------------------------------------- look


def test_edges_are_soft_and_have_the_colour_of_the_object(renderer):
    square = trimesh.creation.box(extents=(1, 1, 1e-3))
    square.visual.face_colors = [200, 40, 40, 255]
    square.apply_transform(trimesh.transformations.rotation_matrix(0.3, [0, 0, 1]))
    (image,) = renderer.render(trimesh.Scene(square), cameras((0, 0, 1.8)), 64, FIELD_OF_VIEW)
    alpha = image[..., 3]
    assert len(np.unique(alpha)) > 3
    assert (image[alpha == 0] == 0).all()
    edge, inside = image[(alpha > 0) & (alpha < 255)][:, :3], image[alpha == 255][:, :3]
    assert np.abs(edge.astype(int) - inside.mean(axis=0)).max() < 25  # the background would pull it down by 100


def test_light_turns_with_the_camera(renderer):
    """All views of a body of revolution are equal: shading must not tell the longitude."""
    vase = trimesh.creation.revolve([[0, -0.5], [0.3, -0.5], [0.2, 0.0], [0.35, 0.5], [0, 0.5]], sections=24)
    vase.apply_transform(trimesh.transformations.rotation_matrix(-math.pi / 2, [1, 0, 0]))
    images = renderer.render(
        trimesh.Scene(vase), cameras((20, 0, 1.5), (20, 90, 1.5), (20, 195, 1.5)), 64, FIELD_OF_VIEW
    )
    difference = np.abs(images.astype(int) - images[0])
    assert np.percentile(difference, 99) <= 1 and difference.mean() < 0.2
    assert images[0][..., :3][images[0][..., 3] == 255].std() > 10  # while there is shading


def test_inside_out_meshes_look_the_same(renderer):
    mesh = vertex_coloured_torus()
    inside_out = mesh.copy()
    inside_out.invert()
    view = cameras((25, 70, 1.4))
    first, second = (renderer.render(trimesh.Scene(each), view, 48, FIELD_OF_VIEW)[0] for each in (mesh, inside_out))
    assert np.abs(first.astype(int) - second).mean() < 0.1


def test_a_sheet_painted_on_both_sides_shows_the_side_in_view(renderer):
    corners = np.array([[-0.4, -0.4, 0], [0.4, -0.4, 0], [0.4, 0.4, 0], [-0.4, 0.4, 0]])
    front, back = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]), trimesh.Trimesh(corners, [[0, 2, 1], [0, 3, 2]])
    front.visual.face_colors, back.visual.face_colors = [*RED, 255], [*GREEN, 255]
    images = renderer.render(trimesh.Scene([front, back]), cameras((0, 0, 1.5), (0, 180, 1.5)), 32, FIELD_OF_VIEW)
    for image, paint in zip(images, (RED, GREEN), strict=True):
        assert {nearest_paint(pixel) for pixel in image[image[..., 3] == 255]} == {paint}


def test_white_is_bright_without_being_blown_out_and_black_is_not_flat(renderer):
    white, black = trimesh.creation.icosphere(radius=0.5), trimesh.creation.icosphere(radius=0.5)
    for mesh, reflectance in ((white, 255), (black, 3)):
        material = trimesh.visual.material.PBRMaterial(baseColorFactor=[reflectance] * 3 + [255])
        mesh.visual = trimesh.visual.TextureVisuals(material=material)
    for mesh, low, high in ((white, 120, 254), (black, 5, 70)):
        (image,) = renderer.render(trimesh.Scene(mesh), cameras((10, 0, 1.6)), 64, FIELD_OF_VIEW)
        levels = image[..., :3][image[..., 3] == 255]
        assert low <= levels.min() and levels.max() <= high and np.ptp(levels) >= 10


def test_textures_are_upright_and_repeat(renderer):
    """A square with texture coordinates from 0 to 2 shows the image four times, its first row on top."""
    image = np.zeros((8, 8, 3), np.uint8)
    image[:4, :4], image[:4, 4:], image[4:, :4], image[4:, 4:] = RED, GREEN, BLUE, YELLOW
    corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    square = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    uv = 2.0 * (corners[:, :2] + 0.5)
    square.visual = trimesh.visual.TextureVisuals(uv=uv, image=Image.fromarray(image))
    distance = 0.5 / math.tan(math.radians(FIELD_OF_VIEW) / 2)  # the square fills the image
    (view,) = renderer.render(trimesh.Scene(square), cameras((0, 0, distance)), 64, FIELD_OF_VIEW)
    centres = [[nearest_paint(view[row, column]) for column in (8, 24, 40, 56)] for row in (8, 24, 40, 56)]
    assert centres == [[RED, GREEN] * 2, [BLUE, YELLOW] * 2] * 2


def test_downsampling_takes_the_mean_with_premultiplied_alpha():
    samples = np.zeros((2, 4, 4), np.uint8)
    samples[0, 0], samples[1, 1] = (200, 100, 0, 255), (100, 100, 40, 255)
    depth = np.zeros((2, 4), np.float32)
    depth[0, 0], depth[1, 1] = 1.5, 1.25
    view = downsample(samples, depth)
    np.testing.assert_array_equal(view.pixels, [[[150, 100, 20, 128], [0, 0, 0, 0]]])
    np.testing.assert_array_equal(view.depth, [[1.25, 0]])  # of the nearest sample
    assert view.depth.dtype == np.float32


@pytest.mark.parametrize("pose", [(0, 0, 1.5), (0, 90, 2.0), (25, 40, 1.3)])
def test_depth_is_along_the_optical_axis_and_zero_where_there_is_nothing(renderer, pose):
    centre, radius, resolution = np.array([0.1, -0.2, 0.3]), 0.25, 64
    scene = trimesh.Scene([trimesh.creation.icosphere(subdivisions=5, radius=radius)])
    scene.geometry[next(iter(scene.geometry))].apply_translation(centre)
    (matrix,) = cameras(pose).numpy()
    (view,) = renderer.views(scene, matrix[None], resolution, FIELD_OF_VIEW)
    assert view.depth.shape == (resolution, resolution) and view.depth.dtype == np.float32
    np.testing.assert_array_equal(view.depth > 0, view.pixels[..., 3] > 0)
    # Where rays through the pixels' centres meet the ball, spelt out.
    row, column = np.mgrid[0:resolution, 0:resolution] + 0.5
    step = 2 * math.tan(math.radians(FIELD_OF_VIEW) / 2) / resolution
    rays = np.stack([(column - resolution / 2) * step, (resolution / 2 - row) * step, -np.ones_like(row)], axis=-1)
    place = matrix[:3, :3].T @ (centre - matrix[:3, 3])
    along, square = rays @ place, (rays**2).sum(axis=-1)
    inside = along**2 - square * (place @ place - radius**2)
    inner = inside > 0.2 * inside.max()  # not the rim, where depth changes within a pixel
    expected = (along - np.sqrt(np.maximum(inside, 0))) / square  # the ray's third component is -1
    np.testing.assert_allclose(view.depth[inner], expected[inner], atol=0.02)
    assert abs((view.depth - expected)[inner].mean()) < 0.01


# ---------------------------------------------------------------- agreement of the renderers

SCENES = {
    "textured": lambda _: trimesh.Scene(textured_box()),
    "vertex_coloured": lambda _: trimesh.Scene(vertex_coloured_torus()),
    "face_coloured": lambda _: trimesh.Scene(painted_box()),
    "scanned_mug": lambda folder: load_scene(write_mug(folder)),
    "painted_sheets": lambda folder: load_scene(write_bottle(folder)),
}


@pytest.mark.parametrize("name", SCENES)
def test_renderers_agree_on_silhouette_and_colour(name, tmp_path):
    open_gl()
    scene = normalise(SCENES[name](tmp_path))
    views = cameras((20, 30, 1.5), (-25, 160, 1.9))
    by_gl, by_rays = (each.render(scene, views, 96, FIELD_OF_VIEW) for each in (PyrenderRenderer(), RaycastRenderer()))
    inside_gl, inside_rays = by_gl[..., 3] >= 128, by_rays[..., 3] >= 128
    overlap = (inside_gl & inside_rays).sum(axis=(1, 2)) / (inside_gl | inside_rays).sum(axis=(1, 2))
    assert (overlap > 0.98).all()
    both = (by_gl[..., 3] == 255) & (by_rays[..., 3] == 255)
    difference = np.abs(by_gl[..., :3].astype(int) - by_rays[..., :3])[both]
    assert difference.mean() < 2  # of 255


# ---------------------------------------------------------------- machines without OpenGL


def test_auto_takes_pyrender_where_there_is_opengl():
    open_gl()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert AutoRenderer().name == "pyrender"


def test_auto_takes_raycast_and_says_why(monkeypatch):
    def no_opengl() -> None:
        raise UserError("there is no OpenGL")

    monkeypatch.setattr(pyrender_renderer, "offscreen_context", no_opengl)
    with pytest.warns(UserWarning, match="raycast instead of pyrender: there is no OpenGL"):
        chosen = AutoRenderer()
    assert chosen.name == "raycast"
    (image,) = chosen.render(trimesh.Scene(painted_box()), cameras((0, 90, 3)), 16, FIELD_OF_VIEW)
    assert nearest_paint(image[8, 8]) == RED


def test_pyrender_names_every_platform_that_failed(monkeypatch):
    def fail() -> None:
        raise OSError(f"no {os.environ['PYOPENGL_PLATFORM']} here")

    monkeypatch.setattr(pyrender_renderer, "_open_context", fail)
    monkeypatch.setattr(pyrender_renderer, "_forget_opengl", lambda: None)
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    with pytest.raises(UserError, match=r"no egl here.*no osmesa here.*renderer=raycast"):
        offscreen_context.__wrapped__()
    assert "PYOPENGL_PLATFORM" not in os.environ
    monkeypatch.setenv("PYOPENGL_PLATFORM", "osmesa")
    with pytest.raises(UserError, match=r"\(osmesa: OSError: no osmesa here\)"):
        offscreen_context.__wrapped__()


# ---------------------------------------------------------------- the protocol


def test_default_protocol_is_the_papers():
    poses = ViewProtocol().training_poses("cup")
    assert poses.shape == (216, 3) and poses.dtype == np.float64
    np.testing.assert_allclose(np.unique(poses[:, 0].round(9)), np.radians(np.arange(-30, 31, 7.5)), atol=1e-8)
    np.testing.assert_allclose(np.unique(poses[:, 1].round(9)), np.radians(np.arange(0, 360, 15)), atol=1e-8)
    assert len(np.unique(poses[:, :2].round(9), axis=0)) == 216
    radii = poses[:, 2]
    assert radii.min() >= 1.2 and radii.max() <= 2.0 and np.ptp(radii) > 0.7 and len(np.unique(radii)) == 216


def test_test_poses_are_random_in_the_ranges():
    poses = ViewProtocol(test_views=2000).test_poses("cup")
    low, high = [math.radians(-30), 0, 1.2], [math.radians(30), 2 * math.pi, 2.0]
    assert (poses >= low).all() and (poses <= high).all()
    np.testing.assert_allclose(poses.mean(axis=0), np.mean([low, high], axis=0), rtol=0.05, atol=0.03)
    assert ViewProtocol().test_poses("cup").shape == (8, 3)


def test_poses_are_keyed_by_seed_and_name_alone():
    protocol, other = ViewProtocol(), ViewProtocol(seed=1)
    for poses in (ViewProtocol.training_poses, ViewProtocol.test_poses):
        first = poses(protocol, "cup")
        poses(protocol, "bowl")
        np.testing.assert_array_equal(poses(protocol, "cup"), first)
        assert not np.array_equal(poses(protocol, "bowl"), first) and not np.array_equal(poses(other, "cup"), first)
    assert not np.isin(protocol.test_poses("cup")[:, 2], protocol.training_poses("cup")[:, 2]).any()


def test_steps_that_do_not_divide_the_range_stay_inside_it():
    poses = ViewProtocol(latitude_step_degrees=25, longitude_step_degrees=100).training_poses("cup")
    np.testing.assert_allclose(np.unique(np.degrees(poses[:, 0]).round(6)), [-30, -5, 20])
    np.testing.assert_allclose(np.unique(np.degrees(poses[:, 1]).round(6)), [0, 100, 200, 300])


@pytest.mark.parametrize(
    "wrong",
    [
        {"resolution": 0}, {"lowest_latitude_degrees": 31}, {"test_views": -1}, {"highest_latitude_degrees": 91},
        {"latitude_step_degrees": 0}, {"longitude_step_degrees": -15}, {"train_views": 0},
    ],
)  # fmt: skip
def test_impossible_protocols_are_user_errors(wrong):
    with pytest.raises(UserError, match=r"data\.\w+ must be .*, got"):
        ViewProtocol(**wrong)


# ---------------------------------------------------------------- views on disk

SMALL = ViewProtocol(resolution=16, latitude_step_degrees=30, longitude_step_degrees=120, test_views=2)  # 9 + 2 views


class FlatRenderer(Renderer):
    """Draws nothing but a colour; counts its views, and fails before view number `fails_at`."""

    name = "flat"

    def __init__(self, fails_at: int | None = None, error: type[BaseException] = RuntimeError) -> None:
        self.fails_at, self.error, self.drawn = fails_at, error, 0

    def views(self, scene, camera_to_world, resolution, field_of_view_degrees):
        for _ in camera_to_world:
            if self.drawn == self.fails_at:
                raise self.error("killed")
            self.drawn += 1
            yield View(np.full((resolution, resolution, 4), self.drawn, np.uint8))


def objects_named(*names: str) -> list[MeshObject]:
    return [MeshObject(name, "unique", lambda: trimesh.Scene(painted_box())) for name in names]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_rendering_leaves_random_numbers_alone(tmp_path):
    before = torch.get_rng_state()
    render_objects(objects_named("cube"), tmp_path, SMALL, FlatRenderer(), workers=1)
    assert torch.equal(torch.get_rng_state(), before)


def test_written_views_have_ifusions_layout(tmp_path):
    protocol = ViewProtocol(resolution=32, latitude_step_degrees=30, longitude_step_degrees=120, test_views=2)
    render_object(*objects_named("cube"), tmp_path, protocol, RaycastRenderer())
    for split, poses in (("train", protocol.training_poses("cube")), ("test", protocol.test_poses("cube"))):
        folder = tmp_path / "cube" / split
        transform = json.loads((folder / "transform.json").read_text())
        assert transform["camera_angle_x"] == pytest.approx(math.radians(49.1)) and transform["ambiguity"] == "unique"
        files = [frame["file_path"] for frame in transform["frames"]]
        assert files == [f"{index:03d}.png" for index in range(len(poses))]
        assert sorted(path.name for path in (folder / "rgb").iterdir()) == files
        matrices = torch.tensor([frame["transform_matrix"] for frame in transform["frames"]], dtype=torch.float64)
        torch.testing.assert_close(matrices, camera_to_world(torch.from_numpy(poses)), rtol=0, atol=1e-12)
        torch.testing.assert_close(view_pose(matrices), torch.from_numpy(poses), rtol=0, atol=1e-9)
        latlon = torch.tensor([frame["latlon"] for frame in transform["frames"]], dtype=torch.float64)
        torch.testing.assert_close(latlon, to_ifusion(torch.from_numpy(poses)), rtol=0, atol=1e-9)
        expected = RaycastRenderer().render(objects_named("cube")[0].load(), matrices, 32, 49.1)
        for name, pixels in zip(files, expected, strict=True):
            image = Image.open(folder / "rgb" / name)
            assert image.mode == "RGBA"
            np.testing.assert_array_equal(np.asarray(image), pixels)
    record = json.loads((tmp_path / "cube" / "render.json").read_text())
    assert record["renderer"] == "raycast" and record["protocol"]["resolution"] == 32


def test_unlabelled_objects_claim_no_ambiguity(tmp_path):
    obj = MeshObject("cube", "unlabelled", lambda: trimesh.Scene(painted_box()))
    render_object(obj, tmp_path, SMALL, FlatRenderer())
    assert "ambiguity" not in json.loads((tmp_path / "cube" / "train" / "transform.json").read_text())


def test_an_interrupted_object_leaves_nothing_and_the_next_run_completes(tmp_path):
    first, second = objects_named("first", "second")
    with pytest.raises(RuntimeError, match="killed"):
        render_objects([first, second], tmp_path, SMALL, FlatRenderer(fails_at=11 + 5), workers=1)
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["first"]
    finished = contents(tmp_path / "first")
    resumed = FlatRenderer()
    render_objects([first, second], tmp_path, SMALL, resumed, workers=1)
    assert resumed.drawn == 11  # the second object's alone
    assert contents(tmp_path / "first") == finished
    assert len(contents(tmp_path / "second")) == 11 + 2 + 1
    render_objects([first, second], tmp_path, SMALL, FlatRenderer(fails_at=0), workers=1)  # nothing left to do


def test_finished_objects_can_be_reused_without_loading_their_meshes(tmp_path, capfd):
    first, second = objects_named("first", "second")
    render_objects([first], tmp_path, SMALL, FlatRenderer(), workers=1)
    unloadable = MeshObject("first", "unique", lambda: pytest.fail("the mesh was loaded"))
    resumed = FlatRenderer()
    render_objects([unloadable, second], tmp_path, SMALL, resumed, workers=1, check_meshes=False)
    assert resumed.drawn == 11  # the second object's alone
    capfd.readouterr()
    render_objects([unloadable, second], tmp_path, SMALL, FlatRenderer(), workers=1, check_meshes=False)
    render_objects([first, second], tmp_path, SMALL, FlatRenderer(), workers=1)
    assert capfd.readouterr() == ("", "")  # no progress bar where there is nothing to render


@pytest.mark.parametrize(
    "damage",
    [
        lambda folder: (folder / "render.json").unlink(),
        lambda folder: (folder / "render.json").write_text("{"),
        lambda folder: (folder / "render.json").write_text("[]"),
    ],
)
def test_a_folder_without_a_record_is_not_reused(tmp_path, damage):
    render_objects(objects_named("cube"), tmp_path, SMALL, FlatRenderer(), workers=1)
    damage(tmp_path / "cube")
    with pytest.raises(UserError, match=r"the views in .* were rendered differently \(it has no valid render\.json\)"):
        render_objects(objects_named("cube"), tmp_path, SMALL, FlatRenderer(), workers=1, check_meshes=False)


def test_another_protocol_is_noticed_without_the_meshes_and_other_labels_render_nothing_anew(tmp_path):
    (cube,) = objects_named("cube")
    render_objects([cube], tmp_path, SMALL, FlatRenderer(), workers=1)
    before = contents(tmp_path / "cube")
    with pytest.raises(UserError, match=r"rendered differently \(seed was 0, is 1\)"):
        render_objects([cube], tmp_path, replace(SMALL, seed=1), FlatRenderer(), workers=1, check_meshes=False)
    for check_meshes in (False, True):
        relabelled = [replace(cube, ambiguity="twofold")]
        render_objects(relabelled, tmp_path, SMALL, FlatRenderer(fails_at=0), workers=1, check_meshes=check_meshes)
    assert contents(tmp_path / "cube") == before


def test_a_failed_run_gives_its_lock_back_while_its_error_is_still_looked_at(tmp_path):
    with pytest.raises(RuntimeError) as caught:
        render_objects(objects_named("cube"), tmp_path, SMALL, FlatRenderer(fails_at=3), workers=1)
    with FileLock(tmp_path / ".render.lock", timeout=0):  # or the next run in this process would wait for ever
        assert str(caught.value) == "killed"


def test_an_interrupt_by_the_user_leaves_no_half_object(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        render_object(*objects_named("cube"), tmp_path, SMALL, FlatRenderer(fails_at=3, error=KeyboardInterrupt))
    assert list(tmp_path.iterdir()) == []


def test_leftovers_of_a_killed_run_are_removed(tmp_path):
    leftover = tmp_path / ".cube.partial" / "train" / "rgb"
    leftover.mkdir(parents=True)
    (leftover / "777.png").write_bytes(b"half")
    render_object(*objects_named("cube"), tmp_path, SMALL, FlatRenderer())
    assert [path.name for path in tmp_path.iterdir()] == ["cube"]
    assert "777.png" not in {Path(name).name for name in contents(tmp_path / "cube")}


def test_another_protocol_or_mesh_is_not_mixed_in(tmp_path):
    (obj,) = objects_named("cube")
    render_object(obj, tmp_path, SMALL, FlatRenderer())
    finer = ViewProtocol(resolution=24, latitude_step_degrees=30, longitude_step_degrees=120, test_views=2)
    with pytest.raises(
        UserError, match=r"the views in .* were rendered differently \(resolution was 16, is 24\); choose another"
    ):
        render_object(obj, tmp_path, finer, FlatRenderer())
    other = MeshObject("cube", "unique", lambda: trimesh.Scene(vertex_coloured_torus()))
    with pytest.raises(UserError, match=r"rendered differently \(from another mesh, .*; choose another folder"):
        render_object(other, tmp_path, SMALL, FlatRenderer())
    render_object(obj, tmp_path, SMALL, FlatRenderer(fails_at=0))


def test_an_unrelated_folder_is_unchanged(tmp_path):
    (tmp_path / "cube").mkdir()
    (tmp_path / "cube" / "thesis.txt").write_text("precious")
    with pytest.raises(UserError, match=r"the views in .* were rendered differently \(it has no valid render\.json\)"):
        render_object(*objects_named("cube"), tmp_path, SMALL, FlatRenderer())
    assert contents(tmp_path) == {"cube/thesis.txt": b"precious"}


def test_few_views_an_object_are_random_in_the_ranges(tmp_path):
    few = replace(SMALL, train_views=5)
    poses = few.training_poses("cube")
    assert poses.shape == (5, 3) and not np.array_equal(poses[:2], few.test_poses("cube"))
    assert (np.abs(np.degrees(poses[:, 0])) <= 30).all() and len(set(poses[:, 0])) == 5
    assert ((poses[:, 2] >= 1.2) & (poses[:, 2] <= 2.0)).all()
    np.testing.assert_array_equal(poses, replace(few, resolution=99).training_poses("cube"))
    render_objects(objects_named("cube"), tmp_path, few, FlatRenderer(), workers=1)
    assert len(list((tmp_path / "cube" / "train" / "rgb").iterdir())) == 5
    for check_meshes in (False, True):
        render_objects(objects_named("cube"), tmp_path, few, FlatRenderer(fails_at=0), 1, check_meshes)
        with pytest.raises(UserError, match=r"rendered differently \(train_views was 5, is None\)"):
            render_objects(objects_named("cube"), tmp_path, SMALL, FlatRenderer(), 1, check_meshes)


def test_records_are_as_they_were_before_later_settings_came(tmp_path):
    render_objects(objects_named("cube"), tmp_path, SMALL, FlatRenderer(), workers=1)
    record = json.loads((tmp_path / "cube" / "render.json").read_text())
    assert set(record["protocol"]) == {
        "resolution", "field_of_view_degrees", "lowest_latitude_degrees", "highest_latitude_degrees",
        "latitude_step_degrees", "longitude_step_degrees", "nearest_radius", "farthest_radius", "test_views", "seed",
    }  # fmt: skip


def test_depths_are_saved_on_request(tmp_path):
    protocol = replace(SMALL, depth=True)
    with pytest.raises(UserError, match=r"renderer=flat does not provide depth; set data\.depth=false"):
        render_objects(objects_named("cube"), tmp_path / "flat", protocol, FlatRenderer(), workers=1)
    (cube,) = objects_named("cube")
    render_objects([cube], tmp_path, protocol, RaycastRenderer(), workers=1)
    cameras_of_tests = camera_to_world(torch.from_numpy(protocol.test_poses("cube")))
    for index, view in enumerate(RaycastRenderer().views(cube.load(), cameras_of_tests, 16, 49.1)):
        levels = np.asarray(Image.open(tmp_path / "cube" / "test" / "depth" / f"{index:03d}.png"))
        assert levels.dtype == np.uint16
        np.testing.assert_allclose(levels * 1e-4, view.depth, atol=0.6e-4)
    for check_meshes in (False, True):  # they do no harm where they are not wanted, but are missed where they are
        render_objects([cube], tmp_path, SMALL, FlatRenderer(fails_at=0), 1, check_meshes)
        render_objects([cube], tmp_path, protocol, FlatRenderer(fails_at=0), 1, check_meshes)
    render_objects([cube], tmp_path / "without", SMALL, FlatRenderer(), workers=1)
    with pytest.raises(UserError, match=r"rendered differently \(depth was False, is True\)"):
        render_objects([cube], tmp_path / "without", protocol, RaycastRenderer(), 1, check_meshes=False)


def test_a_full_disk_is_a_user_error_and_keeps_what_is_finished(tmp_path, monkeypatch):
    save, room = Image.Image.save, [11 + 4]

    def save_while_there_is_room(image, path, **options):
        if room[0] == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        room[0] -= 1
        save(image, path, **options)

    monkeypatch.setattr(Image.Image, "save", save_while_there_is_room)
    with pytest.raises(
        UserError,
        match=r"second: cannot be written \(No space left on device: it needs more than the .* MB that are free\)",
    ):
        render_objects(objects_named("first", "second", "third"), tmp_path, SMALL, FlatRenderer(), workers=1)
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["first"]
    assert len(contents(tmp_path / "first")) == 11 + 2 + 1
    monkeypatch.undo()
    resumed = FlatRenderer()
    render_objects(objects_named("first", "second", "third"), tmp_path, SMALL, resumed, workers=1)
    assert resumed.drawn == 2 * 11


# ---------------------------------------------------------------- the files that views are made from


@pytest.fixture
def coloured(tmp_path):
    """`coloured("red", (255, 0, 0))`: a folder with a cube of that colour, as PLY, and as OBJ with its material."""

    def make(place: str, colour: tuple[int, int, int]) -> Path:
        folder = tmp_path / place / "meshes"
        folder.mkdir(parents=True, exist_ok=True)
        box = trimesh.creation.box()
        box.visual.vertex_colors = [*colour, 255]
        box.export(folder / "ply.ply")
        lines = [f"v {x} {y} {z}" for x, y, z in box.vertices] + ["mtllib paint.mtl", "usemtl paint"]
        lines += ["f " + " ".join(str(corner + 1) for corner in face) for face in box.faces]
        (folder / "obj.obj").write_text("\n".join(lines))
        (folder / "paint.mtl").write_text("newmtl paint\nKd {} {} {}\n".format(*(part / 255 for part in colour)))
        return folder

    return make


def views_of(folder: Path, views: Path, renderer: Renderer | None = None) -> MeshData:
    data = MeshData(
        renderer or RaycastRenderer(), str(folder), str(views), resolution=16, test_views=2, train_views=2, workers=1
    )
    data.prepare()
    return data


def seen_colour(views: Path, name: str) -> list[bool]:
    """Whether the first view of an object has red, green, blue in it."""
    pixels = np.asarray(Image.open(views / name / "test" / "rgb" / "000.png"))
    return [bool(pixels[pixels[..., 3] == 255][:, channel].max() > 60) for channel in range(3)]


def test_views_of_other_meshes_with_the_same_names_are_not_reused(coloured, tmp_path):
    views, red, blue = tmp_path / "views", coloured("red", (255, 0, 0)), coloured("blue", (0, 0, 255))
    views_of(red, views)
    assert [seen_colour(views, name) for name in ("ply", "obj")] == [[True, False, False]] * 2
    before = contents(views)
    with pytest.raises(
        UserError, match=rf"2 of 2 .*: obj, ply: the views in {views} were rendered differently \(from another mesh"
    ):
        views_of(blue, views)
    assert contents(views) == before
    views_of(blue, tmp_path / "others")
    assert [seen_colour(tmp_path / "others", name) for name in ("ply", "obj")] == [[False, False, True]] * 2


@pytest.mark.parametrize(("file", "name"), [("ply.ply", "ply"), ("obj.obj", "obj"), ("paint.mtl", "obj")])
def test_a_changed_mesh_or_material_is_detected(coloured, tmp_path, file, name):
    views, red, blue = tmp_path / "views", coloured("red", (255, 0, 0)), coloured("blue", (0, 0, 255))
    views_of(red, views)
    mended = blue / file
    if file == "obj.obj":
        mended.write_text(mended.read_text().replace("v -0.5", "v -0.25"))
    times = (red / file).stat()
    (red / file).write_bytes(mended.read_bytes())
    os.utime(red / file, ns=(times.st_atime_ns, times.st_mtime_ns))  # a mend that keeps size and time
    with pytest.raises(
        UserError, match=rf"1 of . objects could not be rendered: {name}: the views in .* \(from another mesh"
    ):
        views_of(red, views)
    shutil.rmtree(views / name)
    views_of(red, views)


def test_meshes_with_another_axis_up_are_other_views(coloured, tmp_path):
    red = coloured("red", (255, 0, 0))
    data = views_of(red, tmp_path / "views")
    data.up = "z"
    with pytest.raises(UserError, match=r"rendered differently \(from another mesh"):
        data.prepare()


def test_meshes_that_are_the_same_elsewhere_or_beside_other_files_render_nothing_anew(coloured, tmp_path, monkeypatch):
    views, red = tmp_path / "views", coloured("red", (255, 0, 0))
    views_of(red, views)
    record = json.loads((views / "ply" / "render.json").read_text())
    assert set(record["files"]) == {"content", "stamp"}
    load = rendered.load_scene
    monkeypatch.setattr(rendered, "load_scene", lambda path, up: pytest.fail(f"{path} was loaded"))
    views_of(red, views, FlatRenderer(fails_at=0))
    red.rename(tmp_path / "moved")
    views_of(tmp_path / "moved", views, FlatRenderer(fails_at=0))
    monkeypatch.setattr(rendered, "load_scene", load)
    (tmp_path / "moved" / "unused.png").write_bytes(b"not of any mesh")  # the meshes are loaded once, to see so
    for name in ("ply", "obj"):
        older = json.loads((views / name / "render.json").read_text())
        if name == "obj":
            del older["files"]  # as earlier versions left it
        (views / name / "render.json").write_text(json.dumps(older))
    views_of(tmp_path / "moved", views, FlatRenderer(fails_at=0))
    monkeypatch.setattr(rendered, "load_scene", lambda path, up: pytest.fail(f"{path} was loaded"))
    views_of(tmp_path / "moved", views, FlatRenderer(fails_at=0))


def test_a_file_of_labels_holds_for_all_objects_whatever_their_views_were_rendered_with(coloured, tmp_path):
    views, red, labels = tmp_path / "views", coloured("red", (255, 0, 0)), tmp_path / "labels.yaml"

    def ambiguities(text: str) -> list[str]:
        labels.write_text(text)
        data = MeshData(
            RaycastRenderer(), str(red), str(views), str(labels), resolution=16, test_views=2, train_views=2, workers=1
        )
        data.prepare()
        return [data.views(name, "test").ambiguity for name in ("ply", "obj")]

    assert ambiguities("ply: {ambiguity: unique}\nobj: {ambiguity: twofold}") == ["unique", "twofold"]
    with pytest.warns(UserWarning, match="has no label for obj"):
        assert ambiguities("ply: {ambiguity: continuous}") == ["continuous", "unlabelled"]


class Noisy(RaycastRenderer):
    """Warns of what a user cannot act on, and of what a user can."""

    def views(self, *arguments):
        np.log(np.zeros(1))
        warnings.warn("\n the mesh has\n a hole", stacklevel=1)
        return super().views(*arguments)


@pytest.mark.heavy
@pytest.mark.filterwarnings("ignore:the mesh has a hole")
def test_processes_render_what_one_process_does_and_failures_are_listed_at_the_end(tmp_path, capfd):
    painted_box().export(tmp_path / "box.ply")
    vertex_coloured_torus().export(tmp_path / "torus.ply")
    trimesh.creation.box().export(tmp_path / "plain.stl")
    names = {"box": "box.ply", "bad": "missing.ply", "torus": "torus.ply", "plain": "plain.stl", "worse": "box.unknown"}
    objects = [MeshObject(name, "unlabelled", partial(load_scene, tmp_path / file)) for name, file in names.items()]
    for folder, workers in (("one", 1), ("two", 2)):
        with (
            pytest.warns(UserWarning, match=r"plain\.stl: .*no texture") as warned,
            pytest.raises(UserError, match="2 of 5 objects could not be rendered") as caught,
        ):
            render_objects(objects, tmp_path / folder, SMALL, Noisy(), workers=workers)
        assert {str(each.message) for each in warned if "hole" in str(each.message)} == {"the mesh has a hole"}
        assert {each.category for each in warned} == {UserWarning} and capfd.readouterr() == ("", "")
        assert "bad: " in str(caught.value) and "worse: " in str(caught.value)
        assert sorted(path.name for path in (tmp_path / folder).iterdir() if path.is_dir()) == ["box", "plain", "torus"]
    for name in ("box", "plain", "torus"):
        assert contents(tmp_path / "one" / name) == contents(tmp_path / "two" / name)


def test_the_command_prints_one_line_per_problem(lp, tmp_path):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    trimesh.creation.box().export(meshes / "plain.stl")
    (meshes / "nan.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv nan 0 0\nvt nan 0\nf 1/1 2/1 3/1\nf 1/1 2/1 4/1")
    (meshes / "empty.obj").write_text("v 0 0 0")
    (meshes / "text.ply").write_text("not a mesh")
    settings = ("resolution=8", "train_views=1", "test_views=1", "workers=1", "path=meshes")
    ran = lp("render", "renderer=raycast", "data=meshes", *(f"data.{each}" for each in settings))
    said = [line for line in (ran.out + ran.err).splitlines() if not line.startswith("WARNING: meshes/")]
    assert ran.status == 1 and (ran.out + ran.err).count("WARNING: meshes/") == 4
    assert said[0] == "error: 2 of 4 objects could not be rendered:" and len(said) == 3
    assert [line.partition(".")[0] for line in said[1:]] == ["  empty: meshes/empty", "  text: meshes/text"]
