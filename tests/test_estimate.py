"""`estimate` and `estimate_pose`: the solver's poses are in every output file, in the right order."""

from __future__ import annotations

import csv
import inspect
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from colmap_reader import read_colmap
from conftest import Finished
from drawn_photographs import drawn, placed
from matplotlib.image import imread
from omegaconf import OmegaConf
from PIL import Image
from torch import Tensor
from toy_views import toy_view
from transforms_readers import as_ifusion, as_instant_ngp, as_nerfstudio

import lp_framework
from lp_framework import registry
from lp_framework.analysis.confidence import Answer, answers
from lp_framework.commands.building import Components, plain
from lp_framework.commands.estimate import warn_of_prior
from lp_framework.data.masks import mask_maker
from lp_framework.data.photographs import on_white, prepare
from lp_framework.errors import UserError
from lp_framework.geometry import camera_to_world
from lp_framework.models.pose_model import PoseModel
from lp_framework.solvers.base import Cost, Pairs, Solution, Solver

SOLVER = '''
    from __future__ import annotations

    import math

    import torch
    from torch import Tensor

    from lp_framework.registry import register
    from lp_framework.solvers.base import Cost, Pairs, Solution, Solver


    @register("solver", "tmp_brightness")
    class Brightness(Solver):
        """Tells a made-up longitude from how bright the query is; fails at images darker than `fails_below`."""

        def __init__(self, latitude: float = 0.1, radius: float = 0.2, fails_below: float = -2.0) -> None:
            self.latitude, self.radius, self.fails_below = latitude, radius, fails_below

        def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
            assert pairs.images.shape[1:] == (3, 256, 256) and pairs.images.abs().max() <= 1
            bright = pairs.images.mean(dim=(1, 2, 3))[pairs.query]
            pose = torch.tensor([self.latitude, 3, self.radius]) + bright[:, None] * torch.tensor([0.0, 1.0, 0.0])
            pose = pose.masked_fill(bright[:, None] < self.fails_below, math.nan)
            energies = starts[..., 0].abs() + bright[:, None]  # least where a start's latitude is 0
            return Solution(
                poses=pose[:, None].expand_as(starts), energies=energies, valid=energies > -9,
                chosen=energies.argmin(dim=1), cost=Cost(network_passes=7, seconds=0.5),
            )
'''


CONFIDENCE = (
    "answer", "probability", "verdict", "second_latitude_degrees", "second_longitude_degrees", "second_probability",
)  # fmt: skip


@pytest.fixture(autouse=True)
def figures(request: pytest.FixtureRequest) -> None:
    """They are drawn for the test that looks at them."""
    if request.function is not test_all_files_agree:
        request.getfixturevalue("no_drawing")


@pytest.fixture
def photos(tmp_path: Path, write: Callable[[str, str], Path]) -> Path:
    """A folder with three photographs, darker from one to the next, where the solver above is a plugin."""
    write("plugins/tmp_brightness/tmp_brightness.py", SOLVER)
    folder = tmp_path / "photos"
    folder.mkdir()
    for name, brightness in (("front", 1.0), ("left", 0.8), ("right", 0.5)):
        image = drawn(80, 60)
        image[..., :3] = image[..., :3] * brightness
        placed(image, 30, 20).save(folder / f"{name}.png")
    return folder


def brightness(file: Path) -> float:
    """What the solver sees."""
    with Image.open(file) as image:
        return float((on_white(image.convert("RGBA")) / 127.5 - 1).mean())


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "poses.csv").open() as file:
        return list(csv.DictReader(file))


def estimate(lp: Callable[..., Finished], *overrides: str) -> Finished:
    return lp("estimate", "solver=tmp_brightness", "start=grid", "hydra.run.dir=run", *overrides)


# ---------------------------------------------------------------- the command


