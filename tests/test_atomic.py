"""Atomic file writing."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from lp_framework.atomic import DiskFull, written
from lp_framework.errors import UserError


def test_a_file_appears_only_when_complete(tmp_path: Path):
    file = tmp_path / "a.txt"
    with written(file) as partial:
        partial.write_text("new")
        assert partial.parent == tmp_path and not file.exists()
    assert [each.name for each in tmp_path.iterdir()] == ["a.txt"] and file.read_text() == "new"


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (RuntimeError("bug"), "bug"),
        (KeyboardInterrupt("stop"), "stop"),
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
         r"a\.txt: cannot be written \(No space left on device: it needs more than the \d+\.\d MB that are free\)"),
        (OSError(errno.EDQUOT, os.strerror(errno.EDQUOT)), r"a\.txt: cannot be written \(Disk quota exceeded\)"),
        (PermissionError(errno.EACCES, os.strerror(errno.EACCES)), r"a\.txt: cannot be written \(Permission denied\)"),
    ],
)  # fmt: skip
def test_a_failed_write_leaves_the_file_unchanged(error: BaseException, message: str, tmp_path: Path):
    file = tmp_path / "a.txt"
    file.write_text("old")
    full = isinstance(error, OSError) and error.errno != errno.EACCES
    kind = DiskFull if full else UserError if isinstance(error, OSError) else type(error)
    with pytest.raises(kind, match=message), written(file) as partial:
        partial.write_text("half a")
        raise error
    assert [each.name for each in tmp_path.iterdir()] == ["a.txt"] and file.read_text() == "old"
