"""The grid of novel views: every view is at its angles."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from matplotlib.colors import to_hex

from lp_framework.viz.sheets import signed, views_figure
from lp_framework.viz.style import TRUTH, save_figure

SOURCE = np.full((16, 16, 3), 200, dtype=np.uint8)


def numbered(rows: int, columns: int, size: int = 4) -> np.ndarray:
    """Views of one colour each, their row and column."""
    views = np.zeros((rows, columns, size, size, 3), dtype=np.uint8)
    views[..., 0] = np.arange(rows)[:, None, None, None]
    views[..., 1] = np.arange(columns)[:, None, None]
    return views


def places(figure):
    """The views' row and column numbers, by where they are on the page: rows downwards, columns to the right."""
    cells = figure.axes[1:]
    tops, lefts = (sorted({round(getattr(axes.get_position(), end), 4) for axes in cells}) for end in ("y0", "x0"))
    found = {}
    for axes in cells:
        box = axes.get_position()
        place = len(tops) - 1 - tops.index(round(box.y0, 4)), lefts.index(round(box.x0, 4))
        found[place] = axes
    return found


def framed(figure):
    return [
        place for place, axes in places(figure).items() if to_hex(axes.spines["left"].get_edgecolor()) == TRUTH.lower()
    ]


def test_views_stand_at_their_angles():
    figure = views_figure(SOURCE, numbered(3, 4), [20, 0, -20], [0, 90, 180, 270], "duck", "prior tiny")
    figure.draw_without_rendering()
    cells = places(figure)
    assert len(cells) == 12
    for row, latitude in enumerate(("+20°", "0°", "\u221220°")):
        assert cells[row, 0].get_ylabel() == latitude
        for column, longitude in enumerate(("0°", "90°", "180°", "270°")):
            assert (cells[row, column].images[0].get_array()[0, 0, :2] == [row, column]).all()
            assert cells[2, column].get_xlabel() == longitude
    (body,) = figure.subfigs
    assert figure.get_suptitle() == "duck" and body.get_suptitle() == "prior tiny"
    assert figure.axes[0].get_title("left") == "source" and (figure.axes[0].images[0].get_array() == SOURCE).all()


@pytest.mark.parametrize(
    ("latitudes", "longitudes", "corners"),
    [([20, 0], [0, 180], [(1, 0)]), ([0], [-90, 0, 360], [(0, 1), (0, 2)]), ([20], [0, 180], [])],
)
def test_the_sources_own_pose_is_framed(latitudes, longitudes, corners):
    views = numbered(len(latitudes), len(longitudes))
    assert framed(views_figure(SOURCE, views, latitudes, longitudes, "", "")) == corners


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (3, 12), (2, 36), (9, 2)])
def test_views_are_square_and_all_is_on_the_page(rows, columns):
    longitudes = [360 * number / columns for number in range(columns)]
    figure = views_figure(SOURCE, numbered(rows, columns), np.linspace(40, -40, rows), longitudes, "duck", "tiny")
    figure.draw_without_rendering()
    boxes = [axes.get_window_extent() for axes in places(figure).values()]
    sides = {round(side) for box in boxes for side in (box.width, box.height)}
    assert len(sides) == 1 and figure.get_figwidth() <= 10
    labels = [axes.xaxis.label for axes in places(figure).values() if axes.get_xlabel()]
    boxes = [text.get_window_extent() for text in [*figure.texts, figure.axes[0].title, *labels]]
    assert all(
        box.x0 >= 0 and box.x1 <= figure.bbox.x1 + 1 and box.y0 >= 0 and box.y1 <= figure.bbox.y1 for box in boxes
    )
    across = sorted((label.get_window_extent() for label in labels), key=lambda box: box.x0)
    assert all(one.x1 <= other.x0 for one, other in itertools.pairwise(across))


def test_the_picture_is_written(tmp_path):
    figure = views_figure(SOURCE, numbered(1, 2), [0], [0, 180], "duck", "tiny")
    assert [file.suffix for file in save_figure(figure, tmp_path / "views")] == [".png", ".pdf"]


def test_signs():
    assert [signed(angle) for angle in (-20.0, 0.0, 7.5)] == ["\u221220°", "0°", "+7.5°"]