def test_the_solvers_field_of_view_setting_is_used_in_exports_and_pictures(lp, write, tmp_path: Path, monkeypatch):
    solver = SOLVER.replace("    def __init__", "    field_of_view_degrees = 30.0\n\n        def __init__")
    write("plugins/tmp_brightness/tmp_brightness.py", solver)
    for name in ("a", "b"):
        placed(drawn(200, 160), 20, 30, 256, 256).save(tmp_path / f"{name}.png")
    drawn_with = []
    monkeypatch.setattr(
        "lp_framework.report.plots._frustum", lambda *given: drawn_with.append(given[2]) or np.zeros((5, 3))
    )
    finished = estimate(lp, "images=[a.png,b.png]", "crop=false")
    assert finished.status == 0, finished.err
    transforms = json.loads((tmp_path / "run" / "transforms.json").read_text())
    assert transforms["camera_angle_x"] == pytest.approx(math.radians(30))
    cameras = (tmp_path / "run" / "sparse" / "0" / "cameras.txt").read_text().splitlines()[1].split()
    assert float(cameras[4]) == float(cameras[5]) == pytest.approx(128 / math.tan(math.radians(15)))
    assert drawn_with and drawn_with == pytest.approx([math.radians(30)] * len(drawn_with))


def test_all_files_agree(lp, photos: Path, tmp_path: Path):
    finished = estimate(lp, "images=photos", "latitude_degrees=10", "radius=1.5")
    assert finished.status == 0, finished.err
    run = tmp_path / "run"
    files = [f"images/{index:03d}.png" for index in range(3)]
    longitudes = [0.0] + [3 + brightness(run / file) for file in files[1:]]
    made_up = [[math.radians(10) + 0.1, longitude, 1.7] for longitude in longitudes[1:]]
    poses = torch.tensor([[math.radians(10), 0.0, 1.5], *made_up], dtype=torch.float64)
    cameras = camera_to_world(poses)

    table = rows(run)
    assert [row["file"] for row in table] == [f"photos/{name}.png" for name in ("front", "left", "right")]
    assert [row["image"] for row in table] == files
    for row, pose, longitude in zip(table, poses.tolist(), longitudes, strict=True):
        absolute = [float(row[key]) for key in ("latitude_degrees", "longitude_degrees", "radius")]
        assert absolute == pytest.approx([math.degrees(pose[0]), math.degrees(pose[1]), pose[2]], abs=1e-3)
        assert float(row["relative_longitude_degrees"]) == pytest.approx(math.degrees(longitude), abs=1e-3)
        assert row["valid"] == "True"
        assert all(row[key] == "" for key in CONFIDENCE)  # this solver tells no probability
    assert [float(table[1][f"relative_{key}"]) for key in ("latitude_degrees", "radius")] == pytest.approx(
        [math.degrees(0.1), 0.2], abs=1e-3
    )
    assert table[0]["energy"] == "" and float(table[2]["energy"]) == pytest.approx(longitudes[2] - 3, abs=1e-4)

    transforms = json.loads((run / "transforms.json").read_text())
    assert transforms["camera_angle_x"] == pytest.approx(math.radians(49.1))
    assert [frame["file_path"] for frame in transforms["frames"]] == files
    matrices = torch.tensor([frame["transform_matrix"] for frame in transforms["frames"]], dtype=torch.float64)
    torch.testing.assert_close(matrices, cameras, rtol=0, atol=1e-6)

    _, images = read_colmap({file.name: file.read_text() for file in (run / "sparse" / "0").iterdir()})
    assert [image.name for image in images] == ["000.png", "001.png", "002.png"]
    for image, camera in zip(images, cameras.numpy(), strict=True):
        np.testing.assert_allclose(-image.rotation.T @ image.translation, camera[:3, 3], atol=1e-6)

    for file, name in zip(files, ("front", "left", "right"), strict=True):
        with Image.open(photos / f"{name}.png") as original, Image.open(run / file) as prepared:
            assert np.array_equal(prepared, prepare(original, name)) and prepared.size == (256, 256)

    results = json.loads((run / "results.json").read_text())
    assert results["valid"] is True and results["checkpoint"] is None and results["seed"] == 0
    assert results["network_passes"] == 7 and results["config"]["radius"] == 1.5
    assert results["energies"][0][1] == pytest.approx(longitudes[1] - 3, abs=1e-4) and results["energies"][0][0] is None
    assert imread(run / "cameras.png").shape[1] == 1600 and (run / "cameras.pdf").exists()

    for line in ("front.png", "10.0°", "reference", f"{math.degrees(longitudes[2]):.1f}°", "run/cameras.png"):
        assert line in finished.out
    scene = trimesh.load(run / "cameras.glb")
    names = ("0 front.png", "1 left.png", "2 right.png")
    assert {*scene.graph.nodes_geometry} == {*names, *(f"{name} frustum" for name in names)}


