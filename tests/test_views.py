import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from view_folders import FIELD_OF_VIEW, random_poses, transforms, write_object, write_objects, write_split

from lp_framework.data.files import LARGEST_RESIDUAL
from lp_framework.data.views import RenderingsData, read_views
from lp_framework.errors import UserError
from lp_framework.geometry import camera_to_world, rigid_transform, so3_exp

REFERENCE = Path(__file__).parent / "data" / "reference" / "ifusion_poses.json"


def rewrite(path: Path, **changes: object) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def rewrite_frame(path: Path, index: int, **changes: object) -> None:
    content = json.loads(path.read_text())
    content["frames"][index].update(changes)
    path.write_text(json.dumps(content))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The transform.json of an object `cup` with three training views."""
    return write_object(tmp_path, "cup", train=3, test=2) / "train" / "transform.json"


def read(path: Path):
    return read_views(path.parents[2], path.parents[1].name, path.parent.name)


def sentence(path: Path) -> str:
    """What reading says is wrong: one line that names the file."""
    with pytest.raises(UserError) as caught:
        read(path)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message
    return message


# ---------------------------------------------------------------- what loads


def test_views_are_read_back_as_they_were_written(tmp_path):
    write_objects(tmp_path, train=5, test=3)
    assert RenderingsData(tmp_path).names() == ["cup", "tram", "vase"]
    for name, ambiguity, answer in (("cup", "unique", True), ("tram", "twofold", True), ("vase", "continuous", False)):
        for split, count in (("train", 5), ("test", 3)):
            views = read_views(tmp_path, name, split)
            assert len(views) == count and (views.name, views.split) == (name, split)
            assert (views.ambiguity, views.unique_answer) == (ambiguity, answer)
            assert views.files == [tmp_path / name / split / "rgb" / f"{index:03d}.png" for index in range(count)]
            assert views.field_of_view == pytest.approx(FIELD_OF_VIEW)
            poses = torch.from_numpy(random_poses(count, name, split))
            assert views.cameras.dtype == views.poses.dtype == torch.float64
            torch.testing.assert_close(views.cameras, camera_to_world(poses), rtol=0, atol=1e-12)
            torch.testing.assert_close(views.poses, poses, rtol=0, atol=1e-9)


def test_ifusions_published_files_claim_nothing_of_ambiguity(path):
    views = read(path)
    assert views.ambiguity == "unlabelled" and views.unique_answer is None


def test_ifusions_published_cameras_load_with_its_downward_latitudes(tmp_path):
    published = json.loads(REFERENCE.read_text())
    path = write_split(tmp_path / "cup" / "test", random_poses(len(published["latlon_deg"]), "any"))
    content = json.loads(path.read_text())
    for frame, latlon, camera in zip(
        content["frames"], published["latlon_deg"], published["camera_to_world"], strict=True
    ):
        frame.update(latlon=latlon, transform_matrix=camera)
    path.write_text(json.dumps(content))
    down, longitude, radius = np.array(published["latlon_deg"]).T
    poses = read(path).poses.numpy()
    np.testing.assert_allclose(np.degrees(poses[:, 0]), -down, atol=1e-3)
    np.testing.assert_allclose(np.degrees(poses[:, 1]), longitude, atol=1e-3)
    np.testing.assert_allclose(poses[:, 2], radius, atol=1e-5)


@pytest.mark.parametrize("latlon", [[80.0, 10.0, 1.0], [], None, "wrong"])
def test_the_matrix_is_the_truth_whatever_latlon_says(path, latlon):
    expected = read(path).poses
    rewrite_frame(path, 0, latlon=latlon)
    assert torch.equal(read(path).poses, expected)


def test_images_are_looked_for_in_rgb_and_then_beside_the_file(path):
    content = json.loads(path.read_text())
    first, second, _ = content["frames"]
    first["file_path"], second["file_path"] = "rgb/000.png", "./001.png"
    shutil.copy(path.parent / "rgb" / "002.png", path.parent / "002.png")  # rgb/ comes first
    path.write_text(json.dumps(content))
    files = read(path).files
    assert [file.relative_to(path.parent).as_posix() for file in files] == ["rgb/000.png", "rgb/001.png", "rgb/002.png"]


def test_other_encodings_of_json_load(path):
    text = path.read_text()
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert len(read(path)) == 3
    image = path.parent / "rgb" / "vue_été.png"
    (path.parent / "rgb" / "000.png").rename(image)
    path.write_bytes(json.dumps({**json.loads(text)}, ensure_ascii=False).replace("000.png", "vue_été.png").encode())
    assert read(path).files[0] == image


def test_each_view_may_have_its_own_field_of_view(path):
    """`camera_angle_x`, or nerfstudio's and instant-ngp's focal lengths; a frame's own before the file's."""
    rewrite_frame(path, 1, camera_angle_x=0.5)
    rewrite_frame(path, 2, fl_x=16.0, w=16)
    expected = [FIELD_OF_VIEW, 0.5, 2 * math.atan(0.5)]
    assert read(path).field_of_view.dtype == torch.float64
    assert read(path).field_of_view.tolist() == pytest.approx(expected)
    content = json.loads(path.read_text())
    del content["camera_angle_x"]
    focal = 8 / math.tan(FIELD_OF_VIEW / 2)
    path.write_text(json.dumps({**content, "fl_x": focal, "fl_y": focal, "cx": 8.0, "cy": 7.95, "w": 16, "h": 16}))
    assert read(path).field_of_view.tolist() == pytest.approx(expected)
    rewrite(path, camera_angle_x=FIELD_OF_VIEW)
    assert read(path).field_of_view.tolist() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("intrinsics", "message"),
    [
        ({"fl_x": 16.0}, r"needs camera_angle_x .*KeyError: 'w'"),
        ({"fl_x": 0, "w": 16}, r"needs camera_angle_x .*ZeroDivisionError"),
        ({"fl_x": -16.0, "w": 16}, "camera_angle_x must be an angle"),
        ({"fl_x": 16.0, "w": 16, "fl_y": 17.0}, "pixels must be square and their cameras centred"),
        ({"fl_x": 16.0, "w": 16, "cx": 6.0}, "and cx and cy the image's middle"),
        ({"fl_x": 16.0, "w": 16, "cy": math.nan}, "and cx and cy the image's middle"),
        ({"fl_x": 16.0, "w": 16, "camera_angle_x": 0.5}, "camera_angle_x is 0.5, but fl_x and w give 0.9273 radians"),
        ({"camera_angle_x": 49.1}, "must be an angle in radians between 0 and pi, got 49.1"),
        ({"camera_angle_x": None}, "needs camera_angle_x"),
    ],
)
def test_invalid_intrinsics_of_a_frame(path, intrinsics, message):
    rewrite_frame(path, 1, **intrinsics)
    assert re.search(message, sentence(path))


def test_small_deviations_from_spherical_cameras_are_kept(path):
    camera = read(path).cameras[1].clone()
    tilt = torch.tensor([0.0, 0.0, math.radians(0.5 * LARGEST_RESIDUAL)], dtype=torch.float64)
    camera[:3, :3] = camera[:3, :3] @ so3_exp(tilt)
    rewrite_frame(path, 1, transform_matrix=camera.tolist())
    assert torch.equal(read(path).cameras[1], camera)


def test_objects_are_folders_with_a_split_in_them(tmp_path):
    write_object(tmp_path, "cup")
    write_split(tmp_path / "half" / "test", random_poses(2, "half"))
    (tmp_path / "notes").mkdir()
    (tmp_path / ".cup.partial" / "train").mkdir(parents=True)
    (tmp_path / "readme.txt").write_text("hello")
    assert RenderingsData(tmp_path).names() == ["cup", "half"]


# ---------------------------------------------------------------- what does not


def test_a_root_without_views(tmp_path):
    with pytest.raises(UserError, match=r"nowhere: there is no such folder of views.*data\.path"):
        RenderingsData(tmp_path / "nowhere").names()
    with pytest.raises(UserError, match=r"holds no views; looked for .*OBJECT/train/transform\.json"):
        RenderingsData(tmp_path).names()


def test_a_missing_file(path):
    path.unlink()
    assert "there is no such file" in sentence(path)


@pytest.mark.parametrize(
    "text", ["", "{", '{"frames": [', "[1, 2", "\x00", "[" * 100_000, b"\xff\xfe\xfa"], ids=lambda t: repr(t)[:9]
)
def test_files_that_are_not_json(path, text):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert "is not readable JSON" in sentence(path)


@pytest.mark.parametrize("key", ["camera_angle_x", "frames"])
def test_missing_keys(path, key):
    content = json.loads(path.read_text())
    del content[key]
    path.write_text(json.dumps(content))
    assert "needs camera_angle_x and frames with file_path and transform_matrix" in sentence(path)
    assert key in sentence(path).partition("(")[2]


@pytest.mark.parametrize("key", ["file_path", "transform_matrix"])
def test_missing_keys_of_a_frame(path, key):
    content = json.loads(path.read_text())
    del content["frames"][1][key]
    path.write_text(json.dumps(content))
    assert f"'{key}'" in sentence(path)


@pytest.mark.parametrize("angle", [0, -0.8, math.pi, 49.1, math.nan, math.inf])
def test_invalid_fields_of_view(path, angle):
    rewrite(path, camera_angle_x=angle)
    assert "camera_angle_x must be an angle in radians between 0 and pi" in sentence(path)


def test_no_frames(path):
    rewrite(path, frames=[])
    assert "has no frames" in sentence(path)


@pytest.mark.parametrize("ambiguity", ["threefold", None, 2, ["unique"]])
def test_unknown_ambiguities(path, ambiguity):
    rewrite(path, ambiguity=ambiguity)
    assert "is not one of unique, twofold, continuous, unlabelled" in sentence(path)


@pytest.mark.parametrize("answer", ["false", 0, []])
def test_a_unique_answer_is_yes_or_no_or_unknown(path, answer):
    rewrite(path, unique_answer=answer)
    assert "unique_answer must be true, false or null" in sentence(path)


@pytest.mark.parametrize(
    "name", ["777.png", "", ".", "a\nb.png", "\x00", "x" * 5000, "\ud800", None, {}], ids=lambda t: repr(t)[:9]
)
def test_missing_images(path, name):
    rewrite_frame(path, 2, file_path=name)
    assert "is neither in rgb/ nor beside this file" in sentence(path)


def test_a_deleted_image(path):
    (path.parent / "rgb" / "001.png").unlink()
    assert "the image '001.png'" in sentence(path)


GOOD = camera_to_world(torch.tensor([0.3, 1.0, 1.5], dtype=torch.float64))


def changed(row: int, column: int, value: float) -> list[list[float]]:
    matrix = GOOD.clone()
    matrix[row, column] = value
    return matrix.tolist()


def turned(x: float, y: float, z: float) -> list[list[float]]:
    """The good camera turned about its own axes, degrees."""
    turn = so3_exp(torch.deg2rad(torch.tensor([x, y, z], dtype=torch.float64)))
    return rigid_transform(GOOD[:3, :3] @ turn, GOOD[:3, 3]).tolist()


def at(x: float, y: float, z: float) -> list[list[float]]:
    return rigid_transform(GOOD[:3, :3], torch.tensor([x, y, z], dtype=torch.float64)).tolist()


@pytest.mark.parametrize(
    "matrix",
    [
        GOOD[:3].tolist(), GOOD.flatten().tolist(), [GOOD.tolist()], [[1.0], [1.0, 2.0]], [], None, "camera", 1, {},
        [[None] * 4] * 4, [["1"] * 4] * 4, changed(0, 3, math.nan), changed(1, 1, math.inf), [[10**400] * 4] * 4,
    ],
    ids=lambda matrix: repr(matrix)[:20],
)  # fmt: skip
def test_invalid_matrices(path, matrix):
    rewrite_frame(path, 1, transform_matrix=matrix)
    assert "transform_matrix of frame 1 is not a 4 x 4 matrix of finite numbers" in sentence(path)


MIRRORED = GOOD @ torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0], dtype=torch.float64))


@pytest.mark.parametrize(
    "matrix",
    [
        (2 * GOOD).tolist(), changed(0, 0, 0.9), MIRRORED.tolist(), torch.zeros(4, 4).tolist(), changed(3, 3, 2.0),
        changed(3, 0, 0.1), GOOD.mT.tolist(), [[1e308, -1e308, 1e308, 1.0]] * 4,
    ],
    ids=["scaled", "skewed", "mirrored", "zero", "half", "projective", "transposed", "overflowing"],
)  # fmt: skip
def test_matrices_that_are_not_rigid(path, matrix):
    rewrite_frame(path, 1, transform_matrix=matrix)
    assert "the camera of frame 1 is not a rigid camera-to-world transform" in sentence(path)


@pytest.mark.parametrize(
    ("matrix", "degrees"),
    [(turned(5, 0, 0), 5), (turned(0, 5, 0), 5), (turned(0, 0, 30), 30), (turned(0, 0, 180), 180)],
    ids=["looks up", "looks aside", "rolled", "upside down"],
)
def test_cameras_that_do_not_look_at_the_origin_upright(path, matrix, degrees):
    rewrite_frame(path, 2, transform_matrix=matrix)
    message = sentence(path)
    assert "the camera of frame 2 does not look at the origin with +Y up" in message
    assert f"it is {degrees:.1f} degrees off" in message


def test_the_inverse_of_a_camera_is_refused(path):
    rewrite_frame(path, 0, transform_matrix=torch.linalg.inv(GOOD).tolist())
    assert "does not look at the origin" in sentence(path)


@pytest.mark.parametrize("matrix", [at(0, 0, 0), at(1e-9, 0, 0), at(1e300, 1e300, 1e300)])
def test_cameras_at_the_origin_or_nowhere(path, matrix):
    rewrite_frame(path, 1, transform_matrix=matrix)
    assert "the camera of frame 1 must not be at the origin" in sentence(path)


# ---------------------------------------------------------------- whatever comes

scalars = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.just(10**400)
anything = st.recursive(
    scalars, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4)
)


def check_refused_or_sound(path: Path, content: object) -> None:
    path.write_text(json.dumps(content))
    try:
        views = read(path)
    except UserError as error:
        assert str(path) in str(error) and "\n" not in str(error)
        return
    assert len(views) == len(views.cameras) > 0 and views.poses.isfinite().all() and (views.poses[:, 2] > 0).all()
    assert (
        all(file.is_file() for file in views.files)
        and ((views.field_of_view > 0) & (views.field_of_view < math.pi)).all()
    )


@pytest.fixture(scope="module")
def lasting_path(tmp_path_factory) -> Path:
    return write_object(tmp_path_factory.mktemp("views"), "cup", train=2, test=2) / "train" / "transform.json"


@settings(deadline=None, max_examples=150, derandomize=True)
@given(content=anything)
@example(content={"camera_angle_x": 1, "frames": {"file_path": 1}})
@example(content={"camera_angle_x": 10**400, "frames": []})
def test_any_json_is_refused_or_valid(lasting_path, content):
    check_refused_or_sound(lasting_path, content)


@settings(deadline=None, max_examples=250, derandomize=True)
@given(data=st.data(), value=anything)
def test_any_replaced_part_is_refused_or_valid(lasting_path, data, value):
    content = transforms(random_poses(2, "cup", "train"), ambiguity="unique", unique_answer=True)
    part: object = content
    while True:
        assert isinstance(part, (dict, list))
        keys = sorted(part) if isinstance(part, dict) else list(range(len(part)))
        key = data.draw(st.sampled_from(keys))
        if not (isinstance(part[key], (dict, list)) and part[key]) or data.draw(st.integers(0, 3)) == 0:
            part[key] = value
            break
        part = part[key]
    check_refused_or_sound(lasting_path, content)
