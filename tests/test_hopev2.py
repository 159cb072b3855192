import json
import math
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from bop_layout import SIZE, real_cameras, write_hopev2, write_scene
from painted_cube import check_view, photograph
from PIL import Image

from lp_framework import registry
from lp_framework.data.sets.converted import Photograph, SphericalView, crop, sound_views, spread
from lp_framework.data.sets.hopev2 import ANNOTATIONS, HOPEv2Data
from lp_framework.data.views import read_views
from lp_framework.errors import UserError
from lp_framework.geometry import camera_to_world, view_pose


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> Path:
    return write_hopev2(tmp_path_factory.mktemp("drawn") / "hope")


@pytest.fixture
def root(drawn, tmp_path) -> Path:
    return shutil.copytree(drawn, tmp_path / "hope")


@pytest.fixture
def make(root, tmp_path):
    def build(**changes) -> HOPEv2Data:
        settings = {"views": str(tmp_path / "views"), "train_views": 5, "test_views": 3, "resolution": 96}
        return HOPEv2Data(str(root), **{**settings, **changes})

    return build


# ---------------------------------------------------------------- conversion


def test_crops_show_what_their_spherical_cameras_see(make, root, tmp_path):
    assert registry.get("data", "hopev2") is HOPEv2Data
    data = make()
    with pytest.warns(UserWarning, match="object 'obj_000001': 3 occluded are left out"):
        data.prepare()
    assert data.names() == ["obj_000001"]
    assert [len(data.views("obj_000001", split)) for split in ("train", "test")] == [5, 3]
    known = torch.stack([camera for camera, _ in real_cameras(9)])
    sources = set()
    for split in ("train", "test"):
        views = read_views(tmp_path / "views", "obj_000001", split)
        frames = json.loads((tmp_path / "views" / "obj_000001" / split / "transform.json").read_text())["frames"]
        for file, camera, frame in zip(views.files, views.cameras, frames, strict=True):
            number = int(Path(frame["source"]).stem) // 3
            sources.add(frame["source"])
            true, intrinsics = real_cameras(9)[number]
            # The photograph's own camera is on record ...
            recorded = torch.tensor(frame["photograph_camera"], dtype=torch.float64)
            torch.testing.assert_close(recorded, true, rtol=0, atol=1e-9)
            recorded = torch.tensor(frame["photograph_intrinsics"], dtype=torch.float64)
            torch.testing.assert_close(recorded, intrinsics, rtol=0, atol=1e-9)
            assert (frame["width"], frame["height"]) == SIZE
            # ... the view is from its direction, at a radius of rendered views ...
            pose = view_pose(camera)
            torch.testing.assert_close(pose[:2], view_pose(known[number])[:2], rtol=0, atol=1e-9)
            assert 1.2 - 1e-9 <= pose[2] <= 2.0 + 1e-9
            # ... and its pixels are those of the box, seen from the real distance with the crop's field of view.
            pixels = np.asarray(Image.open(file))
            assert pixels.shape == (96, 96, 4) and not pixels[pixels[..., 3] == 0].any()
            real = camera_to_world(view_pose(known[number]))
            assert check_view(pixels, real, math.radians(frame["crop_angle_degrees"])) < 0.1
            assert 0 < frame["perspective_residual"] < 0.15
    assert len(sources) == 8 and all(source.startswith("val/000001/rgb/") for source in sources)


def test_relative_radii_follow_the_distances(make, tmp_path):
    with pytest.warns(UserWarning):
        make().prepare()
    frames = json.loads((tmp_path / "views" / "obj_000001" / "train" / "transform.json").read_text())["frames"]
    pairs = [(np.linalg.norm(np.array(f["photograph_camera"])[:3, 3]), f["latlon"][2]) for f in frames]
    inside = [distance / radius for distance, radius in pairs if 1.2 < radius < 2.0]
    assert len(inside) >= 2 and np.ptp(inside) < 1e-9


def test_a_download_is_unchanged_and_converted_once(make, root, tmp_path):
    before = {file: file.read_bytes() for file in root.rglob("*") if file.is_file()}
    with pytest.warns(UserWarning):
        make().prepare()
    assert {file: file.read_bytes() for file in root.rglob("*") if file.is_file()} == before
    record = tmp_path / "views" / "obj_000001" / "conversion.json"
    stamp, content = record.stat().st_mtime_ns, json.loads(record.read_text())
    assert content["left_out"] == {"occluded": 3} and content["largest_turn_degrees"] > 10
    make().prepare()
    assert record.stat().st_mtime_ns == stamp
    with pytest.raises(UserError, match="holds views that were made from other files or settings"):
        make(train_views=4).prepare()


