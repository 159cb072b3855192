import json
import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from view_folders import write_object

from lp_framework import registry
from lp_framework.data.module import PairDataModule
from lp_framework.data.sets.omni3d import Omni3DData, omni3d_cameras
from lp_framework.data.views import read_views
from lp_framework.errors import UserError
from lp_framework.geometry import (
    apply_relative_pose,
    camera_to_world,
    relative_pose,
    rotation_error,
    translation_error,
    view_pose,
)

PUBLISHED = Path(__file__).parent / "data" / "idpose.json"  # cameras and results of ID-Pose's published example
POSES = {"011": (0.25, 1.0, 4.0), "001": (0.1, 3.0, 4.0), "077": (-0.2, 5.5, 4.2)}
TO_Z_UP = torch.tensor([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)


def write_images(folder: Path, views: Iterable[str], size: int = 20) -> None:
    """The folders of an object in ID-Pose's layout, an image for each of the views."""
    for each in ("images", "poses"):
        (folder / each).mkdir(parents=True)
    for view in views:
        pixels = np.zeros((size, size, 4), np.uint8)
        pixels[4:-4, 4:-4] = [200, int(view), 30, 255]
        Image.fromarray(pixels).save(folder / "images" / f"{view}.png")


def write_omni3d(root: Path, name: str = "dinosaur_002") -> Path:
    """An object in ID-Pose's layout, its cameras at `POSES`."""
    write_images(root / name, POSES)
    for view, pose in POSES.items():
        np.save(root / name / "poses" / f"{view}.npy", TO_Z_UP @ camera_to_world(torch.tensor(pose).double()))
    return root


@pytest.fixture
def root(tmp_path) -> Path:
    return write_omni3d(tmp_path / "omni3d")


@pytest.fixture
def data(root, tmp_path) -> PairDataModule:
    source = Omni3DData(str(root), str(tmp_path / "views"))
    return PairDataModule(source, cache=str(tmp_path / "cache"), image_size=16)


# ---------------------------------------------------------------- conversion


def test_cameras_keep_their_relative_poses_with_z_up_made_y_up(data, root, tmp_path):
    assert registry.get("data", "omni3d") is Omni3DData
    data.evaluate_on("ordered", 0)
    data.prepare_data()
    views = read_views(tmp_path / "views", "dinosaur_002", "test")
    order = sorted(POSES)
    assert [file.stem for file in views.files] == order
    expected = torch.tensor([POSES[view] for view in order], dtype=torch.float64)
    torch.testing.assert_close(views.poses[:, :2], expected[:, :2], rtol=0, atol=1e-6)
    # The median radius, of 4, 4 and 4.2, becomes 1.85.
    torch.testing.assert_close(views.poses[:, 2], expected[:, 2] * 1.85 / 4, rtol=0, atol=1e-6)
    assert views.field_of_view == pytest.approx(math.radians(49.1))
    batch = next(iter(data.test_dataloader()))
    assert len(batch) == 6 and batch.images.shape[0] == 3


def test_images_are_copied_and_the_download_is_unchanged(data, root, tmp_path):
    before = {file: file.read_bytes() for file in root.rglob("*") if file.is_file()}
    data.evaluate_on("ordered", 0)
    data.prepare_data()
    assert {file: file.read_bytes() for file in root.rglob("*") if file.is_file()} == before
    for view in POSES:
        source = root / "dinosaur_002" / "images" / f"{view}.png"
        assert (tmp_path / "views/dinosaur_002/test/rgb" / source.name).read_bytes() == source.read_bytes()
    stamp = (tmp_path / "views/dinosaur_002/test/transform.json").stat().st_mtime_ns
    data.prepare_data()  # is not converted anew
    assert (tmp_path / "views/dinosaur_002/test/transform.json").stat().st_mtime_ns == stamp


def test_chosen_objects_are_converted_alone(root, tmp_path):
    write_omni3d(root, "dinosaur_003")
    source = Omni3DData(str(root), str(tmp_path / "views"), objects=["dinosaur_003"])
    source.prepare()
    assert source.names() == ["dinosaur_003"] == [each.name for each in (tmp_path / "views").glob("[a-z]*")]


def test_a_folder_of_other_views_is_not_touched(root, data, tmp_path):
    write_object(tmp_path / "views", "dinosaur_002", train=2, test=2)
    data.evaluate_on("ordered", 0)
    with pytest.raises(UserError, match=r"views/dinosaur_002: holds views that were made.*choose another data\.views"):
        data.prepare_data()


def broken(root: Path, view: str = "001") -> tuple[Path, Path]:
    return root / "dinosaur_002" / "poses" / f"{view}.npy", root / "dinosaur_002" / "images" / f"{view}.png"


def no_image(root: Path) -> None:
    broken(root)[1].unlink()


def opaque(root: Path) -> None:
    Image.new("RGB", (20, 20)).save(broken(root)[1])


def oblong(root: Path) -> None:
    Image.new("RGBA", (20, 30)).save(broken(root)[1])


def cut_short(root: Path) -> None:
    broken(root)[0].write_bytes(broken(root)[0].read_bytes()[:90])


def of_another_shape(root: Path) -> None:
    np.save(broken(root)[0], np.eye(3))


def of_complex_numbers(root: Path) -> None:
    np.save(broken(root)[0], np.load(broken(root)[0]) + 0j)


def scaled(root: Path) -> None:
    np.save(broken(root)[0], 2 * np.load(broken(root)[0]))


def y_up(root: Path) -> None:
    np.save(broken(root)[0], TO_Z_UP.T.numpy() @ np.load(broken(root)[0]))


def at_the_centre(root: Path) -> None:
    np.save(broken(root)[0], np.eye(4))


def alone(root: Path) -> None:
    for view in ("011", "077"):
        broken(root, view)[0].unlink()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (no_image, r"images/001\.png: there is no such file"),
        (opaque, r"images/001\.png: has no transparent background"),
        (oblong, r"images/001\.png: is 20 x 30 pixels; views must be square"),
        (cut_short, r"poses/001\.npy: must be a 4 x 4 camera-to-world matrix"),
        (of_another_shape, r"poses/001\.npy: must be a 4 x 4 camera-to-world matrix .*not 3 x 4 finite"),
        (of_complex_numbers, r"poses/001\.npy: must be a 4 x 4 .*Cannot cast"),
        (scaled, r"poses/001\.npy: its camera is not a rigid camera-to-world transform"),
        (y_up, r"poses/001\.npy: its camera does not look at the origin with \+Z up"),
        (at_the_centre, r"poses/001\.npy: its camera must not be at the origin"),
        (alone, r"dinosaur_002/poses: two or more poses \(\*\.npy\) are needed, found 1"),
    ],
)
def test_bad_input(data, root, tmp_path, damage, message):
    damage(root)
    data.evaluate_on("ordered", 0)
    with pytest.raises(UserError, match=message) as caught:
        data.prepare_data()
    assert "\n" not in str(caught.value)
    assert not list((tmp_path / "views").glob("*dinosaur*"))


