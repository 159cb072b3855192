"""The paper's figures by name: their arrays against mathematics, and the command from settings to files."""

from __future__ import annotations

import json
import math
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from exact_prior import ExactPrior, image_of
from PIL import Image
from result_folders import metrics, write_result
from tiny_runs import Commands
from view_folders import write_objects

from lp_framework import load_prior, registry
from lp_framework.analysis.fields import (
    Draws,
    ExactModel,
    field_error,
    generated_views,
    model_arrows,
    pose_energies,
    prior_field,
    prior_landscapes,
)
from lp_framework.analysis.landscapes import Landscape, landscape_grid
from lp_framework.analysis.pairs import PRIOR_ENERGY, ShownPair, View, named_pairs, truths
from lp_framework.data.module import PairDataModule
from lp_framework.data.rendering.raycast import RaycastRenderer
from lp_framework.data.sets.rendered import MeshData
from lp_framework.data.views import RenderingsData
from lp_framework.errors import UserError
from lp_framework.figures.landscapes import FailuresFigure, LandscapesFigure, TrajectoriesFigure
from lp_framework.figures.results import CamerasFigure
from lp_framework.geometry import apply_relative_pose, relative_pose
from lp_framework.models.objectives import PoseKernel
from lp_framework.solvers.base import Pairs
from lp_framework.viz.cameras import RED, CameraScene, camera_methods_figure, colour_of
from lp_framework.viz.maps import FailureRow, ends_in_words, failures_figure, minima_in_words

