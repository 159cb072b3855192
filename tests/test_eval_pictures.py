"""`eval pictures=false`: the same tables, nothing drawn and no page."""

from __future__ import annotations

import pytest
from tiny_runs import Commands

SHORT = ("solver=ifusion", "solver.steps=2", "protocol=per_view", "start=ring", "start.count=2")


@pytest.fixture(scope="module")
def commands(tmp_path_factory) -> Commands:
    return Commands(tmp_path_factory.mktemp("pictures"), test_views=2)


def test_without_pictures_there_are_the_same_tables_and_nothing_else(commands):
    drawn = commands.here("drawn", "eval", *SHORT, "pictures=true")
    bare = commands.here("bare", "eval", *SHORT, "pictures=false")
    assert (drawn.status, bare.status) == (0, 0), (drawn.err, bare.err)
    pictures = {file.name for file in (drawn.folder / "pictures").iterdir()}
    assert {"errors.png", "objects.pdf", "field_0.png", "examples"} <= pictures
    assert (drawn.folder / "report.html").is_file() and "pictures: drawn/pictures (field_0.png" in drawn.out
    left = {file.name for file in bare.folder.iterdir()}
    assert left == {file.name for file in drawn.folder.iterdir()} - {"pictures", "report.html"}
    assert "pictures:" not in bare.out and "page:" not in bare.out
    assert (bare.folder / "pairs.csv").read_bytes() == (drawn.folder / "pairs.csv").read_bytes()


def test_pictures_must_be_true_or_false(commands):
    assert commands.here("x", "eval", *SHORT, "pictures=some").error == "pictures must be true or false, got some"