def test_cameras_open_elsewhere_with_the_crops_and_with_the_photographs(lp, photos: Path, tmp_path: Path):
    """One is a JPEG with an EXIF orientation and focal length; the others have neither."""
    exif = Image.Exif()
    exif[274] = 6  # turn it clockwise
    exif.get_ifd(0x8769)[41989] = 28  # mm on 35 mm film
    with Image.open(photos / "left.png") as left:  # 300 x 200, its object at the left above the middle
        left.convert("RGB").rotate(90, expand=True).save(photos / "left.jpg", exif=exif, quality=95)
        left.getchannel("A").save(photos / "left_mask.png")
    (photos / "left.png").unlink()
    finished = estimate(lp, "images=photos", "radius=1.6")
    assert finished.status == 0, finished.err
    run = tmp_path / "run"
    message = (
        "no focal length in the EXIF data of front.png, right.png: 1.2 times the longer side is assumed for original/"
    )
    assert finished.out.count(message) == 1
    focals = json.loads((run / "results.json").read_text())["focal_lengths"]
    film = 28 / math.hypot(36, 24) * math.hypot(300, 200)
    assert [(each["pixels"], each["known_by"]) for each in focals] == [
        (360.0, "assumed"), (pytest.approx(film), "EXIF"), (360.0, "assumed"),
    ]  # fmt: skip
    crops, photographs = (as_nerfstudio(folder)[0] for folder in (run, run / "original"))
    assert [crop.file.name for crop in crops] == ["000.png", "001.png", "002.png"]
    assert [photograph.file.name for photograph in photographs] == ["000.png", "001.jpg", "002.png"]
    assert (run / "original/images/000.png").read_bytes() == (photos / "front.png").read_bytes()
    for folder in (run, run / "original"):
        as_instant_ngp(folder)
        assert len((folder / "sparse/0/points3D.txt").read_text().splitlines()) > 100
    for crop, photograph, (focal, _) in zip(crops, photographs, ((each["pixels"], 0) for each in focals), strict=True):
        assert photograph.size == (300, 200) and photograph.focal == pytest.approx((focal, focal))
        # The origin appears near the object's middle, which is 80 to the left of the axis and 50 above. These drawings
        # show no object from these poses, so matching their outlines moves it a little.
        place = np.linalg.inv(photograph.matrix)[:3, 3]
        seen = [150 - focal * place[0] / place[2], 100 + focal * place[1] / place[2]]
        assert seen == pytest.approx([70, 50], abs=6)
        directions = [each[:3, 3] / np.linalg.norm(each[:3, 3]) for each in (photograph.matrix, crop.matrix)]
        np.testing.assert_allclose(*directions, atol=0.03)
    assert len(as_ifusion(run)) == 3


def test_whole_views_are_their_photographs(lp, write, tmp_path: Path):
    write("plugins/tmp_brightness/tmp_brightness.py", SOLVER)
    for name in ("a", "b"):
        placed(drawn(200, 160), 20, 30, 512, 512).save(tmp_path / f"{name}.png")
    finished = estimate(lp, "images=[a.png,b.png]", "crop=false")
    assert finished.status == 0 and "EXIF" not in finished.out
    crops, photographs = (as_nerfstudio(folder)[0] for folder in (tmp_path / "run", tmp_path / "run" / "original"))
    for crop, photograph in zip(crops, photographs, strict=True):
        np.testing.assert_allclose(photograph.matrix, crop.matrix)
        assert photograph.size == (512, 512) and photograph.focal[0] == pytest.approx(2 * crop.focal[0])


