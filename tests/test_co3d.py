import gzip
import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from co3d_layout import (
    ORIGIN,
    SCALE,
    SEQUENCE,
    SIZE,
    WORLD,
    box_points,
    in_world,
    orbit,
    viewpoint,
    write_category,
    write_frames,
    write_sequences,
)
from painted_cube import SIDES, photograph
from PIL import Image

from lp_framework import registry
from lp_framework.data.real_cameras import agreeing_views, fitting_views, frame_of_points, frame_of_silhouettes
from lp_framework.data.sets.co3d import CO3DData, mask_pixels, read_points
from lp_framework.data.sets.converted import Photograph
from lp_framework.data.views import read_views
from lp_framework.errors import UserError
from lp_framework.geometry import (
    camera_to_world,
    geodesic_angle,
    rigid_transform,
    so3_exp,
    view_pose,
    wrap_angle,
)


def read_frames(root: Path) -> list:
    with gzip.open(root / "hydrant" / "frame_annotations.jgz") as file:
        return json.loads(file.read())


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> Path:
    return write_category(tmp_path_factory.mktemp("drawn") / "co3d")


@pytest.fixture
def root(drawn, tmp_path) -> Path:
    return shutil.copytree(drawn, tmp_path / "co3d")


@pytest.fixture
def make(root, tmp_path):
    def build(**changes) -> CO3DData:
        settings = {"scenes": 1, "train_views": 8, "test_views": 3, "resolution": 64}
        return CO3DData(str(root), **{"views": str(tmp_path / "views"), **settings, **changes})

    return build


# ---------------------------------------------------------------- the object's frame


@pytest.fixture(scope="module")
def seen_cameras(tmp_path_factory) -> tuple[torch.Tensor, torch.Tensor, list]:
    """Cameras in the world, intrinsics, and outlines of the box in photographs by them."""
    cameras, intrinsics, pixels, mask = [], [], [], tmp_path_factory.mktemp("seen") / "mask.png"
    for camera, matrix in orbit(24, seed=3):
        Image.fromarray(photograph(camera, matrix, SIZE)[1]).save(mask)
        cameras.append(in_world(camera))
        intrinsics.append(matrix)
        pixels.append(mask_pixels(Photograph(Path("x"), mask, camera, matrix, SIZE)))
    return torch.stack(cameras), torch.stack(intrinsics), pixels


def test_the_frame_is_found_from_cameras_and_silhouettes(seen_cameras):
    frame = frame_of_silhouettes(*seen_cameras)
    torch.testing.assert_close(frame.axes @ frame.axes.mT, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-12)
    assert frame.axes.det() == pytest.approx(1)
    up = WORLD[:, 1]
    assert math.degrees(torch.acos(frame.axes[1] @ up)) < 1.5
    assert (frame.centre - ORIGIN).norm() / SCALE < 0.06 * max(SIDES)
    assert frame.longest_side.item() == pytest.approx(SCALE * max(SIDES), rel=0.15)
    assert frame.sides.max() == 1 and frame.sides[0] == frame.sides[2]


def test_a_point_cloud_with_strays_gives_a_better_frame(seen_cameras):
    cameras, intrinsics, pixels = seen_cameras
    frame = frame_of_points(cameras, box_points())
    torch.testing.assert_close(frame.axes @ frame.axes.mT, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-12)
    assert frame.axes.det() == pytest.approx(1)
    assert math.degrees(torch.acos(frame.axes[1] @ WORLD[:, 1])) < 1.5
    assert (frame.centre - ORIGIN).norm() / SCALE < 0.01 * max(SIDES)
    assert frame.longest_side.item() == pytest.approx(SCALE * max(SIDES), rel=0.03)
    # Its own axes are the box's, whichever way round.
    along = (frame.axes @ WORLD).abs()
    assert sorted(along.argmax(dim=1).tolist()) == [0, 1, 2] and (along.amax(dim=1) > 0.999).all()
    sides = torch.tensor(SIDES, dtype=torch.float64)[along.argmax(dim=1)]
    torch.testing.assert_close(frame.sides, sides, rtol=0, atol=0.03)
    assert fitting_views(cameras, intrinsics, pixels, box_points()).all()


