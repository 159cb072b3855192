"""Cameras for other programs, read back by those programs or by readers written from their descriptions; and cameras of
photographs, seen through against what a renderer draws."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from colmap_reader import ColmapImage, read_colmap
from numpy.typing import NDArray
from PIL import Image
from scipy.optimize import least_squares
from toy_views import toy_view
from transforms_readers import as_ifusion, as_instant_ngp, as_nerfstudio
from view_folders import FIELD_OF_VIEW, draw_view, random_poses

from lp_framework.data.camera_files import (
    Camera,
    Crop,
    camera_scene,
    colmap_model,
    export_cameras,
    focal_length,
    nerf_transforms,
    photograph_camera,
    seed_points,
    view_cameras,
    write_cameras,
)
from lp_framework.data.photographs import Photograph, crop_to_object
from lp_framework.data.rendering.raycast import RaycastRenderer
from lp_framework.data.toy import toy_objects
from lp_framework.data.views import read_views
from lp_framework.geometry import camera_to_world, rigid_transform, view_pose

DEGREES = 49.1
POSES = torch.from_numpy(
    np.concatenate(
        [
            random_poses(12, "camera files"),
            # The reference as it is by default, half a turn, the poles, beyond a pole.
            [[0, 0, 1.4], [0, math.pi, 1.4], [math.pi / 2, 1, 1], [-math.pi / 2, 2, 1], [2.5, 0.3, 0.7]],
        ]
    )
)
NAMES = [f"{index:03d}.png" for index in range(len(POSES))]
VIEWS = view_cameras([f"images/{name}" for name in NAMES], POSES, 256, DEGREES)
POINTS = trimesh.PointCloud([[0.1, 0.2, 0.3], [-0.4, 0.0, 0.25]], [[255, 0, 7, 255], [1, 2, 3, 255]])


def written(folder: Path, cameras: list[Camera], poses: torch.Tensor | None = None) -> Path:
    """The files of cameras, and images of their sizes."""
    (folder / "images").mkdir(parents=True)
    for camera in cameras:
        Image.new("RGB", (camera.width, camera.height)).save(folder / camera.file)
    write_cameras(folder, cameras, POINTS, poses)
    return folder


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of `VIEWS`."""
    return written(tmp_path_factory.mktemp("views") / "run", VIEWS, POSES)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of `PHOTOGRAPHS`."""
    return written(tmp_path_factory.mktemp("photographs") / "run", PHOTOGRAPHS)


PHOTOGRAPHS = [
    Camera("images/000.jpg", VIEWS[0].matrix, 400.0, 300, 200),
    Camera("images/001.png", VIEWS[1].matrix, 250.5, 200, 301),
    Camera("images/002.jpg", VIEWS[2].matrix, 400.0, 300, 200),
]


# ---------------------------------------------------------------- COLMAP


def test_colmap_has_the_same_cameras():
    cameras, images = read_colmap(colmap_model(VIEWS, POINTS))
    assert [image.name for image in images] == NAMES and {image.camera for image in images} == set(cameras) == {1}
    for image, ours in zip(images, camera_to_world(POSES).numpy(), strict=True):
        np.testing.assert_allclose(-image.rotation.T @ image.translation, ours[:3, 3], atol=1e-9)  # the centre
        right, down, forward = image.rotation  # the camera's axes in the world
        np.testing.assert_allclose(np.stack([right, -down, -forward], axis=1), ours[:3, :3], atol=1e-9)


def test_colmap_sees_the_object_in_the_middle_upright_and_as_large_as_it_should():
    cameras, images = read_colmap(colmap_model(VIEWS[:12], POINTS))
    kind, *numbers = cameras[1]
    width, height, fx, fy, cx, cy = map(float, numbers)
    assert (kind, width, height) == ("PINHOLE", 256, 256)
    assert 2 * math.degrees(math.atan(width / 2 / fx)) == pytest.approx(DEGREES)

    def seen(image: ColmapImage, point: NDArray) -> NDArray:
        x, y, z = image.rotation @ point + image.translation
        assert z > 0  # in front
        return np.array([fx * x / z + cx, fy * y / z + cy])

    for image, camera, (_, longitude, radius) in zip(images, VIEWS, POSES.tolist(), strict=False):
        np.testing.assert_allclose(seen(image, np.zeros(3)), [128, 128], atol=1e-8)
        assert seen(image, np.array([0, 0.1, 0]))[1] < 128  # +Y is up
        sideways = np.array([math.cos(longitude), 0, -math.sin(longitude)])
        u, _ = seen(image, 0.5 * sideways)
        assert u - 128 == pytest.approx(fx * 0.5 / radius)
        anywhere = np.array([0.2, -0.1, 0.3])
        np.testing.assert_allclose(camera.pixels(anywhere), seen(image, anywhere), atol=1e-7)


def test_pycolmap_reads_cameras_points_and_images(views: Path, photographs: Path):
    pycolmap = pytest.importorskip("pycolmap")
    for folder, cameras in ((views, VIEWS), (photographs, PHOTOGRAPHS)):
        model = pycolmap.Reconstruction(folder / "sparse" / "0")
        images = sorted(model.images.values(), key=lambda image: image.name)
        assert len(images) == len(cameras) and len(model.cameras) == len({camera[2:] for camera in cameras})
        for image, camera in zip(images, cameras, strict=True):
            assert (folder / "images" / image.name).is_file() and image.name == Path(camera.file).name
            kind = model.cameras[image.camera_id]
            assert (kind.model_name, kind.width, kind.height) == ("PINHOLE", camera.width, camera.height)
            for point in POINTS.vertices:
                seen = kind.img_from_cam(image.cam_from_world() * point)
                np.testing.assert_allclose(seen, camera.pixels(point), atol=1e-6)
        points = [model.points3D[index] for index in sorted(model.points3D)]
        np.testing.assert_allclose([point.xyz for point in points], POINTS.vertices)
        assert [point.color.tolist() for point in points] == POINTS.colors[:, :3].tolist()


# ---------------------------------------------------------------- transforms.json


def test_nerf_programs_read_what_was_written(views: Path, photographs: Path):
    for folder, cameras in ((views, VIEWS), (photographs, PHOTOGRAPHS)):
        read, points = as_nerfstudio(folder)
        np.testing.assert_allclose(points.vertices, POINTS.vertices, atol=1e-6)
        assert points.colors[:, :3].tolist() == POINTS.colors[:, :3].tolist()
        for each in (read, as_instant_ngp(folder)):
            assert [image.file for image in each] == [folder / camera.file for camera in cameras]
            for image, camera in zip(each, cameras, strict=True):
                np.testing.assert_allclose(image.matrix[:3], camera.matrix[:3], atol=1e-6)
                assert image.size == (camera.width, camera.height)
                assert image.focal == pytest.approx((camera.focal, camera.focal))
                assert image.middle == pytest.approx((camera.width / 2, camera.height / 2))


def test_intrinsics_agree_and_stand_where_programs_look(views: Path, photographs: Path):
    shared = json.loads((views / "transforms.json").read_text())
    own = json.loads((photographs / "transforms.json").read_text())
    assert math.degrees(shared["camera_angle_x"]) == pytest.approx(DEGREES)
    keys = {"camera_angle_x", "fl_x", "fl_y", "cx", "cy", "w", "h"}
    assert keys <= shared.keys() and not keys & own.keys()
    assert all(keys <= frame.keys() for frame in own["frames"])
    for place in (shared, *own["frames"]):
        assert place["fl_x"] == pytest.approx(place["w"] / 2 / math.tan(place["camera_angle_x"] / 2))


def test_ifusion_reads_views_and_its_latlon(views: Path, photographs: Path):
    """Its latitude counts downwards: see `geometry.to_ifusion`."""
    for (file, matrix, latlon), camera, pose in zip(as_ifusion(views), VIEWS, POSES.tolist(), strict=True):
        assert file == views / camera.file
        np.testing.assert_allclose(matrix, camera.matrix)
        degrees = [-math.degrees(pose[0]), math.degrees(pose[1]) % 360, pose[2]]
        assert latlon == pytest.approx(degrees, abs=1e-4)
    assert "latlon" not in (photographs / "transforms.json").read_text()  # they do not look at the object


def test_transforms_are_read_back_as_views(tmp_path: Path):
    count = 12
    split = tmp_path / "cup" / "test"
    (split / "rgb").mkdir(parents=True)
    for name, pose in zip(NAMES[:count], POSES.numpy(), strict=False):
        Image.fromarray(draw_view(pose, 16)).save(split / "rgb" / name)
    content = nerf_transforms(view_cameras(NAMES[:count], POSES[:count], 16, DEGREES), POSES[:count])
    (split / "transform.json").write_text(json.dumps(content))
    views = read_views(tmp_path, "cup", "test")
    torch.testing.assert_close(views.poses, POSES[:count], rtol=0, atol=1e-9)
    assert views.field_of_view == pytest.approx(FIELD_OF_VIEW)
    assert [file.name for file in views.files] == NAMES[:count]


# ---------------------------------------------------------------- seed points

PLACES = [(10, 20), (20, 80), (0, 150), (30, 260), (-10, 330)]  # latitude, longitude


def ball(radius: float, middle: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    """A ball whose colours tell place: red grows along +X, green along +Y, blue along +Z."""
    mesh = trimesh.creation.icosphere(3, radius)
    mesh.visual.vertex_colors = np.rint(255 * (mesh.vertices / radius + 1) / 2).astype(np.uint8)
    mesh.apply_translation(middle)
    return mesh


def test_seed_points_lie_on_the_hull_and_have_the_colours_of_the_images():
    poses = torch.tensor([[math.radians(each) for each in place] + [1.6] for place in PLACES], dtype=torch.float64)
    pixels = RaycastRenderer().render(trimesh.Scene(ball(0.4)), camera_to_world(poses), 128, DEGREES)
    cameras = view_cameras(NAMES[: len(poses)], poses, 128, DEGREES)
    images = [Image.fromarray(each) for each in pixels]
    points = seed_points(cameras, images, [Crop(np.array([64.0, 64.0]), 1.0)] * len(images))
    distance = np.linalg.norm(points.vertices, axis=1)
    assert len(distance) > 1000 and distance.min() > 0.36 and np.median(distance) < 0.44  # five views leave corners
    for camera, image in zip(cameras, images, strict=True):
        column, row = np.floor(camera.pixels(points.vertices)).astype(int).T
        assert (np.asarray(image)[row, column, 3] >= 128).all()
    facing = points.vertices @ cameras[0].matrix[:3, 3] > 0.55 * distance * 1.6
    expected = 255 * (points.vertices[facing] / distance[facing, None] + 1) / 2
    assert np.corrcoef(points.colors[:, :3][facing].ravel(), expected.ravel())[0, 1] > 0.9  # but for light and shade


@pytest.mark.parametrize("kind", ["poses that do not fit", "no background"])
def test_there_are_seed_points_where_masks_leave_nothing(kind: str):
    if kind == "no background":
        images = [Image.new("RGBA", (256, 256), (200, 10, 30, 255))] * 2
    else:  # the object of one view is beside that of the other
        halves = np.zeros((2, 256, 256, 4), np.uint8)
        halves[0, :100], halves[1, -100:] = (200, 10, 30, 255), (200, 10, 30, 255)
        images = [Image.fromarray(half) for half in halves]
    cameras = view_cameras(["a", "b"], torch.tensor([[0, 0, 1.4], [0, 1.5, 1.4]]), 256, DEGREES)
    points = seed_points(cameras, images, [Crop.to(None, (256, 256))] * 2)
    assert len(points.vertices) > 1000 and np.linalg.norm(points.vertices, axis=1).max() < 1
    assert (points.colors[:, :3] == [200, 10, 30]).all(axis=1).mean() > 0.1


# ---------------------------------------------------------------- cameras in a scene


def test_the_scene_has_frusta_at_the_cameras_with_the_images_on_them(tmp_path: Path):
    images = [toy_view("tram", *PLACES[0]).rotate(90 * index) for index in range(5)]
    poses = torch.tensor([[math.radians(each) for each in place] + [1.4] for place in PLACES])
    cameras, names = view_cameras(NAMES[:5], poses, 256, DEGREES), [f"{index} tram.png" for index in range(5)]
    camera_scene(cameras, images, names).export(tmp_path / "cameras.glb")
    scene = trimesh.load(tmp_path / "cameras.glb")
    assert {*scene.graph.nodes_geometry} == {*names, *(f"{name} frustum" for name in names)}
    for camera, image, name in zip(cameras, images, names, strict=True):
        transform, geometry = scene.graph[name]
        np.testing.assert_array_equal(transform, np.eye(4))  # in scene units, which are metres
        picture = scene.geometry[geometry]
        assert np.array_equal(picture.visual.material.baseColorTexture.convert("RGBA"), image)
        assert picture.visual.material.doubleSided and picture.visual.material.metallicFactor == 0
        seen = camera.pixels(picture.vertices) / 256  # a corner of the picture is seen where its texture has it
        np.testing.assert_allclose(seen, picture.visual.uv * [1, -1] + [0, 1], atol=1e-5)
        distance = np.linalg.norm(picture.vertices - camera.matrix[:3, 3], axis=1)
        assert (distance < 0.3 * 1.4).all()
        frustum = scene.geometry[scene.graph[f"{name} frustum"][1]]
        for point in (camera.matrix[:3, 3], *picture.vertices):  # its edges begin and end there
            assert np.linalg.norm(frustum.vertices - point, axis=1).min() < 0.01


# ---------------------------------------------------------------- photographs

SIDE, ANGLE, DISTANCE = 640, 50.0, 2.5  # pixels, degrees, scene units
BALL = ball(0.5)
FILLING = 0.5 / math.sin(math.atan(100 / focal_length(256, DEGREES)))  # the radius at which the ball fills a view


def photographed(
    scene: trimesh.Scene, looks: tuple[float, float], aside: tuple[float, float]
) -> tuple[Camera, Image.Image]:
    """A level camera that is turned like a view's with this latitude and longitude (degrees) and sees the origin so far
    to the right of and below its axis (degrees); and what it takes."""
    turned = camera_to_world(torch.tensor([math.radians(each) for each in looks] + [1.0], dtype=torch.float64))[:3, :3]
    across, down = (math.tan(math.radians(each)) for each in aside)
    towards = torch.nn.functional.normalize(torch.tensor([across, -down, -1.0], dtype=torch.float64), dim=0)
    matrix = rigid_transform(turned, -DISTANCE * turned @ towards)
    photograph = Image.fromarray(RaycastRenderer().render(scene, matrix[None], SIDE, ANGLE)[0])
    return Camera("", matrix.numpy(), focal_length(SIDE, ANGLE), SIDE, SIDE), photograph


def pose_of(camera: Camera, radius: float) -> torch.Tensor:
    """The view pose of a camera, but with another radius."""
    return torch.cat([view_pose(torch.from_numpy(camera.matrix))[:2], torch.tensor([radius], dtype=torch.float64)])


@pytest.mark.parametrize(("looks", "aside"), [((5, 30), (10, 0)), ((30, 100), (10, 0)), ((-20, 200), (-7, 7))])
def test_the_object_is_projected_onto_the_photograph_it_was_cropped_from(
    looks: tuple[float, float], aside: tuple[float, float]
):
    """It stands 10 degrees off the axis."""
    truth, photograph = photographed(trimesh.Scene(BALL), looks, aside)
    pose, expected = pose_of(truth, FILLING), truth.pixels(BALL.vertices)
    assert np.ptp(expected, axis=0).min() > 270
    for cut in (
        0,
        40,
    ):  # pixels to the left and to the right, the second of a portrait whose axis is in its middle, too
        portrait = photograph.crop((cut, 0, SIDE - cut, SIDE))
        camera = photograph_camera(
            "a.png", pose, portrait.size, crop_to_object(portrait, "a").box, truth.focal, DEGREES
        )
        assert (camera.width, camera.height) == portrait.size
        error = camera.pixels(BALL.vertices) + np.array([cut, 0]) - expected
        assert np.linalg.norm(error, axis=1).max() < 2
        np.testing.assert_allclose(camera.matrix, truth.matrix, atol=0.01)


@pytest.mark.parametrize("name", ["lotus_vase", "cottage", "duck", "sailboat"])
def test_the_camera_of_a_crop_projects_any_object_onto_its_photograph(name: str):
    """Relative to the point that the crop is centred at, which an estimate takes for the object's centre."""
    scene = next(each for each in toy_objects() if each.name == name).load()
    truth, photograph = photographed(scene, (15, 60), (10, 0))
    box, points = crop_to_object(photograph, "a").box, scene.to_geometry().vertices
    across, down = np.arctan((np.reshape(box, (2, 2)) - SIDE / 2) / truth.focal).T  # the angles of the box's edges
    middle, half = max(
        (np.mean(across), np.ptp(across) / 2), (np.mean(down), np.ptp(down) / 2), key=lambda each: each[1]
    )
    depth = -np.linalg.inv(truth.matrix)[2, 3]  # of the object's centre
    centre = truth.matrix[:3, :3] @ [depth * math.tan(across.mean()), -depth * math.tan(down.mean()), -depth]
    centre = centre + truth.matrix[:3, 3]
    crop = truth._replace(matrix=truth.matrix.copy())  # relative to that point
    crop.matrix[:3, 3] -= centre
    ball = depth * math.sin(half) / math.cos(middle)
    camera = photograph_camera("a.png", pose_of(crop, FILLING * ball / 0.5), (SIDE, SIDE), box, truth.focal, DEGREES)
    error = camera.pixels(points - centre) - truth.pixels(points)
    assert np.ptp(truth.pixels(points), axis=0).max() > 200
    assert np.linalg.norm(error, axis=1).max() < 0.1


