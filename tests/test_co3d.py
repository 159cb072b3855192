import gzip
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from painted_cube import SIDES, photograph
from PIL import Image

from lp_framework import registry
from lp_framework.data.sets.co3d import CO3DData, mask_pixels, object_frame
from lp_framework.data.sets.converted import Photograph
from lp_framework.data.views import read_views
from lp_framework.errors import UserError
from lp_framework.geometry import camera_to_world, geodesic_angle, rigid_transform, so3_exp, view_pose

SIZE = (200, 240)
WORLD = so3_exp(torch.tensor([2.1, -0.7, 1.3], dtype=torch.float64))  # COLMAP's world in the object's frame
ORIGIN, SCALE = torch.tensor([4.0, -7.0, 2.0], dtype=torch.float64), 3.7
SEQUENCE = "106_12648_23157"


def orbit(count: int, seed: int = 0) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Cameras in the object's frame on an uneven ring around it, a little off-axis and tilted, with intrinsics."""
    random = np.random.default_rng(seed)
    cameras = []
    for index in range(count):
        turn = 2 * math.pi * (index + random.uniform(0, 0.5)) / count
        pose = [random.uniform(0.2, 0.6), turn, random.uniform(2.5, 3.5)]
        camera = camera_to_world(torch.tensor(pose, dtype=torch.float64))
        off = so3_exp(torch.from_numpy(random.uniform([-0.06, -0.06, -0.04], [0.06, 0.06, 0.04])))
        intrinsics = torch.tensor([[260.0, 0, 104], [0, 264.0, 117], [0, 0, 1]], dtype=torch.float64)
        cameras.append((rigid_transform(camera[:3, :3] @ off, camera[:3, 3]), intrinsics))
    return cameras


def in_world(camera: torch.Tensor) -> torch.Tensor:
    return rigid_transform(WORLD @ camera[:3, :3], SCALE * WORLD @ camera[:3, 3] + ORIGIN)


def viewpoint(camera: torch.Tensor, intrinsics: torch.Tensor, isotropic: bool) -> dict:
    """PyTorch3D's account of a camera of the world: X_camera = X R + T, x left, y up, z forward."""
    flip = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64))
    rotation = camera[:3, :3] @ flip
    half = torch.tensor([min(SIZE)] * 2 if isotropic else SIZE, dtype=torch.float64) / 2
    focal = torch.stack([intrinsics[0, 0], intrinsics[1, 1]]) / half
    principal = (torch.tensor(SIZE, dtype=torch.float64) / 2 - intrinsics[:2, 2]) / half
    return {
        "R": rotation.tolist(),
        "T": (-camera[:3, 3] @ rotation).tolist(),
        "focal_length": focal.tolist(),
        "principal_point": principal.tolist(),
        "intrinsics_format": "ndc_isotropic" if isotropic else "ndc_norm_image_bounds",
    }


def write_category(root: Path, category: str = "hydrant", sequence: str = SEQUENCE, views: int = 14) -> Path:
    """A category of CO3Dv2 with one sequence; frame numbers are not those in the names of the files."""
    for folder in ("images", "masks", "depths", "depth_masks"):
        (root / category / sequence / folder).mkdir(parents=True)
    frames, listed = [], []
    for index, (camera, intrinsics) in enumerate(orbit(views)):
        colours, mask = photograph(camera, intrinsics, SIZE)
        image = f"{category}/{sequence}/images/frame{index + 1:06d}.jpg"
        mask_file = f"{category}/{sequence}/masks/frame{index + 1:06d}.png"
        Image.fromarray(colours).save(root / image, quality=98)
        Image.fromarray(mask).save(root / mask_file)
        frames.append(
            {
                "sequence_name": sequence,
                "frame_number": 5 * index,
                "frame_timestamp": 0.1 * index,
                "image": {"path": image, "size": [SIZE[1], SIZE[0]]},
                "mask": {"path": mask_file, "mass": 1.0},
                "viewpoint": viewpoint(in_world(camera), intrinsics, isotropic=index % 2 == 0),
            }
        )
        listed.append([sequence, 5 * index, image])
    frames.append({**frames[0], "sequence_name": "another"})
    write_frames(root, frames, category)
    (root / category / "set_lists").mkdir()
    content = {"train": listed[2:], "val": listed[:1], "test": listed[1:2]}
    (root / category / "set_lists" / "set_lists_manyview_dev_0.json").write_text(json.dumps(content))
    return root


