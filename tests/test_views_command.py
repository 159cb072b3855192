"""`views`: every view is generated at its pose, named by its angles, and reproducible."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from PIL import Image
from view_folders import write_objects

from lp_framework.commands.views import angles

PRIOR = '''
    import torch

    from lp_framework.priors.base import Prior, ViewCode
    from lp_framework.registry import register


    @register("prior", "tmp_painter")
    class Painter(Prior):
        """Paints the cosines of pose and source into red, the steps into green, draws of its own into blue."""

        calls = []

        def __init__(self, tone: float = 0.0) -> None:
            super().__init__()
            self.num_timesteps, self.latent_shape, self.image_size, self.tone = 1000, (1, 1, 1), 8, tone

        def encode(self, images):
            return ViewCode(images.mean(dim=(1, 2, 3), keepdim=True), images.new_zeros(len(images), 1, 0))

        def residual(self, target, source, pose, timestep, noise):
            raise NotImplementedError

        def generate(self, source, pose, steps=50, guidance=3.0, generator=None, eta=1.0):
            self.calls.append((pose, guidance, eta, source.latent.flatten()))
            image = torch.zeros(len(pose), 3, 8, 8)
            image[:, 0] = (pose[:, :2].cos().prod(dim=1))[:, None, None]
            image[:, 1] = steps / 100
            image[:, 2] = 2 * torch.rand(8, 8, generator=generator) - 1
            return image
'''


@pytest.fixture(autouse=True)
def figures(request):
    """They are drawn for the test that looks at them."""
    if request.function is not test_the_picture_shows_the_views_beside_the_source:
        request.getfixturevalue("no_drawing")


@pytest.fixture
def draw(lp, write, tmp_path):
    """`draw("seed=1")` runs the command with the painter on tiny views; the folder of the run."""
    write("plugins/tmp_painter/tmp_painter.py", PRIOR)
    write_objects(tmp_path / "views", size=32)
    settings = {"prior": "tmp_painter", "data": "renderings", "data.path": "views", "object": "tram"}

    def run(*overrides):
        given = dict(override.split("=", 1) for override in overrides)
        folder = given.setdefault("hydra.run.dir", "run")
        ran = lp("views", *(f"{key}={value}" for key, value in {**settings, **given}.items()))
        assert ran.status == 0, ran.err
        return tmp_path / folder

    return run


def mistake(draw, lp, *overrides):
    ran = lp("views", "prior=tmp_painter", "data=renderings", "data.path=views", "object=tram", *overrides)
    assert ran.status == 1
    return ran.error


def read(file):
    return np.asarray(Image.open(file)).astype(float) / 127.5 - 1


def calls():
    import tmp_painter

    return tmp_painter.Painter.calls


# ---------------------------------------------------------------- what is drawn


def test_every_view_is_drawn_at_the_pose_that_its_record_and_its_name_say(draw):
    folder = draw("longitudes=4", "latitudes_degrees=[30,-7.5]")
    views = json.loads((folder / "views.json").read_text())["views"]
    assert [(view["relative_latitude_degrees"], view["relative_longitude_degrees"]) for view in views] == [
        (latitude, longitude) for latitude in (30, -7.5) for longitude in (0, 90, 180, 270)
    ]
    assert views[1]["file"] == "views/latitude+30_longitude090.png"
    assert sorted(file.name for file in (folder / "views").iterdir()) == sorted(
        view["file"].removeprefix("views/") for view in views
    )
    for view in views:
        latitude, longitude, radius = view["relative_pose"]
        assert math.degrees(latitude) == pytest.approx(view["relative_latitude_degrees"], abs=1e-4) and radius == 0
        assert math.degrees(longitude) == pytest.approx(view["relative_longitude_degrees"], abs=1e-4)
        red, green, _ = read(folder / view["file"])[0, 0]
        assert red == pytest.approx(math.cos(latitude) * math.cos(longitude), abs=0.01)
        assert green == pytest.approx(0.5, abs=0.01)  # 50 steps


def test_the_default_grid():
    latitudes, longitudes = angles([20, 0, -20], 12)
    assert latitudes == [20.0, 0.0, -20.0] and longitudes == [30.0 * number for number in range(12)]


def test_a_column_is_drawn_together_with_the_settings(draw):
    draw("longitudes=5", "guidance=2.5", "eta=0.25")
    assert [len(pose) for pose, *_ in calls()] == [3] * 5
    assert {call[1:3] for call in calls()} == {(2.5, 0.25)}


def test_the_picture_shows_the_views_beside_the_source(draw):
    folder = draw("longitudes=4")
    assert {"views.png", "views.pdf", "source.png"} <= {file.name for file in folder.iterdir()}
    with Image.open(folder / "views.png") as picture:
        assert picture.width > picture.height > 300


# ---------------------------------------------------------------- draws


def test_all_views_have_the_same_draws(draw):
    folder = draw("longitudes=3")
    noise = [np.asarray(Image.open(file))[..., 2] for file in sorted((folder / "views").iterdir())]
    assert np.ptp(noise[0]) > 100 and all(np.array_equal(each, noise[0]) for each in noise)


def test_the_same_seed_draws_the_same_views(draw):
    def views(*overrides):
        folder = draw("longitudes=2", "latitudes_degrees=[0]", *overrides)
        return [file.read_bytes() for file in sorted((folder / "views").iterdir())]

    first = views("seed=1", "hydra.run.dir=a")
    torch.manual_seed(5)  # whatever was drawn before
    assert views("seed=1", "hydra.run.dir=b") == first
    other = views("seed=2", "hydra.run.dir=c")
    assert all(one != another for one, another in zip(first, other, strict=True))


# ---------------------------------------------------------------- the source


def test_a_data_sets_object_is_its_first_test_view(draw, tmp_path):
    folder = draw("longitudes=1")
    view = tmp_path / "views" / "tram" / "test" / "rgb" / "000.png"
    assert json.loads((folder / "views.json").read_text())["source"] == "views/tram/test/rgb/000.png"
    with Image.open(folder / "source.png") as source, Image.open(view) as image:
        assert source.size == (256, 256)
        small = source.convert("RGBa").resize(image.size, Image.Resampling.BOX).convert("RGBA")
        difference = np.abs(np.asarray(small, dtype=float) - np.asarray(image))[np.asarray(image)[..., 3] > 200]
    assert np.median(difference) < 5  # neither cropped nor turned


def disc(size=(60, 40), centre=(15, 22), radius=8, mode="RGBA"):
    """A red disc, transparent around it, or on white."""
    y, x = np.mgrid[: size[1], : size[0]]
    inside = np.hypot(x - centre[0], y - centre[1]) <= radius
    image = Image.fromarray(np.where(inside[..., None], [255, 0, 0, 255], [255, 255, 255, 0]).astype(np.uint8))
    return image if mode == "RGBA" else image.convert(mode)


def test_an_image_is_cropped_to_its_object(draw, tmp_path):
    disc().save(tmp_path / "disc.png")
    folder = draw("image=disc.png", "longitudes=1", "object=nobody", "data.path=nowhere")
    with Image.open(folder / "source.png") as source:
        left, top, right, bottom = source.getchannel("A").point([0] * 128 + [255] * 128).getbbox()
    assert abs(left + right - 256) <= 4 and abs(top + bottom - 256) <= 4 and abs(right - left - 200) <= 8
    record = json.loads((folder / "views.json").read_text())
    assert record["source"] == "disc.png"


def test_an_image_on_white_is_taken_whole(draw, tmp_path):
    disc(size=(40, 40), mode="RGB").save(tmp_path / "disc.png")
    folder = draw("image=disc.png", "crop=false", "longitudes=1")
    source = np.asarray(Image.open(folder / "source.png").convert("RGB"))
    red = (source[..., 0] > 128) & (source[..., 1] < 128)
    assert source.shape == (256, 256, 3) and np.argwhere(red).mean(0) == pytest.approx([22.5 * 6.4, 15.5 * 6.4], abs=2)
    ((_, _, _, brightness),) = calls()  # the prior has seen it on white
    assert brightness[0].item() == pytest.approx((source / 127.5 - 1).mean(), abs=0.01)


def test_a_mask_selects_the_object(draw, tmp_path, write):
    disc(mode="RGB").save(tmp_path / "disc.png")
    (tmp_path / "masks").mkdir()
    disc().getchannel("A").save(tmp_path / "masks" / "disc.png")
    folder = draw("image=disc.png", "masks=masks", "longitudes=1")
    with Image.open(folder / "source.png") as source:
        assert source.getchannel("A").getextrema() == (0, 255)


def test_the_prior_that_ships_draws_the_embedded_objects(lp, tmp_path):
    disc().save(tmp_path / "disc.png")
    ran = lp("views", "image=disc.png", "longitudes=2", "steps=2", "hydra.run.dir=run")
    assert ran.status == 0, ran.err
    assert len(list((tmp_path / "run" / "views").iterdir())) == 6


# ---------------------------------------------------------------- mistakes


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("object=tran", "the data set has no object 'tran'; did you mean 'tram'? (known: cup, tram, vase)"),
        ("image=nowhere.png", "image=nowhere.png: there is no such file"),
        ("image=.", ".: is a folder; give an image file"),
        ("longitudes=0", "longitudes must be a whole number, at least 1, got 0"),
        ("longitudes=2.5", "longitudes must be a whole number, at least 1, got 2.5"),
        ("latitudes_degrees=[]", "latitudes_degrees must list different angles between -180 and 180, got []"),
        (
            "latitudes_degrees=[9,9.0]",
            "latitudes_degrees must list different angles between -180 and 180, got [9, 9.0]",
        ),
        ("latitudes_degrees=20", "latitudes_degrees must list different angles between -180 and 180, got 20"),
        ("latitudes_degrees=[low]", "latitudes_degrees must list different angles between -180 and 180, got ['low']"),
        ("seed=-1", "seed must be a whole number between 0 and 2^32 - 1, got -1"),
        ("steps=2.5", "steps=2.5 does not fit; expected int"),
        ("accelerator=tpu", "accelerator=tpu is not available on this machine; choose auto or cpu"),
    ],
)
def test_mistakes(draw, lp, setting, sentence):
    assert mistake(draw, lp, setting).startswith(sentence)


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("steps=0", "steps must lie between 1 and 1000, got 0"),
        ("guidance=-1", "guidance must not be negative, got -1"),
        ("eta=1.5", "eta must lie in [0, 1], got 1.5"),
    ],
)
def test_the_prior_says_which_sampling_there_is(lp, tmp_path, setting, sentence):
    disc().save(tmp_path / "disc.png")
    assert lp("views", "image=disc.png", "longitudes=1", setting).error.startswith(sentence)


def test_an_image_without_background_says_what_to_do(draw, lp, tmp_path):
    disc(mode="RGB").save(tmp_path / "disc.png")
    assert "or crop=false if it shows the object on white" in mistake(draw, lp, "image=disc.png")
    assert "must be square" in mistake(draw, lp, "image=disc.png", "crop=false")