def similarity(
    cameras: list[Camera], points: NDArray[np.float64], pixels: list[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Place the object's points in the cameras' world by a translation and a scale: the errors in pixels, `[V, N]`."""

    def errors(placement: NDArray[np.float64]) -> NDArray[np.float64]:
        placed = points * math.exp(placement[0]) + placement[1:]
        return np.stack([camera.pixels(placed) - seen for camera, seen in zip(cameras, pixels, strict=True)])

    best = least_squares(lambda placement: errors(placement).ravel(), np.zeros(4))
    return np.linalg.norm(errors(best.x), axis=-1)


@pytest.mark.parametrize(("name", "views"), [("lotus_vase", 2), ("watering_can", 2), ("robot", 3), ("suitcase", 6)])
def test_any_object_is_projected_onto_all_photographs_it_was_cropped_from(
    name: str, views: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The object, known up to its position and scale, is 10 degrees off the axis of each photograph."""
    scene = next(each for each in toy_objects() if each.name == name).load()
    points, truths, photographs, poses = scene.to_geometry().vertices, [], {}, []
    for view in range(views):
        aside = 10 * math.cos(2.0 * view), 10 * math.sin(2.0 * view)
        looks = 10 + 20 * math.sin(1.7 * view), 40 + 360 / views * view + 10 * math.sin(3.0 * view)
        truth, image = photographed(scene, looks, aside)
        image.save(tmp_path / f"{view}.png")
        photographs[view] = Photograph(str(tmp_path / f"{view}.png"), image, None, False), crop_to_object(image, "a")
        truths.append(truth)
        poses.append(pose_of(truth, 1.4))
    monkeypatch.setattr("lp_framework.data.camera_files.exif_focal", lambda image: truths[0].focal)
    export_cameras(tmp_path / "out", photographs, torch.stack(poses), DEGREES)
    frames = json.loads((tmp_path / "out" / "original" / "transforms.json").read_text())["frames"]
    written = [truths[0]._replace(matrix=np.array(frame["transform_matrix"])) for frame in frames]
    seen = [truth.pixels(points) for truth in truths]
    assert min(np.ptp(pixels, axis=0).max() for pixels in seen) > 170
    error = similarity(written, points, seen)
    assert (error.mean() if views == 2 else error.max()) < 2
    unmatched = [
        photograph_camera("", pose, (SIDE, SIDE), prepared.box, truths[0].focal, DEGREES)
        for (_, prepared), pose in zip(photographs.values(), poses, strict=True)
    ]
    assert error.mean() < 0.25 * similarity(unmatched, points, seen).mean()
    hull = trimesh.load(tmp_path / "out" / "original" / "sparse_pc.ply").vertices
    for camera, pixels in zip(written, seen, strict=True):  # the visual hull is as large as the object everywhere
        np.testing.assert_allclose(camera.pixels(hull).min(axis=0), pixels.min(axis=0), atol=12)
        np.testing.assert_allclose(camera.pixels(hull).max(axis=0), pixels.max(axis=0), atol=12)


def test_a_view_taken_whole_has_the_camera_of_its_photograph():
    pose = torch.tensor([0.3, 1.0, 1.7])
    (view,) = view_cameras(["a.png"], pose[None], 256, DEGREES)
    camera = photograph_camera("a.png", pose, (800, 800), None, focal_length(800, DEGREES), DEGREES)
    point = np.array([0.1, 0.3, -0.2])
    np.testing.assert_allclose(camera.pixels(point), view.pixels(point) * 800 / 256)