CPU = torch.device("cpu")
VIEWS = torch.tensor([[0.1, 0.4, 1.5], [0.3, 2.9, 1.7], [-0.2, 5.0, 1.3], [0.0, 1.0, 1.6]])
PAIRS = Pairs(image_of(VIEWS), torch.tensor([0, 2]), torch.tensor([1, 3]), torch.tensor([5, 6]))
TRUTH = relative_pose(VIEWS[[0, 2]], VIEWS[[1, 3]])
TWO_VALLEYS = ExactPrior((0.0, math.pi), (0.0, 0.3))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Test views of three objects, ready for use."""
    folder = tmp_path_factory.mktemp("views")
    write_objects(folder / "views", test=4)
    data = PairDataModule(RenderingsData(str(folder / "views")), cache=str(folder / "cache"), image_size=16)
    data.evaluate_on("ordered", 0)
    data.prepare_data()
    return data


# ---------------------------------------------------------------- arrays


def test_a_priors_field_is_minus_the_gradient_of_its_landscape():
    poses = torch.rand(2, 11, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 6.0, 0.5])
    draws = Draws([100, 900], 2, seed=3)
    prior = ExactPrior((0.0, math.pi), (0.0, 0.3), noisy=0.1)
    field = prior_field(prior, PAIRS, poses, draws._replace(batch=6))
    step = 1e-2
    for axis in range(3):
        nudge = step * torch.eye(3)[axis]
        ahead, behind = (prior_field(prior, PAIRS, poses + sign * nudge, draws).energy for sign in (1, -1))
        torch.testing.assert_close(field.score[..., axis], (behind - ahead) / (2 * step), atol=1e-3, rtol=1e-2)
    latitude, longitude = torch.tensor([-0.2, 0.3]), torch.arange(5) * (2 * math.pi / 5)
    found = prior_landscapes(prior, PAIRS, TRUTH[:, 2], (latitude, longitude), draws)
    energies = torch.stack([each.energy for each in found])
    plane = torch.cartesian_prod(latitude, longitude)
    same = torch.cat([plane.expand(2, -1, 2), TRUTH[:, None, 2:].expand(-1, 10, 1)], dim=-1)
    torch.testing.assert_close(prior_field(prior, PAIRS, same, draws).energy.view_as(energies), energies)
    torch.testing.assert_close(pose_energies(prior, PAIRS, same, draws).view_as(energies), energies)


def test_a_density_is_one_at_the_lowest_energy():
    latitude, longitude = landscape_grid()
    energy = 2 - longitude.cos() + latitude.square()[:, None]
    values = Landscape(latitude, longitude, 0.0, energy).density().energy
    assert values.max() == 1 and values.flatten()[energy.argmin()] == 1
    torch.testing.assert_close(values.log(), energy.min() - energy)


def test_the_exact_field_has_error_zero_and_half_of_it_has_error_one_half():
    class Half(ExactModel):
        def field(self, condition, pose):
            field = super().field(condition, pose)
            return field._replace(score=field.score / 2)

    one = Pairs(PAIRS.images, PAIRS.reference[:1], PAIRS.query[:1], PAIRS.ids[:1])
    kernel = PoseKernel()
    assert field_error(ExactModel(kernel, TRUTH[:1]), one, TRUTH[:1], 20.0) == pytest.approx(0, abs=1e-6)
    assert field_error(Half(kernel, TRUTH[:1]), one, TRUTH[:1], 20.0) == pytest.approx(0.5, abs=1e-4)
    (grid,) = model_arrows(ExactModel(kernel, TRUTH[:1]), one, TRUTH[:1, 2], 20.0)
    towards = np.radians(grid.latitude[:, None]) - TRUTH[0, 0].item()
    np.testing.assert_allclose(grid.score[..., 0], np.broadcast_to(-towards, grid.score.shape[:2]), atol=1e-5)
    np.testing.assert_allclose(grid.score[..., 2], 0, atol=1e-6)  # at the true radius


def test_pairs_are_the_requested_views(data):
    pairs, shown = named_pairs(data, ["tram", "cup"], [(2, 0), (1, 3)], CPU)
    table = data.table("test")
    for number, (name, places) in enumerate((("tram", (2, 0)), ("cup", (1, 3)))):
        views = table.views_of(table.names.index(name))[list(places)]
        for view, each in zip(views, (shown[number].reference, shown[number].query), strict=True):
            assert each.file == table.files[view] and np.array_equal(each.pose, table.poses[view])
            with Image.open(table.files[view]) as file:
                rgba = np.asarray(file).astype(float)
            alpha = rgba[..., 3:] / 255
            assert np.abs(rgba[..., :3] * alpha + 255 * (1 - alpha) - each.image).max() <= 1.5
        image = pairs.images[pairs.reference[number]].permute(1, 2, 0).numpy()
        np.testing.assert_allclose(image, shown[number].reference.image / 127.5 - 1, atol=1e-6)
    assert [(pair.object, pair.ambiguity) for pair in shown] == [("tram", "twofold"), ("cup", "unique")]
    reference, query = (
        torch.from_numpy(np.stack([getattr(pair, side).pose for pair in shown])) for side in ("reference", "query")
    )
    torch.testing.assert_close(truths(shown), relative_pose(reference, query).float())
    for wrong, message in (
        ((["cup"], [(0, 4)]), "object 'cup' has test views 0 to 3; there is no query 4"),
        ((["cup"], [(1, 1)]), "reference and query must be two different views, got 1 for both"),
        ((["cap"], [(0, 1)]), "no object 'cap'; did you mean 'cup'"),
    ):
        with pytest.raises(UserError, match=message):
            named_pairs(data, *wrong, CPU)


def test_landscapes_state_the_number_of_minima(data):
    def gathered(prior):
        return LandscapesFigure(["cup"], data=data, prior=prior, timesteps=[500]).analyse(0, CPU)[0].prior_energy

    both, one = gathered(TWO_VALLEYS), gathered(ExactPrior())
    assert (minima_in_words(both), minima_in_words(one)) == ("2 minima", "1 minimum")
    assert both.energy.shape == (16, 30)
    assert minima_in_words(gathered(ExactPrior(stiffness=0.0))) == "plateau"  # nothing to tell anywhere


def test_trajectories_start_at_four_longitudes_and_show_views_along_them(data):
    settings = {"data": data, "prior": ExactPrior(), "reference": 1, "query": 2, "timesteps": [500]}
    figure = TrajectoriesFigure("cup", steps=40, views=3, **settings)
    pair, images = figure.analyse(0, CPU)
    trajectories = pair.trajectories
    assert trajectories.shape == (4, 41, 3) and figure.shown_steps == [0, 10, 40]
    np.testing.assert_allclose(np.degrees(trajectories[:, 0, 1]) % 360, [0, 90, 180, 270], atol=1e-3)
    assert [start for start, _ in ends_in_words(pair)] == ["0°", "90°", "180°", "270°"]
    # An image of this prior holds its pose in the first three numbers: the views' are those of the trajectory.
    pairs, _ = named_pairs(data, ["cup"], [(1, 2)], CPU)
    pose = pairs.images[pairs.reference][0].flatten()[:3]
    for views, path in zip(images, trajectories, strict=True):
        generated = 2 * views.transpose(0, 3, 1, 2).reshape(3, -1)[:, :3] - 1
        np.testing.assert_allclose(generated, np.clip(pose.numpy() + path[figure.shown_steps], -1, 1), atol=1e-5)


def test_generated_views_differ_by_their_poses_alone():
    """Independent of the rest of the batch."""
    prior = load_prior("tiny")
    source = prior.encode(torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0)) * 2 - 1)
    poses = torch.tensor([[0.0, 0.5, 0.0], [0.2, 3.0, 0.0], [0.0, 0.5, 0.0]])
    together = generated_views(prior, source, poses, 5, 1.0, seed=4)
    assert together.shape == (3, 64, 64, 3)
    np.testing.assert_allclose(together[0], together[2], atol=1e-6)
    assert np.abs(together[0] - together[1]).max() > 0.01
    np.testing.assert_allclose(generated_views(prior, source, poses, 5, 1.0, seed=4, batch=2), together, atol=1e-5)


# ---------------------------------------------------------------- cameras


def test_a_camera_panel_has_every_camera():
    poses = VIEWS.double().numpy()
    predicted = np.repeat(poses[1:, None], 2, axis=1) + 0.1
    wild = predicted.copy()
    wild[0, 1] = math.nan  # a start that failed
    images = [Image.new("RGBA", (8, 8))] * 4
    scene = CameraScene("cup", images, poses, np.full(4, math.radians(49)), [predicted, wild], ["", ""])
    figure = camera_methods_figure([scene, scene], ["one", "other"])
    counted = [
        {kind: [each for each in axes.collections if each.get_gid() == kind] for kind in ("true", "predicted")}
        for axes in figure.axes
        if any(each.get_gid() == "true" for each in axes.collections)
    ]
    numbers = [tuple(len(each) for each in panel.values()) for panel in counted]
    assert numbers == [(4, 6), (4, 5)] * 2
    bold, thin = (counted[0][kind][0].get_linewidth()[0] for kind in ("true", "predicted"))
    assert bold > 2 * thin
    assert colour_of(0) == RED and len({colour_of(index) for index in range(6)}) == 6


def test_predicted_cameras_stand_where_the_solver_says(data):
    figure = CamerasFigure(data, ExactPrior(), ["cup", "tram"], targets=5, methods=["ifusion"], starts=2)
    scenes = figure.analyse(0, CPU)
    assert [scene.title for scene in scenes] == ["cup", "tram"] and figure.named == ["iFusion"]
    places = [(0, 1), (0, 2), (0, 3)]  # there are no more
    pairs, shown = named_pairs(data, ["cup"] * 3 + ["tram"] * 3, places * 2, CPU)
    solution = figure.solvers[0].solve(pairs, registry.build("start", {"name": "random", "count": 2}).make(pairs, 0), 0)
    references = torch.from_numpy(np.stack([pair.reference.pose for pair in shown]))
    cameras = apply_relative_pose(references[:, None], solution.poses.detach().double()).numpy()
    for number, scene in enumerate(scenes):
        np.testing.assert_allclose(scene.predicted[0], cameras[3 * number : 3 * number + 3], atol=1e-6)
        own = shown[3 * number : 3 * number + 3]
        np.testing.assert_allclose(scene.poses[1:], np.stack([pair.query.pose for pair in own]))
        assert len(scene.images) == 4 and scene.words[0].endswith("of 6 within 15°")


# ---------------------------------------------------------------- views from the mesh


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """Two boxes with coloured sides, rendered small."""
    folder = tmp_path_factory.mktemp("meshes")
    (folder / "boxes").mkdir()
    box = trimesh.creation.box((1.0, 0.7, 0.4))
    box.visual.face_colors = np.random.default_rng(0).integers(0, 255, (12, 3)).repeat(1, axis=0)
    for name in ("box", "crate"):
        box.export(folder / "boxes" / f"{name}.ply")
    source = MeshData(
        RaycastRenderer(), str(folder / "boxes"), str(folder / "views"), resolution=64, test_views=2, workers=1,
        latitude_step_degrees=60, longitude_step_degrees=180,
    )  # fmt: skip
    data = PairDataModule(source, cache=str(folder / "cache"), image_size=64)
    data.evaluate_on("ordered", 0)
    data.prepare_data()
    return data


def test_a_rendered_view_at_the_references_own_pose_is_the_reference(meshes):
    figure = FailuresFigure(["box"], views=4, data=meshes, prior=TWO_VALLEYS, timesteps=[500])
    (row,) = figure.analyse(0, CPU)
    assert {"0°", "90°", "180°", "270°"} <= {axes.get_title() for axes in figure.draw([row])[0].axes}
    assert row.rendered is not None and row.rendered.shape == (4, 256, 256, 3) and len(row.generated) == 4
    small = row.rendered[0].reshape(64, 4, 64, 4, 3).mean(axis=(1, 3))
    assert np.abs(small - row.pair.reference.image / 255).mean() < 0.01
    assert np.abs(row.rendered[1] - row.rendered[0]).mean() > 0.02
    # Half a turn around is the reference's pose again, half a turn on.
    _, (shown,) = named_pairs(meshes, ["box"], [(0, 1)], CPU)
    pose = torch.from_numpy(shown.reference.pose)[None]
    turned = figure.rendered(shown, pose + torch.tensor([0.0, math.pi, 0.0]))
    assert turned is not None
    np.testing.assert_allclose(turned[0], row.rendered[2], atol=1 / 255)


def test_without_a_mesh_there_is_only_what_the_prior_generates(data):
    figure = FailuresFigure(["vase"], views=3, data=data, prior=TWO_VALLEYS, timesteps=[500])
    (row,) = figure.analyse(0, CPU)
    assert row.rendered is None
    view, views = View(Path("0.png"), np.zeros((8, 8, 3)), np.zeros(3)), np.zeros((3, 8, 8, 3))
    slope = Landscape(*landscape_grid(), 0.0, torch.linspace(0, 1, 480).view(16, 30))
    pair = ShownPair("vase", "continuous", "", view, view, np.zeros(3), landscapes={PRIOR_ENERGY: slope})
    row = FailureRow(pair, None, views)
    bare = failures_figure([row])
    both = failures_figure([row._replace(rendered=views)])
    assert len(both.axes) == len(bare.axes) + 3


# ---------------------------------------------------------------- the command

PRIOR = """
    import math

    from exact_prior import ExactPrior

    from lp_framework.registry import register


    @register("prior", "tmp_valleys")
    class Valleys(ExactPrior):
        "Two minima."

        def __init__(self) -> None:
            super().__init__((0.0, math.pi), (0.0, 0.3))