def test_an_object_that_cannot_be_converted_does_not_stop_the_others(data, root, tmp_path):
    write_omni3d(root, "boat_001")
    opaque(root)
    data.evaluate_on("ordered", 0)
    with pytest.raises(UserError, match=r"1 of 2 objects could not be converted: dinosaur_002: .*transparent"):
        data.prepare_data()
    assert [folder.name for folder in (tmp_path / "views").iterdir() if folder.is_dir()] == ["boat_001"]


def test_there_is_nothing_to_train_on(data):
    with pytest.raises(UserError, match="data=omni3d has test views only, so there is nothing to train on; evaluate"):
        data.prepare_data()
    data.evaluate_on("ifusion", 0)  # takes training views, too
    with pytest.raises(UserError, match="has test views only"):
        data.prepare_data()


def test_wrong_roots(root, tmp_path):
    with pytest.raises(UserError, match=r"nowhere: there is no such folder"):
        Omni3DData(tmp_path / "nowhere").names()
    with pytest.raises(UserError, match=r"looked for .*OBJECT/poses/\*\.npy"):
        Omni3DData(root / "dinosaur_002").names()


# ---------------------------------------------------------------- ID-Pose's published example


@pytest.fixture
def published(tmp_path) -> Path:
    """ID-Pose's published example: its cameras and results, with drawn images."""
    root = tmp_path / "omni3d"
    for name, each in json.loads(PUBLISHED.read_text()).items():
        write_images(root / name, each["poses"])
        for view, camera in each["poses"].items():
            np.save(root / name / "poses" / f"{view}.npy", np.array(camera))
        (root / each["results"]).write_text(json.dumps(each["content"]))
    return root


def test_the_published_results_with_zero123_xl(published):
    """Our errors of its answers, `rel_sph`, in units where the reference stands at 1.85; and its own truths are ours.

    Its polar angles are counted from the pole, our latitudes from the equator.
    """
    rotations, translations = [], []
    for name, example in json.loads(PUBLISHED.read_text()).items():
        cameras, content = omni3d_cameras(published, name), example["content"]
        reference = cameras[content["anchor_vid"]]
        scale = 1.85 / reference[:3, 3].norm()
        for view, entry in content["obs"].items():
            if view == content["anchor_vid"]:
                continue
            pair = torch.stack([reference, cameras[view]])
            pair[:, :3, 3] *= scale
            poses = view_pose(pair)
            polar, azimuth, radius = entry["rel_sph"]
            answer = torch.tensor([-polar, azimuth, radius], dtype=torch.float64)
            found = camera_to_world(apply_relative_pose(poses[0], answer))
            rotations.append(rotation_error(found, pair[1]).item())
            translations.append(translation_error(found, pair[1]).item())
            if "gt_rel_sph" in entry:
                polar, azimuth, _ = entry["gt_rel_sph"]
                assert relative_pose(*poses)[:2].tolist() == pytest.approx([-polar, azimuth], abs=1e-6)
    counts = [sum(rotation <= degrees for rotation in rotations) for degrees in (5, 15, 30)]
    assert (len(rotations), counts) == (9, [3, 8, 8])
    assert np.median(rotations) == pytest.approx(5.903, abs=1e-3)
    assert np.median(translations) == pytest.approx(0.2071, abs=1e-4)


def test_the_published_views_load(published, tmp_path):
    source = Omni3DData(str(published), str(tmp_path / "views"))
    data = PairDataModule(source, cache=str(tmp_path / "cache"), image_size=32)
    data.evaluate_on("ordered", 0)
    data.prepare_data()
    table = data.table("test")
    assert table.counts == [4, 4, 4] and len(table.pairs("ordered")) == 36
    torch.testing.assert_close(table.poses[:, 2], torch.full((12,), 1.85, dtype=torch.float64), rtol=0, atol=1e-6)