def test_images_may_be_jpegs_of_an_onboarding_sequence(make, root):
    write_scene(root / "onboarding_static" / "obj_000001_up", real_cameras(8, seed=4), suffix=".jpg")
    with pytest.warns(UserWarning):
        make(train_views=12).prepare()  # more than there are in `val`


def scaled(factor: float, *keys: str):
    """A change to annotations: lengths of these keys, or all of a model, in another unit."""

    def change(content: dict) -> None:
        for entries in content.values():
            for entry in entries if isinstance(entries, list) else [entries]:
                for key in keys or list(entry):
                    value = entry[key]
                    entry[key] = [factor * each for each in value] if isinstance(value, list) else factor * value

    return change


@pytest.mark.filterwarnings("ignore:.*are left out")
@pytest.mark.parametrize(
    ("model", "pose", "units"),
    [
        (0.001, 0.001, "models and cam_t_m2c in the same unit"),
        (0.001, 1.0, "models in metres, cam_t_m2c in millimetres"),
        (1.0, 0.001, "models in millimetres, cam_t_m2c in metres"),
    ],
)
def test_masks_distinguish_metres_from_millimetres(make, root, tmp_path, model, pose, units):
    rewrite(root / "models" / "models_info.json", scaled(model))
    for folder in root.glob("val*/*"):
        rewrite(folder / "scene_gt.json", scaled(pose, "cam_t_m2c"))
    with warnings.catch_warnings(record=True) as caught:
        make().prepare()
    taken = [str(each.message) for each in caught if "assuming" in str(each.message)]
    expected = [f"{root}: object 'obj_000001': assuming {units}, as its masks show"] if model != pose else []
    assert taken == expected
    assert json.loads((tmp_path / "views/obj_000001/conversion.json").read_text())["units"] == units
    for split, count in (("train", 5), ("test", 3)):
        frames = json.loads((tmp_path / "views" / "obj_000001" / split / "transform.json").read_text())["frames"]
        for frame in frames:
            recorded = torch.tensor(frame["photograph_camera"], dtype=torch.float64)
            true, _ = real_cameras(9)[int(Path(frame["source"]).stem) // 3]
            torch.testing.assert_close(recorded, true, rtol=0, atol=1e-9)
        assert len(frames) == count


@pytest.mark.parametrize("factor", [100.0, 0.1])
def test_a_model_in_another_unit_is_refused(make, root, factor):
    rewrite(root / "models" / "models_info.json", scaled(factor))
    with pytest.raises(UserError, match=r"its masks show it .* times as long as its model is; .* or metres"):
        make().prepare()


@pytest.mark.filterwarnings("ignore:.*are left out")
@pytest.mark.parametrize("files", [["scene_camera.json", "scene_gt_info.json"], ANNOTATIONS])
def test_numbers_of_images_may_be_padded_with_zeros(make, root, tmp_path, files):
    for folder in root.glob("val*/*"):
        for file in files:
            content = json.loads((folder / file).read_text())
            (folder / file).write_text(json.dumps({key.zfill(6): value for key, value in content.items()}))
    info = root / "models" / "models_info.json"
    info.write_text(json.dumps({"000001": json.loads(info.read_text())["1"]}))
    data = make()
    data.prepare()
    assert data.names() == ["obj_000001"] and len(data.views("obj_000001", "train")) == 5
    record = json.loads((tmp_path / "views" / "obj_000001" / "conversion.json").read_text())
    assert record["left_out"] == {"occluded": 3}


@pytest.mark.filterwarnings("ignore:.*are left out")
@pytest.mark.parametrize("values", [np.uint8([0, 1]), np.uint16([0, 65535])])
def test_masks_of_zeros_and_ones_or_of_16_bits_select_the_same_pixels(make, root, tmp_path, values):
    make().prepare()
    for file in root.glob("val*/*/mask_visib/*.png"):
        Image.fromarray(values[(np.asarray(Image.open(file)) > 0).astype(int)]).save(file)
    make(views=str(tmp_path / "again")).prepare()
    for file in (tmp_path / "views").rglob("*.png"):
        again = tmp_path / "again" / file.relative_to(tmp_path / "views")
        assert np.array_equal(np.asarray(Image.open(file)), np.asarray(Image.open(again)))


def test_a_crop_that_shrinks_the_photograph_is_averaged_not_sampled(tmp_path):
    size = (600, 600)
    camera, _ = real_cameras(1)[0]
    intrinsics = torch.tensor([[2000.0, 0, 300], [0, 2000, 300], [0, 0, 1]], dtype=torch.float64)
    camera = camera_to_world(view_pose(camera))
    colours, mask = photograph(camera, intrinsics, size)
    colours[::2, ::2] = 255 - colours[::2, ::2]  # detail that is finer than the crop can show
    Image.fromarray(colours).save(tmp_path / "image.png")
    Image.fromarray(mask).save(tmp_path / "mask.png")
    taken = Photograph(tmp_path / "image.png", tmp_path / "mask.png", camera, intrinsics, size)
    radius = torch.tensor(1.6, dtype=torch.float64)
    pixels = np.asarray(crop(SphericalView(taken, radius, 0.0, 0.0), 64)).astype(int)
    inside = pixels[..., 3] == 255
    assert inside.sum() > 200
    # A quarter of the pixels is inverted: everywhere the mean is 3/4 of a colour and 1/4 of its inverse.
    Image.fromarray(photograph(camera, intrinsics, size)[0]).save(tmp_path / "image.png")
    smooth = np.asarray(crop(SphericalView(taken, radius, 0.0, 0.0), 64)).astype(int)
    expected = 0.75 * smooth[..., :3] + 0.25 * (255 - smooth[..., :3])
    assert np.abs(pixels[..., :3] - expected)[inside].mean() < 6


def test_viewpoints_are_spread():
    random = np.random.default_rng(0)
    crowd = np.concatenate(
        [np.tile([0.0, 0.0, 1.0], (90, 1)) + 0.01 * random.normal(size=(90, 3)), np.eye(3), -np.eye(3)]
    )
    crowd /= np.linalg.norm(crowd, axis=1, keepdims=True)
    chosen = spread(crowd, 7, random)
    assert len(set(chosen.tolist())) == 7 and len(set(chosen.tolist()) & set(range(90, 96))) >= 5
    assert sorted(spread(crowd, len(crowd), random)) == list(range(len(crowd)))


# ---------------------------------------------------------------- bad input


def rewrite(path: Path, change) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def scene(root: Path, file: str) -> Path:
    return root / "val" / "000001" / file


def entry(key: str, value):
    return lambda content: content["0"][1].update({key: value})


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda root: scene(root, "scene_camera.json").unlink(), r"000001/scene_camera\.json: there is no such file"),
        (lambda root: scene(root, "scene_gt_info.json").unlink(), r"scene_gt_info\.json: there is no such file"),
        (lambda root: scene(root, "scene_gt.json").write_text("{"), r"000001/scene_gt\.json: is not readable JSON"),
        (lambda root: (root / "models/models_info.json").unlink(), r"models/models_info\.json: there is no such file"),
        (lambda root: (root / "models/models_info.json").write_text('{"1": {}}'), r"needs min_x, size_x"),
        (lambda root: rewrite(scene(root, "scene_gt_info.json"), lambda c: c.pop("0")), "of the same instances"),
        (lambda root: rewrite(scene(root, "scene_camera.json"), lambda c: c.pop("0")), "0 needs cam_K of 9 numbers"),
        (lambda root: rewrite(scene(root, "scene_gt.json"), entry("cam_R_m2c", [1.0] * 9)), "is not a rotation"),
        (lambda root: rewrite(scene(root, "scene_gt.json"), entry("cam_t_m2c", [0, 0, None])), "cam_t_m2c of 3 "),
        (lambda root: rewrite(scene(root, "scene_gt.json"), entry("cam_t_m2c", [0, 0, -400])), "behind its camera"),
        (
            lambda root: rewrite(scene(root, "scene_camera.json"), lambda c: c["0"].update(cam_K=[0.0] * 9)),
            "focal lengths must be positive",
        ),
        (lambda root: scene(root, "rgb/000000.png").unlink(), r"rgb/000000\.png: there is no such file"),
        (lambda root: scene(root, "rgb/000000.png").write_bytes(b"no"), r"rgb/000000\.png: is not a readable image"),
        (lambda root: scene(root, "mask_visib/000000_000001.png").unlink(), "000001.png: there is no such file"),
        (
            lambda root: Image.new("L", (80, 60), 255).save(scene(root, "mask_visib/000000_000001.png")),
            r"000000_000001\.png: is 80 x 60 pixels, but the photograph should be 320 x 240",
        ),
        (
            lambda root: Image.new("L", SIZE).save(scene(root, "mask_visib/000000_000001.png")),
            r"000000_000001\.png: marks nothing",
        ),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore:.*are left out")
