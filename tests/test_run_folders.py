"""Run folders: one command at a time, full disks, no empty folders."""

from __future__ import annotations

import errno
import os
import signal
import time
from pathlib import Path

import pytest

from lp_framework.atomic import DiskFull
from lp_framework.run_folders import Held, held, remove_if_empty

SENTENCE = "is in use by another command; wait for it, or choose another folder"


def test_only_one_command_at_a_time_uses_a_folder(tmp_path: Path):
    with held(tmp_path), pytest.raises(Held, match=f"{tmp_path}: {SENTENCE}"), held(tmp_path):
        pass
    with pytest.raises(ZeroDivisionError), held(tmp_path):
        raise ZeroDivisionError
    with held(tmp_path), held(tmp_path / "nowhere"):
        assert not (tmp_path / "nowhere").exists()


def test_a_killed_process_releases_its_folder(tmp_path: Path):
    process = os.fork()
    if process == 0:
        with held(tmp_path):
            (tmp_path / "mine").touch()
            time.sleep(60)
        os._exit(1)
    while not (tmp_path / "mine").exists():
        time.sleep(0.005)
    with pytest.raises(Held), held(tmp_path):
        pass
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    with held(tmp_path):
        pass


@pytest.mark.parametrize("file", [None, "events.out"])
def test_a_full_disk_is_reported_with_the_file_if_known(file: str | None, tmp_path: Path):
    error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), *([] if file is None else [str(tmp_path / file)]))
    room = r"No space left on device: it needs more than the [\d.]+ MB that are free"
    expected = rf"{tmp_path / (file or '')}: cannot be written \({room}\)"
    with pytest.raises(DiskFull, match=expected), held(tmp_path):
        raise error
    with pytest.raises(PermissionError), held(tmp_path):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))  # a bug, or the system's; its traceback tells


def test_only_a_folder_with_nothing_of_its_own_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name in ("empty", "full", "here"):
        (tmp_path / name / ".hydra").mkdir(parents=True)
        (tmp_path / name / "eval.log").touch()
    (tmp_path / "full" / "pairs.csv").touch()
    monkeypatch.chdir(tmp_path / "here")
    for name in ("empty", "full", "here", "nowhere"):
        remove_if_empty(tmp_path / name, "eval.log")
    assert sorted(each.name for each in tmp_path.iterdir()) == ["full", "here"]