def test_the_first_of_a_list_is_the_reference(lp, photos: Path, tmp_path: Path):
    assert estimate(lp, "images=[photos/right.png,photos/front.png]").status == 0
    table = rows(tmp_path / "run")
    assert [row["file"] for row in table] == ["photos/right.png", "photos/front.png"]
    assert [float(row["longitude_degrees"]) for row in table] == pytest.approx(
        [0, math.degrees(3 + brightness(tmp_path / "run/images/001.png"))], abs=1e-3
    )


def test_masks_and_whole_views(lp, photos: Path, tmp_path: Path):
    assert estimate(lp, "images=photos").status == 0
    expected = [(tmp_path / f"run/images/{index:03d}.png").read_bytes() for index in range(3)]
    (tmp_path / "masks").mkdir()
    (tmp_path / "plain").mkdir()
    for file in photos.iterdir():
        with Image.open(file) as image:
            image.getchannel("A").save(tmp_path / "masks" / file.name)
            image.convert("RGB").save(tmp_path / "plain" / f"{file.stem}.bmp")
    assert "has no transparent background" in estimate(lp, "images=plain").error
    assert estimate(lp, "images=plain", "masks=masks").status == 0
    assert [(tmp_path / f"run/images/{index:03d}.png").read_bytes() for index in range(3)] == expected
    assert "plain/front.bmp: is 300 x 200 pixels" in estimate(lp, "images=plain", "crop=false").error
    for file in (tmp_path / "plain").iterdir():
        with Image.open(file) as image:
            image.crop((0, 0, 128, 128)).save(file)
    assert estimate(lp, "images=plain", "crop=false").status == 0
    with Image.open(tmp_path / "run/images/000.png") as image, Image.open(tmp_path / "plain/front.bmp") as whole:
        assert np.array_equal(image.convert("RGB"), whole.resize((256, 256), Image.Resampling.LANCZOS))


def test_an_image_without_a_pose_is_left_out_and_named(lp, photos: Path, tmp_path: Path):
    assert estimate(lp, "images=photos").status == 0
    run = tmp_path / "run"
    between = sum(brightness(run / f"images/{index:03d}.png") for index in (1, 2)) / 2
    finished = estimate(lp, "images=photos", f"solver.fails_below={between}")
    assert finished.status == 0
    assert "photos/right.png: the solver found no pose" in finished.err
    assert [row["valid"] for row in rows(run)] == ["True", "True", "False"]
    transforms = json.loads((run / "transforms.json").read_text())
    assert [frame["file_path"] for frame in transforms["frames"]] == ["images/000.png", "images/001.png"]
    assert "002.png" not in (run / "sparse/0/images.txt").read_text()
    assert "002.png" not in (run / "original/transforms.json").read_text()


def test_a_camera_behind_the_object_is_no_pose(lp, photos: Path, tmp_path: Path):
    assert estimate(lp, "images=photos", "solver.radius=-1.5").status == 0
    assert [row["valid"] for row in rows(tmp_path / "run")] == ["True", "False", "False"]


@pytest.mark.parametrize(
    ("overrides", "error"),
    [
        ([], "images needs a value: give images=VALUE"),
        (["images=photos/front.png"], "photos/front.png: is one image, but two or more are needed"),
        (["images=[photos/front.png,photos/none.png]"], "images=photos/none.png: there is no such file"),
        (["images=[photos/front.png,photos/broken.png]"], "photos/broken.png: is not a readable image"),
        (["images=photos", "masks=none"], "masks=none: there is no such file or folder"),
        (["images=photos", "crop=perhaps"], "crop must be true or false, got perhaps"),
        (["images=photos", "radius=0"], "radius must be a positive number, got 0"),
        (["images=photos", "latitude_degrees=90"], "latitude_degrees must lie between -90 and 90, got 90"),
        (["images=photos", "accelerator=tpu"], "accelerator=tpu is not available on this machine"),
    ],
)
def test_mistakes_are_found_before_any_model_is_loaded(lp, photos, overrides, error, tmp_path, monkeypatch):
    if "broken" in str(overrides):
        (photos / "broken.png").write_bytes((photos / "front.png").read_bytes()[:400])
    monkeypatch.setattr(Components, "__getitem__", lambda components, group: pytest.fail("too early"))
    finished = estimate(lp, *overrides)
    assert finished.status == 1 and error in finished.error


