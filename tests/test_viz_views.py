"""The grid of novel views: every view stands at its angles."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.patches import Rectangle

from lp_framework.viz.style import TRUTH, save_figure
from lp_framework.viz.views import contact_sheet, signed, views_figure

SOURCE = np.full((16, 16, 3), 200, dtype=np.uint8)


def numbered(rows: int, columns: int, size: int = 4) -> np.ndarray:
    """Views of one colour each, their row and column."""
    views = np.zeros((rows, columns, size, size, 3), dtype=np.uint8)
    views[..., 0] = np.arange(rows)[:, None, None, None]
    views[..., 1] = np.arange(columns)[:, None, None]
    return views


def grid_of(figure):
    _, axes = figure.axes
    return axes


def framed(figure):
    patches = [each for each in grid_of(figure).patches if isinstance(each, Rectangle)]
    return [each.get_xy() for each in patches if to_hex(each.get_edgecolor()) == TRUTH.lower()]


def labels(axis):
    return [label.get_text() for label in axis.get_ticklabels()]


def test_the_sheet_has_rows_below_each_other_and_columns_side_by_side():
    sheet = contact_sheet(numbered(2, 3, size=4))
    assert sheet.shape == (8, 12, 3)
    assert (sheet[:4, :, 0] == 0).all() and (sheet[4:, :, 0] == 1).all()
    assert all((sheet[:, 4 * column : 4 * column + 4, 1] == column).all() for column in range(3))


def test_views_stand_at_their_angles():
    figure = views_figure(SOURCE, numbered(3, 4), [20, 0, -20], [0, 90, 180, 270], "duck", "prior tiny")
    axes = grid_of(figure)
    assert labels(axes.yaxis) == ["+20°", "0°", "\u221220°"] and labels(axes.xaxis) == ["0°", "90°", "180°", "270°"]
    sheet, (left, right, bottom, top) = axes.images[0].get_array(), axes.images[0].get_extent()
    for row, y in enumerate(axes.get_yticks()):  # what lies at a label is that row's or column's
        for column, x in enumerate(axes.get_xticks()):
            shown = sheet[
                int((y - top) / (bottom - top) * len(sheet)), int((x - left) / (right - left) * sheet.shape[1])
            ]
            assert shown[:2].tolist() == [row, column]
    assert [text.get_text() for text in figure.texts] == ["duck", "prior tiny"]
    assert figure.axes[0].get_title("left") == "source" and (figure.axes[0].images[0].get_array() == SOURCE).all()


@pytest.mark.parametrize(
    ("latitudes", "longitudes", "corners"),
    [([20, 0], [0, 180], [(-0.5, 0.5)]), ([0], [-90, 0, 360], [(0.5, -0.5), (1.5, -0.5)]), ([20], [0, 180], [])],
)
def test_the_sources_own_pose_is_framed(latitudes, longitudes, corners):
    views = numbered(len(latitudes), len(longitudes))
    assert framed(views_figure(SOURCE, views, latitudes, longitudes, "", "")) == corners


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (3, 12), (5, 36), (9, 2)])
def test_views_are_square_and_all_is_on_the_page(rows, columns):
    longitudes = [360 * number / columns for number in range(columns)]
    figure = views_figure(SOURCE, numbered(rows, columns), np.linspace(40, -40, rows), longitudes, "duck", "tiny")
    box = grid_of(figure).get_position()
    width, height = figure.get_size_inches()
    assert box.width * width / columns == pytest.approx(box.height * height / rows) and width <= 10
    figure.draw_without_rendering()
    texts = [*figure.texts, grid_of(figure).xaxis.label, grid_of(figure).yaxis.label, figure.axes[0].title]
    boxes = [text.get_window_extent() for text in texts]
    assert all(
        box.x0 >= 0 and box.y0 >= 0 and box.x1 <= figure.bbox.x1 + 1 and box.y1 <= figure.bbox.y1 for box in boxes
    )
    ticks = [label.get_window_extent() for label in grid_of(figure).get_xticklabels()]
    assert all(one.x1 <= other.x0 for one, other in itertools.pairwise(ticks))


def test_the_picture_is_written(tmp_path):
    figure = views_figure(SOURCE, numbered(1, 2), [0], [0, 180], "duck", "tiny")
    assert [file.suffix for file in save_figure(figure, tmp_path / "views")] == [".png", ".pdf"]


def test_signs():
    assert [signed(angle) for angle in (-20.0, 0.0, 7.5)] == ["\u221220°", "0°", "+7.5°"]