def write_frames(root: Path, frames: list, category: str = "hydrant") -> None:
    with gzip.open(root / category / "frame_annotations.jgz", "wb") as file:
        file.write(json.dumps(frames).encode())


def read_frames(root: Path) -> list:
    with gzip.open(root / "hydrant" / "frame_annotations.jgz") as file:
        return json.loads(file.read())


@pytest.fixture
def root(tmp_path) -> Path:
    return write_category(tmp_path / "co3d")


@pytest.fixture
def make(root, tmp_path):
    def build(**changes) -> CO3DData:
        settings = {"scenes": 1, "train_views": 8, "test_views": 3, "resolution": 64, "image_size": 32}
        views, cache = str(tmp_path / "views"), str(tmp_path / "cache")
        return CO3DData(str(root), **{"views": views, "cache": cache, "validation_views": 0, **settings, **changes})

    return build


# ---------------------------------------------------------------- the object's frame


def test_the_frame_is_found_from_cameras_and_silhouettes(tmp_path):
    cameras, intrinsics, pixels = [], [], []
    for camera, matrix in orbit(24, seed=3):
        Image.fromarray(photograph(camera, matrix, SIZE)[1]).save(tmp_path / "mask.png")
        cameras.append(in_world(camera))
        intrinsics.append(matrix)
        pixels.append(mask_pixels(Photograph(Path("x"), tmp_path / "mask.png", camera, matrix, SIZE)))
    frame = object_frame(torch.stack(cameras), torch.stack(intrinsics), pixels)
    torch.testing.assert_close(frame.axes @ frame.axes.mT, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-12)
    assert frame.axes.det() == pytest.approx(1)
    up = WORLD[:, 1]
    assert math.degrees(torch.acos(frame.axes[1] @ up)) < 1.5
    assert (frame.centre - ORIGIN).norm() / SCALE < 0.06 * max(SIDES)
    assert frame.longest_side.item() == pytest.approx(SCALE * max(SIDES), rel=0.15)
    assert frame.sides.max() == 1 and frame.sides[0] == frame.sides[2]


def test_cameras_on_a_vertical_arc_do_not_tell_up(tmp_path):
    latitudes = torch.linspace(-0.5, 0.5, 6, dtype=torch.float64)
    cameras = camera_to_world(torch.stack([latitudes, torch.ones(6).double(), 3 * torch.ones(6).double()], dim=-1))
    outline = np.array([[90.0, 90.0], [110.0, 110.0], [90.0, 110.0]])
    with pytest.raises(UserError, match="do not go round the object"):
        object_frame(cameras, orbit(1)[0][1].expand(6, 3, 3), [outline] * 6)


# ---------------------------------------------------------------- conversion


def test_views_keep_the_true_relative_poses_but_for_up_and_scale(make, root, tmp_path):
    assert registry.get("data", "co3d") is CO3DData
    data = make()
    data.prepare_data()
    assert data.names() == [f"hydrant-{SEQUENCE}"]
    assert data.table("train").counts == [8] and data.table("test").counts == [3]
    truth, found = [], []
    for split in ("train", "test"):
        frames = json.loads((tmp_path / "views" / data.names()[0] / split / "transform.json").read_text())["frames"]
        for frame in frames:
            camera, intrinsics = orbit(14)[int(Path(frame["source"]).stem[-6:]) - 1]
            truth.append(camera)
            found.append(torch.tensor(frame["photograph_camera"], dtype=torch.float64))
            recorded = torch.tensor(frame["photograph_intrinsics"], dtype=torch.float64)
            torch.testing.assert_close(recorded, intrinsics, rtol=0, atol=1e-9)
            assert frame["perspective_residual"] < 0.15 and frame["turn_degrees"] < 12
    truth, found = torch.stack(truth), torch.stack(found)
    # One rotation of the world, nearly about +Y, takes all true cameras to those found.
    turn = found[:, :3, :3] @ truth[:, :3, :3].mT
    assert torch.rad2deg(geodesic_angle(turn, turn[:1])).max() < 1e-4
    assert math.degrees(math.acos(turn[0, 1, 1])) < 1.5
    distances = found[:, :3, 3].norm(dim=-1) / truth[:, :3, 3].norm(dim=-1)
    assert (distances / distances.median() - 1).abs().max() < 0.03
    views = read_views(tmp_path / "views", data.names()[0], "test")
    assert (view_pose(views.cameras)[:, 2] <= 2.0 + 1e-9).all()
    for file in views.files:
        alpha = np.asarray(Image.open(file))[..., 3] > 128
        rows, columns = np.nonzero(alpha)
        assert abs(rows.min() + rows.max() - 63) < 10 and abs(columns.min() + columns.max() - 63) < 10  # in the middle
        assert 20 < max(np.ptp(rows), np.ptp(columns)) < 64