def test_the_function_has_the_defaults_of_the_command():
    config = OmegaConf.load(registry.conf_dir() / "estimate.yaml")
    chosen = {key: value for each in config.defaults if not isinstance(each, str) for key, value in each.items()}
    defaults = {
        key: parameter.default
        for key, parameter in inspect.signature(lp_framework.estimate_pose).parameters.items()
        if parameter.default is not inspect.Parameter.empty
    }
    assert (defaults.pop("solver"), defaults.pop("prior"), defaults.pop("starts"), defaults.pop("model")) == (
        chosen["solver"], chosen["prior"], chosen["start"], config.checkpoint,
    )  # fmt: skip
    assert defaults == {key: config[key] for key in defaults}


# ---------------------------------------------------------------- the function


class Recorder(Solver):
    """Keeps what it is given; the answer is the start of most latitude."""

    def __init__(self) -> None:
        self.seen: list[tuple[Pairs, Tensor, int]] = []

    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        self.seen.append((pairs, starts, seed))
        energies = -starts[..., 0]
        cost = Cost(network_passes=0, seconds=0.0)
        return Solution(starts, energies, energies.isfinite(), energies.argmin(dim=1), cost)


def test_files_arrays_and_images_are_the_same_pictures(tmp_path: Path):
    images = [placed(drawn(80, 60), 30, 20), placed(drawn(40, 60), 3, 2)]
    files = [tmp_path / "a.png", tmp_path / "b.png"]
    for image, file in zip(images, files, strict=True):
        image.save(file)
    recorder = Recorder()
    arrays = [np.asarray(image) for image in images]
    for reference, query in (files, map(str, files), images, arrays, [array / 255 for array in arrays]):
        lp_framework.estimate_pose(reference, query, solver=recorder, starts="grid", seed=5)
    expected = np.stack([on_white(prepare(image, "a")) for image in images])
    for pairs, starts, seed in recorder.seen:
        pixels = ((pairs.images + 1) * 127.5).round().permute(0, 2, 3, 1)
        np.testing.assert_array_equal(pixels.numpy(), expected)
        assert pairs.reference.tolist() == [0] and pairs.query.tolist() == [1]
        assert starts.shape == (1, 9, 3) and seed == 5


def test_starts_by_name_or_built():
    image = placed(drawn(), 30, 20)
    recorder = Recorder()
    ring = lp_framework.make_starts("ring", count=5, latitude=0.3)
    lp_framework.estimate_pose(image, image, solver=recorder, starts="ring")
    solution = lp_framework.estimate_pose(image, image, solver=recorder, starts=ring)
    assert [starts.shape[1] for _, starts, _ in recorder.seen] == [4, 5]
    assert solution.answer()[0, 0] == pytest.approx(0.3)


def test_the_views_of_a_rendering_are_taken_whole():
    recorder = Recorder()
    view = placed(drawn(80, 60), 30, 20, 256, 256)
    lp_framework.estimate_pose(view, view, solver=recorder, starts="grid", crop=False)
    np.testing.assert_array_equal(
        ((recorder.seen[0][0].images[0] + 1) * 127.5).round().permute(1, 2, 0), on_white(view)
    )


def test_mistakes_name_the_picture():
    recorder, image = Recorder(), placed(drawn(), 30, 20)
    for query, error in (
        (image.convert("RGB"), "query: has no transparent background"),
        ("none.png", r"none\.png: there is no such file"),
        (np.zeros((4, 4)), r"query must be \[H, W, 3\] or"),
        (Image.fromarray(np.zeros((4, 4), dtype=np.float32)), "query: its pixels are floating-point numbers"),
    ):
        with pytest.raises(UserError, match=error):
            lp_framework.estimate_pose(image, query, solver=recorder)
    with pytest.raises(UserError, match="there is no solver 'two_stages'; did you mean 'two_stage'"):
        lp_framework.estimate_pose(image, image, solver="two_stages")
    with pytest.raises(UserError, match="there is no start 'grit'; did you mean 'grid'"):
        lp_framework.estimate_pose(image, image, solver=recorder, starts="grit")


