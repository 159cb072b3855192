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
from lp_framework.geometry import camera_to_world, relative_pose, view_pose
from lp_framework.report import idpose_results
from lp_framework.report.idpose_results import evaluate_idpose, read_idpose_results

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


def test_images_are_copied_and_the_download_is_left_alone(data, root, tmp_path):
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


def test_a_folder_of_other_views_is_not_touched(root, data, tmp_path):
    write_object(tmp_path / "views", "dinosaur_002", train=2, test=2)
    data.evaluate_on("ordered", 0)
    with pytest.raises(UserError, match=r"views/dinosaur_002: holds other views.*choose another data\.views"):
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
        (at_the_centre, r"poses/001\.npy: its camera must stand off the origin"),
        (alone, r"dinosaur_002/poses: two or more poses \(\*\.npy\) are needed, 1 are there"),
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


# ---------------------------------------------------------------- ID-Pose's results


def write_results(folder: Path, off: tuple[float, float, float]) -> Path:
    """A result of ID-Pose that is `off` (polar angle, azimuth, radius as the file has them) for every view."""
    anchor, *others = POSES
    obs: dict[str, dict] = {anchor: {"elev": 1.2}}
    for view in others:
        latitude, longitude, radius = (b - a for a, b in zip(POSES[anchor], POSES[view], strict=True))
        truth = (-latitude, longitude % (2 * math.pi), radius * 1.85 / POSES[anchor][2])
        obs[view] = {"rel_sph": [a + b for a, b in zip(truth, off, strict=True)]}
    path = folder / f"dinosaur_002_{'+'.join(POSES)}" / "pose.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"anchor_vid": anchor, "obs": obs}))
    return path


def test_true_poses_have_no_error(root, tmp_path):
    write_results(tmp_path / "outputs", (0.0, 0.0, 0.0))
    result = evaluate_idpose(tmp_path / "outputs", root)
    assert result["pairs"] == 2 and result["metrics"]["R@5"] == 1
    assert result["metrics"]["rotation_error"] < 1e-4 and result["metrics"]["translation_error"] < 1e-5


@pytest.mark.parametrize("off", [(math.radians(3), 0.0, 0.0), (0.0, 0.0, 0.5)])
def test_errors_are_in_degrees_and_in_units_where_the_reference_stands_at_185(root, tmp_path, off):
    write_results(tmp_path / "outputs", off)
    metrics = evaluate_idpose(tmp_path / "outputs", root)["metrics"]
    assert metrics["rotation_error"] == pytest.approx(math.degrees(off[0]), abs=1e-4)
    if off[2]:
        assert metrics["translation_error"] == pytest.approx(off[2], abs=1e-5)
    else:
        chord = 2 * math.sin(off[0] / 2)  # of unit radius; the queries stand at 1.85 and 1.85 * 4.2 / 4
        assert metrics["translation_error"] == pytest.approx(chord * 1.85 * (1 + 1.05) / 2, abs=1e-5)


def test_results_are_relative_poses(root, tmp_path):
    write_results(tmp_path / "outputs", (0.0, 0.0, 0.0))
    found = read_idpose_results(tmp_path / "outputs", Omni3DData(root).names())
    assert [pair[:3] for pair in found] == [("dinosaur_002", "011", "001"), ("dinosaur_002", "011", "077")]
    cameras = omni3d_cameras(root, "dinosaur_002")
    poses = {view: view_pose(camera) for view, camera in cameras.items()}
    for pair in found:
        expected = relative_pose(poses["011"], poses[pair.query])
        torch.testing.assert_close(pair.pose, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "needs anchor_vid"),
        ("[]", "needs anchor_vid"),
        ('{"anchor_vid": "011", "obs": {"001": {}}}', r"needs anchor_vid.*rel_sph"),
        ('{"anchor_vid": "011", "obs": {"001": {"rel_sph": [1, 2]}}}', "three numbers"),
        ('{"anchor_vid": "012", "obs": {"001": {"rel_sph": [1, 2, 3]}}}', "its name tells none of the objects"),
        ('{"anchor_vid": "011", "obs": {"002": {"rel_sph": [1, 2, 3]}}}', r"poses/002\.npy is missing"),
    ],
)
def test_malformed_results(root, tmp_path, content, message):
    write_results(tmp_path / "outputs", (0.0, 0.0, 0.0)).write_text(content)
    with pytest.raises(UserError, match=message):
        evaluate_idpose(tmp_path / "outputs", root)


def test_a_folder_without_results(root, tmp_path, capsys):
    assert idpose_results.main([str(tmp_path), str(root)]) == 2
    assert "holds no results of ID-Pose" in capsys.readouterr().err


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


def test_the_published_results_with_zero123_xl(published, capsys):
    result = evaluate_idpose(published, published)
    assert result["pairs"] == 9 and sorted(result["per_object"]) == ["dinosaur_002", "house_001", "ornaments_001"]
    metrics = result["metrics"]
    assert [metrics[key] * 9 for key in ("R@5", "R@15", "R@30")] == pytest.approx([3, 4, 4])
    assert [metrics[key] * 9 for key in ("R(R)@5", "R(R)@15", "R(R)@30")] == pytest.approx([3, 8, 8])
    assert metrics["rotation_error"] == pytest.approx(5.903, abs=1e-3)
    assert metrics["translation_error"] == pytest.approx(0.2071, abs=1e-4)
    # The file has its own account of the truth.
    found = read_idpose_results(published, Omni3DData(published).names())
    for file in published.glob("*.json"):
        for view, entry in json.loads(file.read_text())["obs"].items():
            if "gt_rel_sph" in entry:
                name = next(name for name in Omni3DData(published).names() if name in file.name)
                cameras = omni3d_cameras(published, name)
                (pair,) = [each for each in found if (each.object, each.query) == (name, view)]
                truth = relative_pose(view_pose(cameras[pair.reference]), view_pose(cameras[view]))
                polar, azimuth, _ = entry["gt_rel_sph"]
                assert truth[:2].tolist() == pytest.approx([-polar, azimuth], abs=1e-6)
    assert idpose_results.main([str(published), str(published)]) == 0
    assert "ID-Pose, 9 pairs" in capsys.readouterr().out


def test_the_published_views_load(published, tmp_path):
    source = Omni3DData(str(published), str(tmp_path / "views"))
    data = PairDataModule(source, cache=str(tmp_path / "cache"), image_size=32)
    data.evaluate_on("ordered", 0)
    data.prepare_data()
    table = data.table("test")
    assert table.counts == [4, 4, 4] and len(table.pairs("ordered")) == 36
    torch.testing.assert_close(table.poses[:, 2], torch.full((12,), 1.85, dtype=torch.float64), rtol=0, atol=1e-6)
