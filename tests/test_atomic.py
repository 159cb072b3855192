"""Files that are written whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from lp_framework.atomic import written


def test_a_file_is_there_once_it_is_whole(tmp_path: Path):
    file = tmp_path / "a.txt"
    with written(file) as partial:
        partial.write_text("new")
        assert partial.parent == tmp_path and not file.exists()
    assert [each.name for each in tmp_path.iterdir()] == ["a.txt"] and file.read_text() == "new"


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_a_file_that_cannot_be_finished_stays_as_it_was(error: type[BaseException], tmp_path: Path):
    file = tmp_path / "a.txt"
    file.write_text("old")
    with pytest.raises(error), written(file) as partial:
        partial.write_text("half a")
        raise error
    assert [each.name for each in tmp_path.iterdir()] == ["a.txt"] and file.read_text() == "old"