def test_it_works_out_of_the_box_on_unseen_objects(recwarn):
    views = [toy_view("soup_can", *place) for place in ((10, 20), (20, 80))]
    solution = lp_framework.estimate_pose(*views)
    latitude, longitude, radius = solution.answer()[0].tolist()
    assert math.degrees(longitude) == pytest.approx(60, abs=15) and math.degrees(latitude) == pytest.approx(10, abs=10)
    assert solution.poses.shape == (1, 4, 3) and solution.probability.shape == (1, 4)
    assert solution.probability[0, solution.chosen[0]] > 0.8
    assert radius == 0  # the crop loses it
    assert not [each for each in recwarn if "prior" in str(each.message)]
    whole = lp_framework.estimate_pose(*views, crop=False)
    assert whole.answer()[0, 2] != 0


def test_registered_names_work_and_other_models_have_no_probability():
    reference, query = placed(drawn(80, 60), 30, 20), placed(drawn(60, 80), 30, 20)
    with pytest.warns(UserWarning, match="supports only the twelve embedded objects"):
        solution = lp_framework.estimate_pose(reference, query, solver="two_stage", starts="grid", model="score")
    assert solution.poses.shape == (1, 9, 3) and solution.valid.all() and solution.answer().isfinite().all()
    assert solution.probability is None
    model = lp_framework.load_model(Path(lp_framework.__file__).parent / "weights" / "score")
    solver = lp_framework.load_solver("two_stage", model=model, prior=lp_framework.load_prior("tiny"))
    built = lp_framework.estimate_pose(
        reference, query, solver=solver, starts=lp_framework.make_starts("grid"), prior="tiny", model=model
    )
    torch.testing.assert_close(built.poses, solution.poses)


def test_using_the_bundled_prior_for_photographs_warns(lp, clean_registry, caplog):
    def warns(*overrides: str) -> bool:
        printed = lp("estimate", "images=x", "--cfg", "job", *overrides).out
        caplog.clear()
        warn_of_prior(Components(plain(OmegaConf.create(printed))))
        return "prior=tiny, which ships, supports only the twelve embedded objects" in caplog.text

    assert warns("solver=two_stage") and warns("solver=ifusion")
    assert not warns() and not warns("solver=two_stage", "prior=zero123xl") and not warns("solver=langevin")
    assert not warns("solver=ifusion", "prior.path=mine")


# ---------------------------------------------------------------- what people get


def saved_views(folder: Path, **places: tuple[str, float, float]) -> list[str]:
    """Views of embedded objects as files `NAME.png`."""
    for name, place in places.items():
        toy_view(*place).save(folder / f"{name}.png")
    return [f"{name}.png" for name in places]


def test_by_default_each_image_gets_an_answer_in_words_and_its_confidence(lp, tmp_path: Path):
    files = saved_views(tmp_path, a=("soup_can", 10, 20), b=("soup_can", 20, 80), c=("soup_can", 10, 350))
    finished = lp("estimate", f"images=[{','.join(files)}]", "hydra.run.dir=run")
    assert finished.status == 0, finished.err
    assert finished.out.startswith("model: general, which ships with lp_framework")
    assert "prior" not in finished.out + finished.err
    table = rows(tmp_path / "run")
    assert all(table[0][key] == "" for key in CONFIDENCE)
    answers = json.loads((tmp_path / "run/results.json").read_text())["answers"]
    for row, answer, truth in zip(table[1:], answers, (60, 330), strict=True):
        assert float(row["relative_longitude_degrees"]) == pytest.approx(truth, abs=15)
        assert float(row["relative_radius"]) == 0 and float(row["radius"]) == 1.4
        side = "right" if truth < 180 else "left"
        assert f"° to the {side}" in row["answer"] and float(row["probability"]) > 0.8 and row["verdict"] == "trust"
        assert (answer["file"], answer["answer"], answer["verdict"]) == (row["file"], row["answer"], row["verdict"])
        line = (
            f"a.png to {row['file']}: {row['answer']}; probability {answer['probability']:.2f} to be within 30°: trust"
        )
        assert line in finished.out
    lost = "the crop to the object loses the distance: radius is not estimated"
    assert finished.out.count(lost) == 1
    page = (tmp_path / "run/report.html").read_text()
    assert table[1]["answer"] in page and ">trust<" in page
    whole = lp("estimate", f"images=[{','.join(files)}]", "hydra.run.dir=whole", "crop=false")
    assert lost not in whole.out and float(rows(tmp_path / "whole")[1]["relative_radius"]) != 0