def test_scenes_are_drawn_once_and_kept(tmp_path):
    root = tmp_path / "co3d"
    for category in ("apple", "hydrant", "toy_bus", "vase"):
        write_category(root, category, views=1)
    settings = {"views": str(tmp_path / "views"), "scenes": 2}
    chosen = CO3DData(str(root), **settings).names()
    assert len(chosen) == 2
    write_category(root, "ball", views=1)
    assert CO3DData(str(root), **settings).names() == chosen
    with pytest.raises(UserError, match="5 objects are there, 29 are needed"):
        CO3DData(str(root), views=str(tmp_path / "others")).names()


def test_truncated_frames_are_left_out_and_the_download_is_left_alone(make, root, tmp_path):
    mask = root / "hydrant" / SEQUENCE / "masks" / "frame000003.png"
    Image.fromarray(np.pad(np.full((100, 100), 255, np.uint8), ((140, 0), (0, 100)))).save(mask)
    Image.new("L", SIZE).save(mask.with_name("frame000004.png"))
    before = {file: file.read_bytes() for file in root.rglob("*") if file.is_file()}
    with pytest.warns(UserWarning, match="1 cut off by the image, 1 with an empty mask are left out"):
        make().prepare_data()
    assert {file: file.read_bytes() for file in root.rglob("*") if file.is_file()} == before
    with pytest.raises(UserError, match=r"has 12 usable views \(1 cut off by the image, 1 with an empty mask"):
        make(views=str(tmp_path / "more"), train_views=12).prepare_data()


# ---------------------------------------------------------------- bad input


def frame_with(**changes):
    def damage(root: Path) -> None:
        frames = read_frames(root)
        viewpoint = {**frames[3]["viewpoint"], **changes.pop("viewpoint", {})}
        frames[3].update({"viewpoint": viewpoint, **changes})
        write_frames(root, frames)

    return damage


ANNOTATIONS, SET_LIST = "frame_annotations.jgz", "set_lists/set_lists_manyview_dev_0.json"


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
        (lambda root: (root / "hydrant" / SET_LIST).write_text("[]"), "is no set list of CO3Dv2"),
        (
            lambda root: (root / "hydrant" / SET_LIST).unlink(),
            r"looked for .*/set_lists/set_lists_manyview_dev_0\.json",
        ),
        (lambda root: write_frames(root, read_frames(root)[1:]), "has no frame 0 of sequence"),
        (frame_with(mask=None), "frame 15 of sequence .* needs image, mask and viewpoint"),
        (frame_with(viewpoint={"R": np.ones((3, 3)).tolist()}), "R is not a rotation"),
        (frame_with(viewpoint={"T": [0, 0]}), "no camera of finite numbers"),
        (frame_with(viewpoint={"focal_length": [0.0, 1.0]}), "focal_length must be positive"),
        (frame_with(viewpoint={"intrinsics_format": "pixels"}), "intrinsics_format 'pixels' is none of"),
        (
            lambda root: (root / "hydrant" / SEQUENCE / "images/frame000002.jpg").unlink(),
            "000002.jpg: there is no such",
        ),
        (
            lambda root: Image.new("L", (10, 12)).save(root / "hydrant" / SEQUENCE / "masks/frame000002.png"),
            r"frame000002\.png: is 10 x 12 pixels, the photograph should be 200 x 240",
        ),
    ],
)
def test_damaged_data(make, root, tmp_path, damage, message):
    damage(root)
    with pytest.raises(UserError, match=message) as caught:
        make().prepare_data()
    assert "\n" not in str(caught.value)
    assert not list((tmp_path / "views").glob("*hydrant*"))


def test_a_wrong_root(root, tmp_path):
    with pytest.raises(UserError, match="nowhere: there is no such folder"):
        CO3DData(str(tmp_path / "nowhere"), views=str(tmp_path / "views")).names()
    with pytest.raises(UserError, match="looked for"):
        CO3DData(str(root / "hydrant"), views=str(tmp_path / "views")).names()