def test_damaged_data(make, root, tmp_path, damage, message):
    damage(root)
    with pytest.raises(UserError, match=message) as caught:
        make(train_views=6).prepare()
    assert "\n" not in str(caught.value)
    assert not list((tmp_path / "views").glob("*obj_*"))


def write_models(root: Path, *numbers: int) -> None:
    """Bounding boxes for objects of these numbers, all of the same size."""
    file = root / "models" / "models_info.json"
    box = json.loads(file.read_text())["1"]
    file.write_text(json.dumps({str(number): box for number in numbers}))


@pytest.mark.filterwarnings("ignore:.*are left out")
def test_objects_that_cannot_be_converted_are_listed_and_the_others_are_ready(make, root, tmp_path):
    write_models(root, 1, 3, 4)
    write_scene(root / "val" / "000007", real_cameras(9, seed=5), object_id=4)
    (root / "val" / "000007" / "rgb" / "000003.png").unlink()
    lines = (
        r"2 of 3 objects could not be converted; repair them, or remove their names from .*views/objects\.json:\n"
        r"  obj_000003: .*has 0 usable views.*\n  obj_000004: .*000003\.png: there is no such file"
    )
    for _ in range(2):
        with pytest.raises(UserError, match=lines):
            make(train_views=6).prepare()
        assert [file.name for file in (tmp_path / "views").glob("*obj_*")] == ["obj_000001"]
    rewrite(tmp_path / "views" / "objects.json", lambda lists: lists.update(seen=["obj_000001"]))
    data = make(train_views=6)
    data.prepare()
    assert data.names() == ["obj_000001"] == make(objects="obj_000001").names()
    with pytest.raises(UserError, match=r"there is no 'obj_000004' in .*hope; did you mean 'obj_000001'"):
        make(objects=["obj_000004"]).names()


