"""Converted views are not mistaken for those of another download."""

from __future__ import annotations

import json
import os
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bop_layout import write_hopev2
from co3d_layout import write_category
from test_omni3d import write_omni3d

from lp_framework.data.files import Origin
from lp_framework.data.sets.co3d import CO3DData
from lp_framework.data.sets.converted import ConvertedSource
from lp_framework.data.sets.hopev2 import HOPEv2Data
from lp_framework.data.sets.omni3d import Omni3DData
from lp_framework.errors import UserError

FEW = {"train_views": 5, "test_views": 3, "resolution": 32}
SETS: dict[str, tuple[Callable[[Path], Path], Callable[[Path, Path], ConvertedSource]]] = {
    "hopev2": (write_hopev2, lambda root, views: HOPEv2Data(str(root), str(views), **FEW)),
    "co3d": (write_category, lambda root, views: CO3DData(str(root), str(views), scenes=1, **FEW)),
    "omni3d": (write_omni3d, lambda root, views: Omni3DData(str(root), str(views))),
}


@pytest.fixture(params=SETS)
def converted(request, tmp_path) -> tuple[Path, Path, Callable[[Path], None]]:
    """A download that has been converted, its views, and what prepares these from another one."""
    write, source = SETS[request.param]
    root, views = write(tmp_path / "first" / "download"), tmp_path / "views"

    def prepare(root: Path) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what is left out
            source(root, views).prepare()

    prepare(root)
    return root, views, prepare


def files_of(views: Path) -> list[str]:
    (record,) = views.glob("*/conversion.json")
    return json.loads(record.read_text())["files"]


def test_views_of_another_download_of_the_same_name_are_not_reused(converted, tmp_path):
    root, views, prepare = converted
    (record,) = views.glob("*/conversion.json")
    before = record.read_bytes()
    for number, name in enumerate(files_of(views)):
        other = tmp_path / f"other{number}" / "download"
        shutil.copytree(root, other, copy_function=os.link)
        (other / name).unlink()
        shutil.copyfile(root / name, other / name)
        content = bytearray((other / name).read_bytes())
        content[-1] ^= 1
        (other / name).write_bytes(content)
        with pytest.raises(UserError, match="holds views that were made from other files or settings"):
            prepare(other)
        (other / name).unlink()
        with pytest.raises(UserError, match=r"holds views that were made|there is no such|has no|looked for"):
            prepare(other)
    assert record.read_bytes() == before


def test_a_copied_or_unavailable_download_is_not_converted_again(converted, tmp_path, monkeypatch):
    root, views, prepare = converted
    monkeypatch.setattr(ConvertedSource, "_write", lambda self, name: pytest.fail(f"{name} is converted anew"))
    copy = tmp_path / "copy" / "download"
    shutil.copytree(root, copy, copy_function=shutil.copyfile)  # with other times
    prepare(copy)
    prepare(root)
    if (views / "objects.json").exists():  # which says what the objects are
        shutil.rmtree(root)
        prepare(root)


def test_files_are_read_only_if_their_stats_changed(tmp_path, monkeypatch):
    file = tmp_path / "a.bin"
    np.arange(9).tofile(file)
    record = Origin([file], Origin([])).record()
    monkeypatch.setattr(Path, "read_bytes", lambda path: pytest.fail(f"{path} is read"))
    assert Origin([file], Origin([])).is_of(record)
    monkeypatch.undo()
    file.rename(tmp_path / "moved.bin")
    assert not Origin([tmp_path / "moved.bin"], Origin([])).is_of(record)  # names count, for files refer to each other
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "moved.bin").rename(tmp_path / "elsewhere" / "a.bin")
    assert Origin([tmp_path / "elsewhere" / "a.bin"], Origin([])).is_of(record)
    assert not Origin([tmp_path / "elsewhere" / "a.bin"]).is_of(record) and not Origin([]).is_of("garbage")