def test_a_point_cloud_of_another_object_does_not_match_the_silhouettes(seen_cameras):
    cameras, intrinsics, pixels = seen_cameras
    points = box_points()
    for others in (points + 0.5 * SCALE, (points - ORIGIN) * 2 + ORIGIN, (points - ORIGIN) / 2 + ORIGIN):
        assert fitting_views(cameras, intrinsics, pixels, others).double().mean() < 0.2
    with pytest.raises(ValueError, match="its point cloud has no extent"):
        frame_of_points(cameras, points[:1].expand(9, 3))


def wrong_cameras(camera: torch.Tensor) -> dict[str, torch.Tensor]:
    """Cameras that reconstructions give where they fail; `camera` is the right one, in the world."""
    random = so3_exp(torch.tensor([0.4, 1.9, -0.8], dtype=torch.float64))
    about = so3_exp(torch.tensor([0.1, -0.5, 0.2], dtype=torch.float64))
    far = ORIGIN + 6 * (camera[:3, 3] - ORIGIN)
    return {
        "turned": rigid_transform(random @ camera[:3, :3], camera[:3, 3]),
        "turned a little": rigid_transform(about @ camera[:3, :3], camera[:3, 3]),
        "turned away": rigid_transform(camera[:3, :3] * torch.tensor([-1.0, 1.0, -1.0]), camera[:3, 3]),
        "elsewhere": rigid_transform(camera[:3, :3], camera[:3, 3] + 3 * SCALE * random[0]),
        "of another world": rigid_transform(random, 50 * SCALE * random[1]),
        "far away": rigid_transform(camera[:3, :3], far),
        "among the points": rigid_transform(camera[:3, :3], ORIGIN + 0.2 * SCALE * random[2]),
    }


WRONG = tuple(wrong_cameras(torch.eye(4, dtype=torch.float64)))


@pytest.mark.parametrize("kind", WRONG)
def test_a_wrong_camera_is_detected_by_the_cloud_and_by_the_other_cameras(seen_cameras, kind):
    cameras, intrinsics, pixels = seen_cameras
    for index in (0, 7, 23):
        damaged = cameras.clone()
        damaged[index] = wrong_cameras(cameras[index])[kind]
        expected = [number != index for number in range(24)]
        assert fitting_views(damaged, intrinsics, pixels, box_points()).tolist() == expected
        assert agreeing_views(damaged, intrinsics, pixels).tolist() == expected


def test_several_wrong_cameras_among_few_are_detected(seen_cameras):
    cameras, intrinsics, pixels = (each[::3] for each in seen_cameras)
    damaged = cameras.clone()
    for index, kind in ((1, "turned"), (4, "elsewhere"), (6, "turned a little")):
        damaged[index] = wrong_cameras(cameras[index])[kind]
    expected = [index not in (1, 4, 6) for index in range(8)]
    assert fitting_views(damaged, intrinsics, pixels, box_points()).tolist() == expected
    assert agreeing_views(damaged, intrinsics, pixels).tolist() == expected


def test_a_camera_turned_on_its_side_does_not_change_the_up_direction(seen_cameras):
    cameras = seen_cameras[0].clone()
    for degrees in (45, 90):
        roll = so3_exp(torch.tensor([0.0, 0.0, math.radians(degrees)], dtype=torch.float64))
        cameras[5, :3, :3] = seen_cameras[0][5, :3, :3] @ roll
        assert math.degrees(torch.acos(frame_of_points(cameras, box_points()).axes[1] @ WORLD[:, 1])) < 1.5


def test_cameras_on_a_vertical_arc_leave_the_up_direction_undetermined(tmp_path):
    latitudes = torch.linspace(-0.5, 0.5, 6, dtype=torch.float64)
    cameras = camera_to_world(torch.stack([latitudes, torch.ones(6).double(), 3 * torch.ones(6).double()], dim=-1))
    outline = np.array([[90.0, 90.0], [110.0, 110.0], [90.0, 110.0]])
    with pytest.raises(ValueError, match="do not go around the object"):
        frame_of_silhouettes(cameras, orbit(1)[0][1].expand(6, 3, 3), [outline] * 6)


# ---------------------------------------------------------------- conversion


