"""Figures: the drawn arrays are correct, and files are complete."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.quiver import Quiver
from torch import Tensor, nn

from lp_framework.analysis.examples import EXAMPLES, gather_examples, pick_examples, read_examples
from lp_framework.analysis.fields import ExactModel, grid_poses, model_arrows, model_field
from lp_framework.analysis.landscapes import Arrows, cell_grid
from lp_framework.analysis.pairs import PoseMap, ShownPair, View, in_one_scale
from lp_framework.commands.eval import save_pictures
from lp_framework.data.pairs import PairData, ViewTable
from lp_framework.data.views import ObjectViews
from lp_framework.errors import UserError
from lp_framework.evaluation.breakdown import breakdown
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.evaluation.metrics import summarise
from lp_framework.geometry import camera_to_world, wrap_angle
from lp_framework.models.backbones import Backbone
from lp_framework.models.objectives import PoseKernel
from lp_framework.models.pose_model import EnergyModel, ScoreModel
from lp_framework.solvers.base import Cost, Pairs, Solution, Solver
from lp_framework.solvers.langevin import Langevin
from lp_framework.solvers.starts import Grid as GridStarts
from lp_framework.solvers.starts import Ring
from lp_framework.viz import sheets
from lp_framework.viz.curves import (
    Curve,
    cumulative,
    errors_figure,
    read_losses,
    save_training_picture,
    training_figure,
)
from lp_framework.viz.maps import broken_at_seam, draw_map, pair_figure
from lp_framework.viz.sheets import ObjectCard, objects_figure
from lp_framework.viz.style import ANSWER, CLASS_COLOURS, save_figure

TRUTH = torch.tensor([0.3, 5.6, 0.2])
IMAGE = np.zeros((8, 8, 3), dtype=np.uint8)
PAIR = Pairs(torch.zeros(2, 3, 8, 8), torch.tensor([0]), torch.tensor([1]), torch.tensor([0]))


def pair_of(maps: list[PoseMap], truth: np.ndarray) -> ShownPair:
    """A pair with maps."""
    view = View(Path("000.png"), IMAGE, np.zeros(3))
    return ShownPair("tram", "twofold", "", view, view, truth, maps=maps)


# ------------------------------------------------------------ trajectories at the seam


@settings(deadline=None)
@given(
    st.floats(-1000, 1000),
    st.lists(st.tuples(st.floats(-175, 175), st.floats(-10, 10)), min_size=1, max_size=30),
    st.booleans(),
)
def test_path_on_the_map_is_the_path_on_the_circle(start: float, steps: list[tuple[float, float]], reduced: bool):
    longitude = start + np.cumsum([0.0, *(step for step, _ in steps)])
    latitude = np.cumsum([0.0, *(step for _, step in steps)])
    drawn_latitude, drawn = broken_at_seam(latitude, longitude % 360 if reduced else longitude)
    assert drawn[~np.isnan(drawn)].min() >= 0 and drawn[~np.isnan(drawn)].max() <= 360
    lengths = np.abs(np.diff(drawn))
    assert np.nanmax(lengths) <= 180  # no line across the map
    # Nothing is lost or added: the lengths are those of the steps, along both axes.
    assert np.nansum(lengths) == pytest.approx(np.abs(np.diff(longitude)).sum(), abs=1e-6)
    assert np.nansum(np.abs(np.diff(drawn_latitude))) == pytest.approx(np.abs(np.diff(latitude)).sum(), abs=1e-6)
    for gap in np.flatnonzero(np.isnan(drawn)):
        assert {drawn[gap - 1], drawn[gap + 1]} == {0.0, 360.0}
        assert drawn_latitude[gap - 1] == drawn_latitude[gap + 1]


def test_a_path_that_stays_on_the_map_is_unchanged():
    latitude, longitude = broken_at_seam(np.array([1.0, 2.0, 3.0]), np.array([350.0, 340.0, 355.0]))
    assert latitude.tolist() == [1, 2, 3] and longitude.tolist() == [350, 340, 355]


# ------------------------------------------------------------ fields


def test_grid_fills_the_map_at_one_radius():
    grid = cell_grid(12.0)
    latitude, longitude = (torch.rad2deg(each) for each in grid)
    torch.testing.assert_close(latitude, torch.arange(-54.0, 60.0, 12.0))
    torch.testing.assert_close(longitude, torch.arange(6.0, 360.0, 12.0))
    poses = grid_poses(torch.tensor([0.25, 0.5]), *grid)
    assert poses.shape == (2, 10, 30, 3) and poses.dtype == torch.float32
    assert (poses[0, ..., 2] == 0.25).all() and (poses[1, ..., 2] == 0.5).all()
    assert torch.equal(poses[1, :, 3, 0], grid[0]) and torch.equal(poses[1, 3, :, 1], grid[1])


@pytest.mark.parametrize("sigma", [0.5, 1.0])
@pytest.mark.parametrize("target", ["line", "periodic"])
def test_exact_field_on_the_grid_is_the_closed_form(target: str, sigma: float):
    model, radius = ExactModel(PoseKernel(target, sigma), TRUTH[None], has_energy=True), torch.tensor([0.4])
    (grid,) = model_arrows(model, PAIR, radius, spacing=12.0)
    latitude, longitude = np.meshgrid(np.deg2rad(grid.latitude), np.deg2rad(grid.longitude), indexing="ij")
    dlat, dlon = latitude - TRUTH[0].item(), longitude - TRUTH[1].item()
    turns = 2 * math.pi * np.arange(-9, 10) if target == "periodic" else np.zeros(1)
    images = dlon[..., None] + turns
    density = np.exp(-(images**2) / (2 * sigma**2))
    expected = np.stack(
        [-dlat, -(density * images).sum(-1) / density.sum(-1), np.full_like(dlat, TRUTH[2].item() - 0.4)], axis=-1
    )
    np.testing.assert_allclose(grid.score, expected / sigma**2, atol=2e-5 / sigma**4)
    energy = (dlat**2 + 0.2**2) / (2 * sigma**2) - np.log(density.sum(-1))
    found = model_field(model, PAIR, radius, cell_grid(12.0)).energy
    assert found is not None
    np.testing.assert_allclose(found[0] - found.min(), energy - energy.min(), atol=2e-5)


def exact_map(starts: int = 3) -> PoseMap:
    kernel = PoseKernel()
    start = torch.tensor([[0.0, 0.0, 0.0], [0.4, 2.0, 0.0], [-0.4, 4.0, 0.0]])[:starts]
    path = [start]
    for _ in range(60):
        path.append(path[-1] + 0.1 * kernel.score(path[-1], TRUTH))
    (arrows,) = model_arrows(ExactModel(kernel, TRUTH[None]), PAIR, torch.tensor([0.2]), 12.0)
    paths = torch.stack(path, dim=1).numpy()
    solved = replace(pair_of([], TRUTH.numpy()), chosen=starts - 1, starts=start.numpy())
    solved = replace(solved, trajectories=paths, ends=paths[:, -1])
    return PoseMap("Exact score", arrows=arrows, solved=solved)


def test_the_page_of_a_pair_shows_arrows_trajectories_answer_and_truth():
    content = exact_map()
    figure = pair_figure(pair_of([], TRUTH.numpy()), [content, content], "tram (twofold)", "worst: 36°")
    maps = [axes for axes in figure.axes if axes.get_title("left") == "Exact score"]
    assert len(maps) == 2 and [axes.get_title("left") for axes in figure.axes[:2]] == ["reference", "query"]
    assert "tram (twofold)" in [text.get_text() for text in figure.texts]
    for axes in maps:
        assert axes.get_xlim() == (0, 360) and axes.get_ylim() == (-60, 60)
        assert "latitude" in axes.get_ylabel()
        (quiver,) = [artist for artist in axes.collections if isinstance(artist, Quiver)]
        assert content.arrows is not None
        np.testing.assert_allclose(quiver.U, content.arrows.score[..., 1].ravel())
        np.testing.assert_allclose(quiver.V, content.arrows.score[..., 0].ravel())
        stars = [line.get_xydata() for line in axes.lines if line.get_marker() == "*" and len(line.get_xdata())]
        np.testing.assert_allclose(stars, [np.rad2deg([[5.6, 0.3]])], rtol=1e-6)
        lines = [line for line in axes.lines if line.get_linestyle() == "-"]
        assert len(lines) == 3 and [to_hex(line.get_color()) == ANSWER.lower() for line in lines] == [
            False,
            False,
            True,
        ]
        for line in lines:
            assert np.nanmax(np.abs(np.diff(line.get_xdata()))) <= 180
            np.testing.assert_allclose(line.get_xydata()[-1], np.rad2deg([5.6, 0.3]), atol=0.5)
    # The first start lies on the seam and is marked on both edges.
    starts = np.concatenate([line.get_xdata() for line in maps[0].lines if line.get_markerfacecolor() == "white"])
    assert sorted(starts.round()) == [0, 115, 229, 360]
    assert maps[1].get_xlabel().startswith("longitude")
    figure.draw_without_rendering()
    labels = dict(zip(maps[1].get_xticks(), maps[1].get_xticklabels(), strict=True))
    assert [labels[longitude].get_text() for longitude in (0, 60, 120)] == ["0°", "60°", "120°"]
    assert 30 in maps[1].get_yticks()


def test_map_of_steep_views_shows_the_truth():
    steep = np.array([1.4, 0.0, 0.0])
    figure = pair_figure(pair_of([], steep), [PoseMap("Starts and answer")], "a", "b")
    assert figure.axes[-1].get_ylim() == (-90, 90)


def test_broken_model_is_drawn_too():
    content = exact_map(1)
    assert content.arrows is not None and content.solved is not None and content.solved.trajectories is not None
    nowhere = content.arrows._replace(score=np.full_like(content.arrows.score, np.nan))
    solved = replace(content.solved, chosen=0, trajectories=content.solved.trajectories * np.nan)
    lost = PoseMap("Learned score", arrows=nowhere, solved=solved)
    pair_figure(pair_of([], TRUTH.numpy()), in_one_scale([lost, lost]), "a", "b").draw_without_rendering()


def test_arrows_are_drawn_in_the_scale_that_they_are_given():
    arrows = Arrows(np.array([-30.0, 30.0]), np.array([90.0, 270.0]), np.full((2, 2, 3), 0.5))
    for each, scale in ((arrows, math.sqrt(0.5)), (arrows._replace(scale=2.0), 2.0)):
        quiver = draw_map(Figure().add_subplot(), PoseMap(arrows=each))
        assert quiver is not None and quiver.norm.vmax == pytest.approx(scale)


# ------------------------------------------------------------ which pairs


def test_pairs_are_picked_failures_first():
    errors = np.array([3.0, 170.0, 1.0, 60.0, 8.0, 170.0, 5.0, 90.0])
    objects = np.array([0, 1, 0, 0, 0, 1, 0, 1])
    picks = pick_examples(errors, objects, ["a", "b"], [True, False])
    assert list(picks) == [1, 3, 6, 2]  # ambiguous, worst, median, best
    assert [reason.split()[0] for reason in picks.values()] == ["median", "worst", "median", "best"]
    assert picks[1] == "median of 3 pairs without a unique answer"
    assert picks[3] == "worst of 5 pairs with a unique answer"
    assert picks == pick_examples(errors, objects, ["a", "b"], [True, False])


@pytest.mark.parametrize(
    ("errors", "unique_answer", "rows"),
    [
        ([1.0, 9.0, 2.0, 9.0], None, [1, 2, 0]),  # unlabelled ones are picked among all
        ([1.0, np.nan, 179.0], True, [1, 2, 0]),  # a pair without an answer is the worst
        ([7.0], True, [0]),
    ],
)
def test_the_worst_the_median_and_the_best_are_picked(errors: list[float], unique_answer: bool | None, rows: list[int]):
    picks = pick_examples(np.array(errors), np.zeros(len(errors), int), ["a"], [unique_answer])
    assert list(picks) == rows


# ------------------------------------------------------------ errors


def at(line: matplotlib.lines.Line2D, x: float) -> float:
    """The value of a staircase at x."""
    return float(line.get_ydata()[np.searchsorted(line.get_xdata(), x, side="right") - 1])


@pytest.mark.parametrize("starts", [1, 9])
def test_cumulative_curves_are_the_metrics(starts: int):
    generator = torch.Generator().manual_seed(0)
    rotation = 60 * torch.rand(70, starts, generator=generator).double() ** 2
    rotation[0, 0] = 15.0  # at a threshold counts as within it
    rotation[1] = torch.nan  # never within any
    translation = rotation / 40
    chosen = torch.randint(starts, (70,), generator=generator)
    classes = ["unique"] * 40 + ["continuous"] * 30
    figure = errors_figure(rotation.numpy(), translation.numpy(), chosen.numpy(), classes)
    left, right = figure.axes
    curves = {line.get_label(): line for line in left.lines if line.get_drawstyle() == "steps-post"}
    assert len(curves) == 2 * (1 if starts == 1 else 2)
    for name, rows in (("unique", slice(0, 40)), ("continuous", slice(40, 70))):
        metrics = summarise(rotation[rows], translation[rows], chosen[rows])
        for degrees in (5, 15, 30):
            assert at(curves[name], degrees) == pytest.approx(metrics[f"R(R)@{degrees}"])
            if starts > 1:
                assert at(curves[f"{name}, all starts"], degrees) == pytest.approx(metrics[f"SR(R)@{degrees}"])
    assert left.get_xlim() == (0, 180) and "rotation error" in left.get_xlabel()
    assert {5, 15, 30} <= set(left.get_xticks()) and 0.2 in right.get_xticks()
    assert "translation error" in right.get_xlabel()
    keys = [text.get_text() for text in figure.legends[0].get_texts()]
    assert keys[:2] == ["unique (40 pairs)", "continuous (30 pairs)"]
    assert ("all 9 starts" in keys) == (starts > 1)


def test_cumulative_of_nothing_reached_is_zero():
    x, share = cumulative(np.array([np.nan, np.inf, 200.0]), 180.0)
    assert x.tolist() == [0, 180] and share.tolist() == [0, 0]


# ------------------------------------------------------------ objects


def names_on(figure: Figure) -> list[str]:
    return [axes.get_title("left") for axes in figure.axes]


def test_objects_are_sorted_worst_first():
    cards = [
        ObjectCard("good", "unique", IMAGE, 0.9, 0.9),
        ObjectCard("tie_b", "unique", IMAGE, 0.5, 0.6),
        ObjectCard("tie_a", "continuous", IMAGE, 0.5, 0.4),
        ObjectCard("bad", "twofold", IMAGE, 0.1, 0.8),
    ]
    figure = objects_figure(cards)
    assert names_on(figure) == ["bad", "tie a", "tie b", "good"]
    assert [axes.get_xlabel() for axes in figure.axes[:2]] == [
        "R(R)@15 0.10\nSR(R)@30 0.80",
        "R(R)@15 0.50\nSR(R)@30 0.40",
    ]
    frames = [to_hex(axes.spines["left"].get_edgecolor()) for axes in figure.axes]
    classes = ("twofold", "continuous", "unique", "unique")
    assert frames == [CLASS_COLOURS[each].lower() for each in classes]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["unique", "twofold", "continuous"]


def test_sheet_of_many_objects_keeps_the_worst(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sheets, "MOST_OBJECTS", 9)
    cards = [ObjectCard(f"a name of some length {i}", "unlabelled", IMAGE, i / 12, 0.0) for i in range(12)]
    figure = objects_figure(cards)
    assert len(names_on(figure)) == 9 and "the 9 worst of 12" in figure.texts[0].get_text()
    # Cards do not overlap, and stay on the page.
    figure.draw_without_rendering()
    boxes = [axes.get_position() for axes in figure.axes]
    assert all(box.x0 >= 0 and box.x1 <= 1 and box.y0 >= -1e-9 and box.y1 <= 1 for box in boxes)
    assert not any(
        a.x0 < b.x1 - 1e-9 and b.x0 < a.x1 - 1e-9 and a.y0 < b.y1 - 1e-9 and b.y0 < a.y1 - 1e-9
        for i, a in enumerate(boxes)
        for b in boxes[:i]
    )


# ------------------------------------------------------------ training

METRICS = """epoch,lr-AdamW,step,train/loss,train/view_loss,val/loss
,0.001,19,,,
0,,19,1.5,1.25,
,0.0005,39,,,
0,,39,0.75,,
0,,41,,,0.5
"""


def test_training_curves_come_from_the_log(tmp_path: Path):
    assert save_training_picture(tmp_path) == []
    (tmp_path / "metrics.csv").write_text(METRICS)
    curves, rate = read_losses(tmp_path / "metrics.csv")
    assert curves["train/loss"].step.tolist() == [19, 39] and curves["train/loss"].value.tolist() == [1.5, 0.75]
    assert curves["val/loss"].value.tolist() == [0.5] and rate.value.tolist() == [0.001, 0.0005]
    assert save_training_picture(tmp_path) == [tmp_path / "training.png"]
    assert (tmp_path / "training.pdf").is_file()


def test_training_figure_has_losses_on_a_log_scale_over_the_rate():
    steps = np.array([10.0, 20.0, 30.0])
    losses = {"train/loss": Curve(steps, np.array([1.0, 0.1, 0.01])), "val/loss": Curve(steps, np.array([1, 0.2, 0.4]))}
    figure = training_figure(losses, Curve(steps, steps))
    above, below = figure.axes
    assert above.get_yscale() == "log" and "learning rate" in below.get_ylabel() and "step" in below.get_xlabel()
    assert [line.get_label() for line in above.lines] == ["training loss", "validation loss"]
    assert [text.get_text() for text in above.texts] == ["best 0.2"]
    assert len(training_figure({"train/loss": losses["train/loss"]}, None).axes) == 1


def test_scattered_losses_are_averaged_and_a_diverged_run_is_drawn():
    steps, values = np.arange(100.0), np.tile([1.0, 3.0], 50)
    (axes,) = training_figure({"train/loss": Curve(steps, values)}, None).axes
    raw, mean = axes.lines
    np.testing.assert_array_equal(raw.get_ydata(), values)
    assert np.abs(mean.get_ydata() - 2).max() < 0.6 and mean.get_label() == "training loss, mean over 5 values"
    lost = Curve(steps, np.full(100, np.nan))
    training_figure({"train/loss": lost, "val/loss": lost}, None).draw_without_rendering()


# ------------------------------------------------------------ files


def test_figures_are_saved_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    figure = training_figure({"train/loss": Curve(np.arange(3.0), np.ones(3))}, None)
    files = save_figure(figure, tmp_path / "new" / "training")
    assert [file.name for file in files] == ["training.png", "training.pdf"]
    assert imread(files[0]).shape[1] == 1600  # 8 inches at 200 dots
    before = [file.read_bytes() for file in files]
    assert before[1].startswith(b"%PDF") and before[1].rstrip().endswith(b"%%EOF")
    save_figure(figure, tmp_path / "new" / "training")
    assert [file.read_bytes() for file in files] == before

    def fails(self: Figure, file: Path, **settings: object) -> None:
        Path(file).write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(Figure, "savefig", fails)
    with pytest.raises(UserError, match=r"training\.png: cannot be written \(disk full\)"):
        save_figure(figure, tmp_path / "new" / "training")
    assert sorted(tmp_path.glob("new/.*")) == [] and [file.read_bytes() for file in files] == before


def test_the_callers_settings_are_unchanged_and_ignored():
    with matplotlib.rc_context({"axes.facecolor": "black", "font.size": 30}):
        before = dict(matplotlib.rcParams)
        figure = training_figure({"train/loss": Curve(np.arange(3.0), np.ones(3))}, None)
        assert dict(matplotlib.rcParams) == before
    assert figure.axes[0].xaxis.label.get_fontsize() == 8


# ------------------------------------------------------------ pictures of an evaluation


class Means(Backbone):
    """Mean colours."""

    def __init__(self) -> None:
        super().__init__()
        self.image_size, self.trunk_dim, self.feature_dim, self.frozen = 8, 3, 3, False
        self.head = nn.Identity()

    def trunk_features(self, images: Tensor) -> Tensor:
        return images.mean(dim=(2, 3))


class Guess(Solver):
    """Neither model nor trajectory; its answer is no turn at all."""

    def solve(self, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        poses = torch.zeros(len(pairs), 1, 3)
        valid = torch.ones(len(pairs), 1, dtype=torch.bool)
        return Solution(poses, torch.zeros(len(pairs), 1), valid, torch.zeros(len(pairs), dtype=torch.long), Cost(0, 0))


@pytest.fixture
def data() -> PairData:
    generator = torch.Generator().manual_seed(1)
    objects = []
    for name, ambiguity, unique in (("red_cup", "unique", True), ("$vase_", "continuous", False)):
        poses = torch.rand(4, 3, generator=generator).double() * torch.tensor([0.5, 6.28, 0.8]) + torch.tensor(
            [0, 0, 1.2]
        )
        files = [Path(f"{view:03d}.png") for view in range(4)]
        objects.append(
            ObjectViews(name, "test", ambiguity, unique, files, camera_to_world(poses), torch.full((4,), 0.857))
        )
    images = torch.randint(0, 256, (8, 8, 8, 3), generator=generator, dtype=torch.uint8).numpy()
    return PairData(ViewTable(objects), images, None)


def evaluated(solver: Solver, data: PairData, starts: Ring | GridStarts) -> Evaluation:
    evaluation = Evaluation(solver, starts, seed=0)
    evaluation.reset_metrics(data.table)
    with torch.no_grad():
        evaluation.test_step(data[data.table.pairs()], 0)
    return evaluation


@pytest.mark.parametrize("kind", [ScoreModel, EnergyModel])
def test_maps_of_a_model_are_its_field_and_the_exact_one(kind: type[ScoreModel | EnergyModel], data: PairData):
    torch.manual_seed(0)
    model = kind(Means(), hidden=8, layers=1)
    solver = Langevin(model, gamma=0.0, iterations=100)
    evaluation = evaluated(solver, data, GridStarts())
    rows = evaluation.metrics.rows()
    examples = gather_examples(evaluation, data)
    assert solver.trajectory is False and solver.model is model  # the evaluated solver stays as it was
    assert 3 <= len(examples) <= 4 and all(len(pair.maps) == 2 for pair in examples)
    for pair in examples:
        learned, exact = pair.maps
        views = [
            next(
                view
                for view in data.table.views_of(data.table.names.index(pair.object))
                if data.table.files[view].name == each.file.name
            )
            for each in (pair.reference, pair.query)
        ]
        batch, truth = data[np.array([views])], torch.from_numpy(pair.truth)
        np.testing.assert_allclose(pair.truth, batch.relative_poses()[0])
        assert learned.solved is not None and learned.solved.trajectories is not None
        assert learned.solved.trajectories.shape == (9, 101, 3) and learned.solved.chosen is not None
        # Solved again, the pair has the evaluation's answer.
        answer = rows["answer"][(rows["pair"] == batch.pairs[0]).all(dim=1)][0].numpy()
        np.testing.assert_allclose(learned.solved.ends[learned.solved.chosen], answer, atol=1e-4)
        # The arrows are the model's score at the true radius.
        assert batch.pixels is not None and learned.arrows is not None and exact.arrows is not None
        features = model.encode(batch.images)
        condition = model.condition(features[batch.reference], features[batch.query])
        (pose,) = grid_poses(truth[2:], *cell_grid(12.0))
        np.testing.assert_allclose(learned.arrows.score, model.field(condition, pose).score.detach(), atol=1e-5)
        np.testing.assert_allclose(exact.arrows.score, model.kernel.score(pose, truth), atol=1e-6)
        # With the exact score every start arrives.
        assert exact.solved is not None
        offset = torch.from_numpy(exact.solved.ends) - truth
        offset[:, 1] = wrap_angle(offset[:, 1])
        assert offset.abs().max() < 2e-2
        assert (learned.density is not None) == (exact.density is not None) == (kind is EnergyModel)


def test_pictures_of_an_evaluation(data: PairData, tmp_path: Path):
    evaluation = evaluated(Langevin(ScoreModel(Means(), hidden=8, layers=1), iterations=5), data, Ring(4))
    result = {**evaluation.metrics.compute(), "breakdown": breakdown(evaluation.metrics.rows(), evaluation.table)}
    files = save_pictures(tmp_path / "pictures", evaluation, data, result)
    names = [file.stem for file in files]
    assert names == [*(f"field_{number}" for number in range(len(names) - 2)), "errors", "objects"]
    assert 3 <= len(names) - 2 <= 4
    for file in files:
        image = imread(file)
        assert image.shape[1] == 1600 and image[..., :3].std() > 0.02  # something is on it
        assert file.with_suffix(".pdf").read_bytes().startswith(b"%PDF")
    assert {file.suffix for file in (tmp_path / "pictures").iterdir() if file.is_file()} == {".png", ".pdf"}
    kept = read_examples(tmp_path / "pictures" / EXAMPLES)
    assert len(kept) == len(names) - 2 and all(each.trajectories is not None for each in kept)


def test_the_calibration_of_an_evaluation_with_probabilities(data: PairData, tmp_path: Path, monkeypatch):
    monkeypatch.setattr("lp_framework.commands.eval.gather_examples", lambda *_: [])  # whose pictures take longest
    evaluation = evaluated(Langevin(ScoreModel(Means(), hidden=8, layers=1), iterations=5), data, Ring(4))
    bins = [{"pairs": 3, "probability": 0.2, "right": 0.3}, {"pairs": 9, "probability": 0.9, "right": 0.8}]
    result = {**evaluation.metrics.compute(), "breakdown": {"calibration": {"bins": bins}}}
    files = save_pictures(tmp_path / "pictures", evaluation, data, result)
    assert files[-1].stem == "calibration" and imread(files[-1])[..., :3].std() > 0.02


def test_solver_without_model_has_one_map_without_arrows(data: PairData):
    evaluation = evaluated(Guess(), data, Ring(4))
    pair = gather_examples(evaluation, data)[0]
    (content,) = pair.maps
    assert content.arrows is None and content.solved is not None and content.solved.trajectories is None
    figure = pair_figure(pair, pair.maps, "a", "b")
    assert len(figure.axes) == 3  # two images, one map, no colour bar
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["true pose", "answer"]


def test_the_shown_pairs_are_solved_once(data: PairData, monkeypatch: pytest.MonkeyPatch):
    evaluation = evaluated(Guess(), data, Ring(1))
    solve, asked = Guess.solve, []

    def counted(solver: Guess, pairs: Pairs, starts: Tensor, seed: int) -> Solution:
        asked.append(len(pairs))
        return solve(solver, pairs, starts, seed)

    monkeypatch.setattr(Guess, "solve", counted)
    examples = gather_examples(evaluation, data)
    assert asked == [len(examples)] and all(each.trajectories is None for each in examples)
