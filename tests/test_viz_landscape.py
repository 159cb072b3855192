"""Figures of landscapes: positions, omissions and appearance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from landscapes import of, wells
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from lp_framework.analysis.landscapes import Landscape
from lp_framework.analysis.pairs import PRIOR_ENERGY, PoseMap, ShownPair, View
from lp_framework.viz.maps import RELIEF, draw_map, pair_figure, surface_figure
from lp_framework.viz.style import ANSWER, save_figure

PICTURES = Path(__file__).parent / "pictures"
LANDSCAPE = wells((10, 50, 1.0), (-20, 230, 0.7), width=3.0)
TRUTH = np.radians([10.0, 50.0, 0.0])
IMAGE = np.full((16, 16, 3), 200, dtype=np.uint8)


def path(*places: tuple[float, float]) -> NDArray:
    """A trajectory `[S, 3]` through latitudes and longitudes in degrees."""
    return np.radians([(north, east, 0.0) for north, east in places])


PATHS = np.stack(
    [path((0, 0), (5, -20), (8, 5), (10, 50)), path((0, 90), (5, 70), (9, 55), (10, 50)),
     path((0, 180), (-10, 200), (-18, 225), (-20, 230)), path((0, 270), (-10, 260), (-18, 235), (-20, 230))]
)  # fmt: skip


def solved_pair(paths: NDArray, chosen: int | None = None, landscape: Landscape = LANDSCAPE) -> ShownPair:
    """A pair in which a solver took the paths `[N, S, 3]`, each ending one degree further off."""
    view, numbers = View(Path("000.png"), IMAGE, TRUTH), np.arange(len(paths), dtype=float)
    return ShownPair(
        "duck", "unique", "", view, view, TRUTH, paths[:, 0], paths, paths[:, -1], 0 * numbers, chosen, numbers,
        landscapes={PRIOR_ENERGY: landscape},
    )  # fmt: skip


def page(pair: ShownPair, title: str = "", views: list[NDArray] | None = None) -> Figure:
    """The page of a pair with one map."""
    content = PoseMap("tiny", relief=pair.prior_energy, solved=pair)
    return pair_figure(pair, [content], title, "note", views or [])


def lines(axes) -> list[NDArray]:
    """The trajectories that are drawn, `[points, 2]`: longitude and latitude in degrees, NaN where a line breaks."""
    return [np.array(line.get_data(), dtype=float).T for line in axes.lines if line.get_linestyle() != "None"]


def marks(axes, marker: str) -> list[tuple[float, float]]:
    found = [line for line in axes.lines if line.get_linestyle() == "None" and line.get_marker() == marker]
    return [tuple(point) for line in found for point in np.array(line.get_data(), dtype=float).T]


# ---------------------------------------------------------------- the map


def test_a_trajectory_across_the_seam_draws_no_line_across_the_map():
    axes = Figure().add_subplot()
    paths = np.stack([path((0, 340), (5, 355), (10, 370), (15, 410)), path((0, 20), (0, -20), (0, -200), (0, -380))])
    draw_map(axes, PoseMap(relief=LANDSCAPE, solved=solved_pair(paths)))
    first, second = lines(axes)
    assert np.nanmax(np.abs(np.diff(first[:, 0]))) <= 180 and np.nanmin(first) >= -60 and np.nanmax(first) <= 360
    assert np.isnan(first[:, 0]).sum() == 1 and np.isnan(second[:, 0]).sum() == 2
    edge = np.flatnonzero(np.isnan(first[:, 0]))[0]
    assert first[edge - 1, 0] == 360 and first[edge + 1, 0] == 0 and first[edge - 1, 1] == first[edge + 1, 1]


def test_the_map_shows_minima_truth_starts_ends_and_the_answer():
    axes = Figure().add_subplot()
    draw_map(axes, PoseMap("duck", relief=LANDSCAPE, solved=solved_pair(PATHS, 1)), TRUTH)
    assert marks(axes, "*") == [pytest.approx((50, 10))]
    assert marks(axes, "D") == [pytest.approx((50, 10))]
    found = sorted(marks(axes, "+"))
    assert found == [pytest.approx((50, 10), abs=1), pytest.approx((230, -20), abs=1)]
    starts = {round(longitude) for longitude, latitude in marks(axes, "o") if latitude == 0}
    assert starts == {0, 90, 180, 270, 360}  # what lies on the seam is on both edges
    assert axes.get_title() == "duck" and axes.get_xlim() == (0, 360) and axes.get_ylim() == pytest.approx((-60, 60))
    answer = [line for line in axes.lines if line.get_color() == ANSWER and line.get_linestyle() != "None"]
    assert len(answer) == 1 and np.allclose(answer[0].get_xdata()[-1], 50)


def test_without_trajectories_and_truth_there_is_only_the_landscape():
    axes = Figure().add_subplot()
    draw_map(axes, PoseMap(relief=LANDSCAPE))
    assert (
        not lines(axes) and not marks(axes, "o") and not [each for each in marks(axes, "*") if np.isfinite(each).all()]
    )
    assert len(marks(axes, "+")) == 2


def test_ends_without_starts():
    axes = Figure().add_subplot()
    ends_only = replace(solved_pair(PATHS, 0), starts=None, trajectories=None)
    draw_map(axes, PoseMap(relief=LANDSCAPE, solved=ends_only), TRUTH)
    assert {round(longitude) for longitude, _ in marks(axes, "o")} == {50, 230} and not lines(axes)


def test_360_degrees_is_0_again():
    axes = Figure().add_subplot()
    relief = draw_map(axes, PoseMap(relief=LANDSCAPE))
    energy = np.asarray(relief.get_array()).reshape(16, 31)
    assert np.array_equal(energy[:, 0], energy[:, -1]) and np.allclose(energy[:, :-1], LANDSCAPE.energy)


def test_a_flat_landscape_is_drawn():
    plain = of([[1.0] * 6] * 4)
    for figure in (page(solved_pair(PATHS, 0, plain)), surface_figure(plain)):
        figure.draw_without_rendering()


def test_the_map_is_readable_in_grey():
    """Lightness increases evenly with the energy, for print and colour blindness."""
    rgb = colormaps[RELIEF](np.linspace(0, 1, 64))[:, :3]
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    lightness = 116 * np.cbrt(linear @ [0.2126, 0.7152, 0.0722]) - 16
    steps = np.diff(lightness)
    assert steps.min() > 0.3 * steps.mean() and lightness[-1] - lightness[0] > 70


# ---------------------------------------------------------------- the page of a pair


@pytest.mark.parametrize("count", [0, 1, 4, 9])
def test_the_layout_of_the_page_of_a_pair(count):
    views = [IMAGE] * count
    captions = [f"{90 * number % 360}\u00b0: {number}\u00b0 off" for number in range(count)]
    paths = np.repeat(PATHS[:1], count, axis=0)
    paths[:, 0, 1] = np.radians(90 * np.arange(count))
    figure = page(solved_pair(paths, 0 if count else None), "duck", views)
    figure.draw_without_rendering()
    titles = [axes.get_title("left") for axes in figure.axes]
    assert titles[:3] == ["reference", "query", "tiny"] and [each for each in titles if "off" in each] == captions
    texts = [*figure.texts, *figure.legends, *(part for axes in figure.axes for part in (axes.title, axes.xaxis.label))]
    boxes = [each.get_window_extent() for each in (*figure.axes, *texts)]
    sheet = figure.bbox
    assert all(box.x0 >= 0 and box.y0 >= 0 and box.x1 <= sheet.x1 and box.y1 <= sheet.y1 for box in boxes)
    shown = [axes.get_window_extent() for axes in figure.axes]
    for one in range(len(shown)):
        for other in range(one):
            assert not (shown[one].x0 < shown[other].x1 and shown[other].x0 < shown[one].x1
                        and shown[one].y0 < shown[other].y1 and shown[other].y0 < shown[one].y1)  # fmt: skip
    framed = [axes for axes in figure.axes if to_hex(axes.spines["left"].get_edgecolor()) == ANSWER.lower()]
    assert [axes.get_title("left") for axes in framed] == captions[:1]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    expected = ["true pose", "answer", "end", "start", "local minimum"]
    assert labels == {0: expected[::4], 1: [each for each in expected if each != "end"]}.get(count, expected)


def test_a_long_legend_stays_on_the_page():
    figure = page(solved_pair(PATHS, 0), "tram")
    figure.draw_without_rendering()
    key = figure.legends[0].get_window_extent()
    assert key.x0 >= 0 and key.y0 >= 0 and key.x1 <= figure.bbox.x1
    assert key.y1 < figure.axes[2].xaxis.label.get_window_extent().y0


# ---------------------------------------------------------------- the surface


def test_the_surface_marks_the_truth_over_its_map():
    figure = surface_figure(LANDSCAPE, TRUTH, "duck")
    (axes,) = figure.axes
    points = [np.array(line.get_data_3d()) for line in axes.lines]
    (pole,) = [each for each in points if each.shape[1] == 2]
    (star,) = [each for each in points if each.shape[1] == 1]
    energy = LANDSCAPE.energy.numpy()
    assert pole[:2, 0] == pytest.approx((50, 10)) and pole[2, 1] == pytest.approx(energy.max())
    assert star[:, 0] == pytest.approx(pole[:, 0]) and star[2, 0] < energy.min()
    assert axes.get_xlim3d() == (0, 360)
    assert all(energy.min() <= tick <= energy.max() for tick in axes.get_zticks())
    assert surface_figure(LANDSCAPE).axes[0].lines[:] == []


# ---------------------------------------------------------------- how they look


def seen(figure: Figure) -> NDArray[np.uint8]:
    """The figure as pixels, at 40 dpi."""
    figure.set_dpi(40)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))


def difference(one: NDArray, other: NDArray) -> float:
    """Mean difference of two pictures `[H, W, 3]` made small and blurred, of 255: fonts and edges do not show."""
    small = (Image.fromarray(each).resize((24, 16), Image.Resampling.BOX) for each in (one, other))
    first, second = (np.asarray(each, dtype=float) for each in small)
    return float(np.abs(first - second).mean())


FIGURES = {
    "landscape_page": lambda: page(solved_pair(PATHS, 1), "wells"),
    "landscape_surface": lambda: surface_figure(LANDSCAPE, TRUTH, "wells"),
}


@pytest.mark.parametrize("name", FIGURES)
def test_pictures_look_as_they_did(name):
    """The stored ones were written by `Image.fromarray(seen(FIGURES[name]())).save(...)`, and looked at."""
    picture, stored = seen(FIGURES[name]()), np.asarray(Image.open(PICTURES / f"{name}.png").convert("RGB"))
    assert picture.shape == stored.shape
    assert difference(picture, stored) < 4
    assert difference(picture[:, ::-1], stored) > 12  # a wrong one would be seen


def test_pictures_are_written(tmp_path):
    files = save_figure(page(solved_pair(PATHS, 1)), tmp_path / "page")
    assert [file.suffix for file in files] == [".png", ".pdf"]
    with Image.open(files[0]) as picture:
        assert picture.width > 1000 and picture.height > 400