@pytest.mark.parametrize(("cloud", "residual", "spread"), [(True, 0.15, 0.01), (False, 0.15, 0.03)])
def test_views_keep_the_true_relative_poses_but_for_up_and_scale(root, tmp_path, cloud, residual, spread):
    assert registry.get("data", "co3d") is CO3DData
    if not cloud:
        (root / CLOUD).unlink()
    data = CO3DData(str(root), str(tmp_path / "views"), scenes=1, train_views=8, test_views=3, resolution=64)
    data.prepare()
    assert data.names() == [f"hydrant-{SEQUENCE}"]
    assert [len(data.views(data.names()[0], split)) for split in ("train", "test")] == [8, 3]
    truth, found = [], []
    for split in ("train", "test"):
        frames = json.loads((tmp_path / "views" / data.names()[0] / split / "transform.json").read_text())["frames"]
        for frame in frames:
            camera, intrinsics = orbit(14)[int(Path(frame["source"]).stem[-6:]) - 1]
            truth.append(camera)
            found.append(torch.tensor(frame["photograph_camera"], dtype=torch.float64))
            recorded = torch.tensor(frame["photograph_intrinsics"], dtype=torch.float64)
            torch.testing.assert_close(recorded, intrinsics, rtol=0, atol=1e-9)
            assert frame["perspective_residual"] < residual and frame["turn_degrees"] < 12
    truth, found = torch.stack(truth), torch.stack(found)
    # One rotation of the world, nearly about +Y, takes all true cameras to those found.
    turn = found[:, :3, :3] @ truth[:, :3, :3].mT
    assert torch.rad2deg(geodesic_angle(turn, turn[:1])).max() < 1e-4
    assert math.degrees(math.acos(turn[0, 1, 1])) < 1.5
    distances = found[:, :3, 3].norm(dim=-1) / truth[:, :3, 3].norm(dim=-1)
    assert (distances / distances.median() - 1).abs().max() < spread
    if cloud:  # the unit is the longest side, which is 1
        assert (distances - 1).abs().max() < 0.03
    views = read_views(tmp_path / "views", data.names()[0], "test")
    assert (view_pose(views.cameras)[:, 2] <= 2.0 + 1e-9).all()
    for file in views.files:
        alpha = np.asarray(Image.open(file))[..., 3] > 128
        rows, columns = np.nonzero(alpha)
        assert abs(rows.min() + rows.max() - 63) < 10 and abs(columns.min() + columns.max() - 63) < 10  # in the middle
        assert 20 < max(np.ptp(rows), np.ptp(columns)) < 64
    record = json.loads((tmp_path / "views" / data.names()[0] / "conversion.json").read_text())
    assert record["object_frame"] == ("point cloud" if cloud else "silhouettes")
    assert record["viewpoint_quality_score"] == 2.5 and record["point_cloud_quality_score"] == 1.7


def test_masks_of_zeros_and_ones_select_the_same_pixels(make, root):
    name = f"hydrant-{SEQUENCE}"
    pixels = [mask_pixels(each) for each in make().photographs(name).photographs]
    for file in (root / "hydrant" / SEQUENCE / "masks").glob("*.png"):
        Image.fromarray((np.asarray(Image.open(file)) > 0).astype(np.uint8)).save(file)
    again = [mask_pixels(each) for each in make().photographs(name).photographs]
    assert len(pixels) == 14 and all(map(np.array_equal, pixels, again))


@pytest.mark.parametrize(("kind", "cloud"), [("turned", True), ("elsewhere", False), ("far away", True)])
def test_one_wrong_camera_is_left_out_by_name_and_changes_no_other_view(make, root, tmp_path, kind, cloud):
    if not cloud:
        (root / CLOUD).unlink()
    right = make(views=str(tmp_path / "right"), train_views=9, test_views=4).photographs(f"hydrant-{SEQUENCE}")
    frames = read_frames(root)
    camera, intrinsics = orbit(14)[8]
    frames[8]["viewpoint"] = viewpoint(wrong_cameras(in_world(camera))[kind], intrinsics, isotropic=True)
    write_frames(root, frames)
    data = make(train_views=9, test_views=4)
    reason = "whose camera or mask does not fit the others' (frame000009.jpg)"
    with pytest.warns(UserWarning, match=re.escape(f"object 'hydrant-{SEQUENCE}': 1 {reason} are left out")):
        data.prepare()
    record = json.loads((tmp_path / "views" / f"hydrant-{SEQUENCE}" / "conversion.json").read_text())
    assert record["object_frame"] == ("point cloud" if cloud else "silhouettes") and record["left_out"] == {reason: 1}
    poses = {each.file.name: view_pose(each.camera) for each in right.photographs}
    found = {each.file.name: view_pose(each.camera) for each in data.photographs(f"hydrant-{SEQUENCE}").photographs}
    assert poses.keys() - found.keys() == {"frame000009.jpg"}
    latitude, longitude, distance = torch.stack([found[name] - poses[name] for name in found]).unbind(-1)
    # Which way is forward is free, and up is that of fewer cameras.
    assert latitude.abs().max() < math.radians(1) and wrap_angle(longitude - longitude[0]).abs().max() < math.radians(2)
    distances = torch.stack([poses[name][2] for name in found])
    assert (distance / distances).abs().max() < (0.01 if cloud else 0.05)