def test_what_looks_alike_from_behind_has_a_second_answer(lp, tmp_path: Path):
    """The tram's front and back differ in colour alone."""
    files = saved_views(tmp_path, a=("tram", 5, 30), b=("tram", 10, 50))
    finished = lp("estimate", f"images=[{','.join(files)}]", "hydra.run.dir=run")
    row = rows(tmp_path / "run")[1]
    first, second = float(row["relative_longitude_degrees"]), float(row["second_longitude_degrees"])
    assert abs((second - first) % 360 - 180) < 30 and float(row["second_probability"]) >= 0.05
    assert "second: " in finished.out and "about half a turn away: front and back look alike" in finished.out


def test_a_prior_may_still_choose_among_the_modes(lp, tmp_path: Path):
    files = saved_views(tmp_path, a=("soup_can", 10, 20), b=("soup_can", 20, 80))
    settings = ("solver=two_stage", "solver.refinement_steps=2", "hydra.run.dir=run")
    finished = lp("estimate", f"images=[{','.join(files)}]", *settings)
    assert finished.status == 0, finished.err
    assert "prior=tiny, which ships, supports only the twelve embedded objects" in finished.err
    first, second = rows(tmp_path / "run")
    assert second["probability"] == "" and first["verdict"] == ""
    assert second["verdict"] in ("doubtful", "do not trust")  # it knows the object, but not crops of it
    assert "times what it is for objects that the prior knows: do" in finished.out
    assert second["verdict"] in (tmp_path / "run" / "report.html").read_text()
    whole = lp("estimate", *files, *settings[:2], "crop=false", "hydra.run.dir=whole")
    assert rows(tmp_path / "whole")[1]["verdict"] == "trust" and whole.err == ""


def test_masks_are_made_written_and_shown(lp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "rembg", None)  # as if not installed
    mask_maker.cache_clear()
    noise = np.random.default_rng(0).integers((60, 150, 60), (90, 180, 90), (256, 256, 3), dtype=np.uint8)
    for name, place in (("a", (10, 20)), ("b", (20, 80))):
        view = toy_view("soup_can", *place)
        photograph = Image.fromarray(np.pad(noise, ((30, 30), (30, 30), (0, 0)), mode="symmetric"))
        photograph.paste(view, (30, 30), mask=view)
        photograph.save(tmp_path / f"{name}.png")
    plain = lp("estimate", "images=[a.png,b.png]", "hydra.run.dir=plain")
    assert "a.png: has no transparent background (alpha channel) and no mask" in plain.error
    assert "remove_background=true" in plain.error
    finished = lp("estimate", "images=[a.png,b.png]", "remove_background=true", "hydra.run.dir=run")
    assert finished.status == 0, finished.err
    assert finished.err.count("a rough mask was made by GrabCut") == 1
    for index, place in enumerate(((10, 20), (20, 80))):
        truth = np.asarray(toy_view("soup_can", *place).getchannel("A")) >= 128
        with Image.open(tmp_path / f"run/masks/{index:03d}.png") as file:
            mask = np.asarray(file)[30:-30, 30:-30] >= 128
        assert (mask & truth).sum() > 0.9 * (mask | truth).sum()
    page = (tmp_path / "run/report.html").read_text()
    assert 'alt="mask of a.png"' in page and "The masks are rough, made by GrabCut" in page
    assert abs(float(rows(tmp_path / "run")[1]["relative_longitude_degrees"]) - 60) < 20
    assert json.loads((tmp_path / "run/results.json").read_text())["masks_by"] == "GrabCut"


# ---------------------------------------------------------------- bad input


@pytest.fixture(scope="module")
def general() -> PoseModel:
    return lp_framework.load_model("general")