def test_an_error_common_to_all_objects_is_reported_once(make, root):
    write_models(root, 1, 2)
    scene(root, "scene_gt.json").write_text("{")
    with pytest.raises(UserError, match=r"2 of 2 objects .*json: obj_000001, obj_000002: .*is not readable JSON"):
        make().prepare()


def test_an_object_with_fewer_views_than_asked(make):
    with pytest.raises(
        UserError, match=r"'obj_000001' has 9 usable views \(3 occluded are left out\).*train_views=100 .* ask for 103"
    ):
        make(train_views=100).prepare()
    with pytest.raises(UserError, match=r"data\.test_views must be at least 2, got 1"):
        make(test_views=1).prepare()


def test_wrong_roots(make, root, tmp_path):
    (tmp_path / "empty").mkdir()
    for path in ("nowhere", "empty"):
        with pytest.raises(UserError, match=rf"{path}/models/models_info\.json: there is no such file"):
            HOPEv2Data(str(tmp_path / path), views=str(tmp_path / "views")).names()
    with pytest.raises(UserError, match=r"no annotated scenes; looked for .*hope/train/\*/scene_gt\.json"):
        make(splits=["train"]).prepare()


def test_views_too_near_or_too_distorted_are_skipped_and_counted():
    cameras = [camera_to_world(torch.tensor([0.2, angle, 6.0], dtype=torch.float64)) for angle in (0.0, 1.0, 2.0)]
    cameras += [camera_to_world(torch.tensor([0.2, 3.0, distance], dtype=torch.float64)) for distance in (0.7, 1.5)]
    photographs = [Photograph(Path("image"), Path("mask"), each, torch.eye(3).double(), SIZE) for each in cameras]
    cube = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5], dtype=torch.float64)] * 3)
    views, left_out = sound_views(photographs, cube)
    assert [view.photograph for view in views] == [*photographs[:3], photographs[4]]
    assert left_out == {"nearer than the object is long": 1}
    views, left_out = sound_views(photographs, 1.3 * cube)  # larger than its frame says, as bad annotations have it
    assert len(views) == 1 and left_out["with too strong a perspective"] == 3