"""


@pytest.fixture(scope="module")
def commands(tmp_path_factory, trained):
    """A working folder with tiny views, the prior above, and a score and an energy model that have trained a little."""
    commands = Commands(tmp_path_factory.mktemp("figures"), trained=trained)
    (commands.folder / "plugins" / "tmp_tiny_valleys").mkdir()
    (commands.folder / "plugins" / "tmp_tiny_valleys" / "tmp_tiny_valleys.py").write_text(textwrap.dedent(PRIOR))
    return commands


def write_starts(folder: Path) -> Path:
    for solver in ("ifusion", "two_stage"):
        for count in (2, 4):
            config = {"solver.name": solver, "start.name": "random", "start.count": count}
            write_result(folder / f"{solver}{count}", config, metrics(0.5 + 0.1 * count), experiment="starts")
    return folder


SMALL = {
    "landscapes": ["figure.objects=[cup,vase,tram]", "figure.longitude_step_degrees=30", "figure.timesteps=[500]"],
    "trajectories": ["figure.object=tram", "figure.steps=3", "figure.timesteps=[500]"],
    "toy": ["figure.object=tram", "figure.score=score", "figure.energy=energy", "figure.timesteps=[500]"],
    "cameras": ["figure.objects=[cup,tram]", "figure.targets=2", "figure.score=score"],
    "recall": ["figure.runs=starts"],
    "score_vs_energy": ["figure.objects=[cup,mug]", "figure.score=score", "figure.energy=energy"],
    "failures": ["figure.objects=[vase]", "figure.views=3", "figure.timesteps=[500]"],
}


@pytest.mark.parametrize("name", SMALL)
def test_the_command_writes_the_figure_and_its_caption(commands, name):
    if name == "recall":
        write_starts(commands.folder / "starts")
    settings = [f"experiment=figure_{name}", "prior=tmp_valleys", *SMALL[name]]
    ran = commands.here(f"runs/{name}", "figure", *settings)
    assert ran.status == 0, ran.err
    png, pdf = (ran.folder / f"figure_{name}.{suffix}" for suffix in ("png", "pdf"))
    with Image.open(png) as picture:
        assert picture.width >= 1400 and picture.height >= 400  # 7 inches, 200 dots each
    assert pdf.read_bytes().startswith(b"%PDF")
    record = json.loads((ran.folder / "figure.json").read_text())
    assert record["files"] == [png.name, pdf.name] and record["config"]["figure"]["name"] == name
    assert record["caption"] in ran.out and "None" not in record["caption"] and record["versions"]["torch"]


def test_every_figure_has_an_experiment_and_a_line_in_the_docs():
    root = Path(__file__).parents[1]
    assert sorted(SMALL) == registry.names("figure")
    described = (root / "docs" / "figures.md").read_text()
    for name in SMALL:
        assert (root / "conf" / "experiment" / f"figure_{name}.yaml").is_file()
        assert f"experiment=figure_{name}" in described


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            ["figure=toy"],
            "needs an energy model, and none is bundled: train one with `python -m lp_framework train model=en",
        ),
        (["figure=toy", "figure.energy=score"], "figure.energy=score: contains no energy model"),
        (["figure=cameras", "figure.score=energy"], "figure.score=energy: contains no score model"),
        (["figure=toy", "figure.energy=energy", "figure.object=cap"], "the data set has no object 'cap'; did you mean"),
        (["figure=recall", "figure.runs=none"], "runs=none: there is no such folder"),
        (["figure=recall", "figure.runs=score"], "no finished runs with several numbers of starts; run `python"),
        (
            ["figure=failures", "figure.objects=[cup]", "figure.timesteps=[1000]"],
            "this prior has timesteps 0 to 999, got 1000",
        ),
        (["figure=landscapes", "figure.noises=0"], "noises must be a whole number, at least 1, got 0"),
        (["figure=landscapes", "figure.longitude_step_degrees=50"], "longitude_step_degrees must divide 360"),
        (["figure=landscapes", "figure.objects=[]"], "figure.objects needs the name of at least one object"),
        (["figure=trajectories", "figure.views=9"], "figure.views must be 2 to 5"),
        (["figure=cameras", "figure.methods=[ifuzion]"], "there is no solver 'ifuzion'; did you mean 'ifusion'"),
        (["figure=failures", "figure.views=1"], "figure.views must be 2 to 12"),
    ],
)
def test_a_mistake_is_one_sentence(commands, settings, message):
    assert message in commands.here("runs/mistake", "figure", "prior=tmp_valleys", *settings).error