def test_sequences_without_scores_or_a_cloud(make, root, tmp_path):
    (_, annotation) = json.loads(gzip.decompress((root / "hydrant" / "sequence_annotations.jgz").read_bytes()))
    write_sequences(root, [{**annotation, "point_cloud": None, "viewpoint_quality_score": math.nan}])
    make().prepare()
    record = json.loads((tmp_path / "views" / f"hydrant-{SEQUENCE}" / "conversion.json").read_text())
    assert record["object_frame"] == "silhouettes"
    assert record["viewpoint_quality_score"] is None is record["point_cloud_quality_score"]


def test_a_cloud_that_does_not_agree_with_the_silhouettes_is_not_used(make, root, tmp_path):
    trimesh.PointCloud(10 * box_points().numpy()).export(root / "hydrant" / SEQUENCE / "pointcloud.ply")
    make().prepare()
    record = json.loads((tmp_path / "views" / f"hydrant-{SEQUENCE}" / "conversion.json").read_text())
    assert record["object_frame"] == "silhouettes"


def test_scenes_are_drawn_once_and_kept(tmp_path):
    root = tmp_path / "co3d"
    for category, subset in (("apple", "manyview_dev_0"), ("vase", "manyview_dev_1"), ("toy_bus", "manyview_dev_1")):
        write_category(root, category, views=1, subset=subset)
    write_category(root, "kite", views=1, subset="manyview_test_0")
    settings = {"views": str(tmp_path / "views"), "scenes": 2}
    of_all = CO3DData(str(root), views=str(tmp_path / "all"), scenes=3).names()
    assert of_all == [f"{category}-{SEQUENCE}" for category in ("apple", "toy_bus", "vase")]
    of_test = CO3DData(str(root), views=str(tmp_path / "test"), subsets=["manyview_test_0"], scenes=1).names()
    assert of_test == [f"kite-{SEQUENCE}"]
    chosen = CO3DData(str(root), **settings).names()
    assert len(chosen) == 2
    write_category(root, "ball", views=1)
    assert CO3DData(str(root), **settings).names() == chosen
    names = [f"vase-{SEQUENCE}", f"ball-{SEQUENCE}"]
    assert CO3DData(str(root), **settings, objects=names).names() == names[::-1]
    with pytest.raises(UserError, match=rf"there is no 'bal-{SEQUENCE}' in .*did you mean 'ball-{SEQUENCE}'"):
        CO3DData(str(root), **settings, objects=[f"bal-{SEQUENCE}"]).names()
    with pytest.raises(UserError, match="found 4 objects, but 29 are needed"):
        CO3DData(str(root), views=str(tmp_path / "others")).names()


def test_truncated_frames_are_skipped_and_the_download_is_unchanged(make, root, tmp_path):
    mask = root / "hydrant" / SEQUENCE / "masks" / "frame000003.png"
    Image.fromarray(np.pad(np.full((100, 100), 255, np.uint8), ((140, 0), (0, 100)))).save(mask)
    Image.new("L", SIZE).save(mask.with_name("frame000004.png"))
    Image.new("RGB", SIZE).save(mask.parents[1] / "images" / "frame000007.jpg")  # as the challenge's targets are
    before = {file: file.read_bytes() for file in root.rglob("*") if file.is_file()}
    with pytest.warns(UserWarning, match="1 all black, 1 cut off by the image, 1 with an empty mask are left out"):
        make().prepare()
    assert {file: file.read_bytes() for file in root.rglob("*") if file.is_file()} == before
    with pytest.raises(UserError, match=r"has 11 usable views \(1 all black, 1 cut off by the image, 1 with"):
        make(views=str(tmp_path / "more"), train_views=12).prepare()


# ---------------------------------------------------------------- bad input


def frame_with(**changes):
    def damage(root: Path) -> None:
        frames = read_frames(root)
        viewpoint = {**frames[3]["viewpoint"], **changes.pop("viewpoint", {})}
        frames[3].update({"viewpoint": viewpoint, **changes})
        write_frames(root, frames)

    return damage