def confidence(general: PoseModel, reference: Image.Image, query: Image.Image) -> tuple[float, Answer]:
    """The answer's longitude in degrees, and all other output; every number is finite."""
    solution = lp_framework.estimate_pose(reference, query, model=general)
    assert solution.poses.isfinite().all() and solution.energies.isfinite().all() and solution.valid.all()
    (answer,) = answers(solution)
    return math.degrees(answer.longitude), answer


def textured(seed: int, round_: bool) -> Image.Image:
    """A disc or a square of random colours."""
    colours = np.random.default_rng(seed).integers(0, 255, (16, 16, 3), dtype=np.uint8)
    image = Image.fromarray(colours).resize((200, 200), Image.Resampling.BICUBIC).convert("RGBA")
    y, x = np.mgrid[-1:1:200j, -1:1:200j]
    image.putalpha(
        Image.fromarray(np.uint8(255 * (np.hypot(x, y) < 0.98)) if round_ else np.full((200, 200), 255, "u1"))
    )
    frame = Image.new("RGBA", (240, 240))
    frame.paste(image, (20, 20))
    return frame


def recoloured(view: Image.Image, change: Callable[[np.ndarray], np.ndarray]) -> Image.Image:
    """A view with the colours `[H, W, 3]` (floats) that a function makes of its own."""
    pixels = np.array(view)
    pixels[..., :3] = change(pixels[..., :3].astype(float)).round()
    return Image.fromarray(pixels)


@pytest.mark.parametrize("seed", [0, 2])
def test_random_textures_are_not_trusted(general: PoseModel, seed: int):
    for query in (textured(seed + 1, True), textured(seed + 1, False)):
        assert confidence(general, textured(seed, True), query)[1].verdict == "do not trust"


@pytest.mark.parametrize(
    ("reference", "query"),
    [
        ("duck", "robot"),
        ("duck", "soup_can"),
        ("robot", "soup_can"),
        ("cottage", "watering_can"),
        ("sailboat", "soup_can"),
    ],
)
def test_different_objects_are_not_trusted(general: PoseModel, reference: str, query: str):
    answer = confidence(general, toy_view(reference, 10, 20), toy_view(query, 10, 60))[1]
    assert answer.verdict in ("doubtful", "do not trust")


def test_objects_of_one_colour_are_not_trusted(general: PoseModel):
    for name in ("soup_can", "duck"):
        views = [toy_view(name, 10, longitude) for longitude in (20, 80)]
        plain = [recoloured(view, lambda colours: 0 * colours + [200, 160, 60]) for view in views]
        assert confidence(general, *plain)[1].probability < 0.5


@pytest.mark.parametrize(
    ("change", "known"),
    [
        (lambda colours: np.repeat(colours.mean(axis=-1, keepdims=True), 3, axis=-1), True),
        (lambda colours: 0.06 * colours, True),
        (lambda colours: 0 * colours, False),
    ],
    ids=["grey", "very dark", "black"],
)
def test_grey_and_dark_pictures_have_finite_answers(general: PoseModel, change, known: bool):
    views = [recoloured(toy_view("soup_can", *place), change) for place in ((10, 20), (20, 80))]
    longitude, answer = confidence(general, *views)
    assert answer.probability < 0.5 if not known else longitude == pytest.approx(60, abs=15)


def test_a_mask_of_half_the_object_is_used_as_given(general: PoseModel):
    views = [toy_view("soup_can", *place) for place in ((10, 20), (20, 80))]
    pixels = np.array(views[0])
    pixels[:, 128:, 3] = 0
    whole, half = confidence(general, *views)[1], confidence(general, Image.fromarray(pixels), views[1])[1]
    assert half.probability < whole.probability


def test_an_object_cut_by_the_border_is_named(lp, tmp_path: Path):
    files = saved_views(tmp_path, whole=("soup_can", 10, 20), cut=("soup_can", 20, 80))
    with Image.open(tmp_path / "cut.png") as view:
        view.crop((0, 0, 256, 160)).save(tmp_path / "cut.png")
    finished = lp("estimate", f"images=[{','.join(files)}]", "hydra.run.dir=run")
    assert finished.status == 0, finished.err
    assert "cut.png: the image border seems to cut off the object" in finished.err
    assert "whole.png: the image border" not in finished.err