def sequence_with(**changes):
    def damage(root: Path) -> None:
        annotation = {"sequence_name": SEQUENCE, "point_cloud": None, "viewpoint_quality_score": 1.0, **changes}
        write_sequences(root, [annotation])

    return damage


def cut_short(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-500])


ANNOTATIONS, SET_LIST = "frame_annotations.jgz", "set_lists/set_lists_manyview_dev_0.json"
CLOUD = Path("hydrant", SEQUENCE, "pointcloud.ply")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda root: (root / "hydrant" / ANNOTATIONS).unlink(), r"frame_annotations\.jgz: there is no such file"),
        (lambda root: (root / "hydrant" / ANNOTATIONS).write_bytes(b"no"), "is not readable gzipped JSON"),
        (
            lambda root: (root / "hydrant" / ANNOTATIONS).write_bytes(
                (root / "hydrant" / ANNOTATIONS).read_bytes()[:99]
            ),
            "is not readable gzipped JSON",
        ),
        (lambda root: (root / "hydrant" / SET_LIST).write_text("[]"), "is not a set list of CO3Dv2"),
        (
            lambda root: (root / "hydrant" / SET_LIST).unlink(),
            r"looked for .*/set_lists/set_lists_manyview_dev_0\.json",
        ),
        (lambda root: write_frames(root, read_frames(root)[1:]), "has no frame 0 of sequence"),
        (
            lambda root: (root / "hydrant" / "sequence_annotations.jgz").unlink(),
            r"sequence_annotations\.jgz: there is no such file",
        ),
        (lambda root: cut_short(root / "hydrant" / "sequence_annotations.jgz"), "is not readable gzipped JSON"),
        (lambda root: write_sequences(root, []), rf"sequence_annotations\.jgz: has no sequence '{SEQUENCE}'"),
        (sequence_with(point_cloud="none"), "needs point_cloud with path and quality_score, or null"),
        (sequence_with(viewpoint_quality_score=[]), "and viewpoint_quality_score"),
        (lambda root: (root / CLOUD).write_bytes(b"ply"), r"pointcloud\.ply: does not load as a point cloud"),
        (lambda root: (root / CLOUD).write_bytes(b""), r"pointcloud\.ply: does not load as a point cloud"),
        (frame_with(mask=None), "frame 15 of sequence .* needs image, mask and viewpoint"),
        (frame_with(viewpoint={"R": np.ones((3, 3)).tolist()}), "the rotation of its camera is not a rotation"),
        (frame_with(viewpoint={"T": [0, 0]}), "T of 3.*not 3 finite numbers"),
        (frame_with(viewpoint={"focal_length": [0.0, 1.0]}), "its focal lengths must be positive"),
        (frame_with(viewpoint={"intrinsics_format": "pixels"}), "intrinsics_format ndc_isotropic or .*'pixels'"),
        (
            lambda root: (root / "hydrant" / SEQUENCE / "images/frame000002.jpg").unlink(),
            "000002.jpg: there is no such",
        ),
        (
            lambda root: Image.new("L", (10, 12)).save(root / "hydrant" / SEQUENCE / "masks/frame000002.png"),
            r"frame000002\.png: is 10 x 12 pixels, but the photograph should be 200 x 240",
        ),
    ],
)
def test_damaged_data(make, root, tmp_path, damage, message):
    damage(root)
    with pytest.raises(UserError, match=message) as caught:
        make().prepare()
    assert "\n" not in str(caught.value)
    assert not list((tmp_path / "views").glob("*hydrant*"))


def test_points_of_a_cloud(tmp_path):
    points = box_points(50).numpy()
    trimesh.PointCloud(points).export(tmp_path / "cloud.ply")
    torch.testing.assert_close(read_points(tmp_path / "cloud.ply"), torch.from_numpy(points), rtol=0, atol=1e-5)
    for wrong in (points[:2], np.where(points > 3, np.nan, points)):
        trimesh.PointCloud(wrong).export(tmp_path / "cloud.ply")
        with pytest.raises(UserError, match=r"cloud\.ply: does not load as a point cloud of three or more points"):
            read_points(tmp_path / "cloud.ply")


def test_a_wrong_root(root, tmp_path):
    with pytest.raises(UserError, match="nowhere: there is no such folder"):
        CO3DData(str(tmp_path / "nowhere"), views=str(tmp_path / "views")).names()
    with pytest.raises(UserError, match="looked for"):
        CO3DData(str(root / "hydrant"), views=str(tmp_path / "views")).names()
