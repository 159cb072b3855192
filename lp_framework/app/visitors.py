"""The files of visitors, in one temporary folder that is removed when the app ends."""

from __future__ import annotations

import secrets
import shutil
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from lp_framework.data.photograph_files import as_counted

KEPT_SECONDS = 3600.0  # how long files are kept after a visitor's last request


class Visitor:
    """An open page: the photographs it has uploaded, their masks, and the folders of its results."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.seen = folder, time.monotonic()
        self.files: list[Path] = []
        self.masks: Path | None = None

    def take_photographs(self, files: Iterable[tuple[str, bytes]]) -> None:
        """Write uploaded photographs (names, contents) in place of the previous ones. Masks that were uploaded before
        the first photographs are kept."""
        masks = None if self.files else self.masks
        self.take_files(sorted(_written(self.new_folder(), files), key=as_counted))
        self.masks = masks

    def take_files(self, files: Sequence[Path]) -> None:
        """Use files of this machine in place of the previous photographs and masks."""
        self.files, self.masks = list(files), None

    def take_masks(self, files: Iterable[tuple[str, bytes]]) -> None:
        """Write uploaded masks (names and contents) and replace the previous ones."""
        self.masks = self.new_folder()
        _written(self.masks, files)

    def new_folder(self) -> Path:
        """Make an empty folder."""
        folder = self.folder / secrets.token_hex(4)
        folder.mkdir(parents=True)
        return folder


class Visitors:
    """All visitors, by unguessable names."""

    def __init__(self) -> None:
        self._folder = TemporaryDirectory(prefix="lp-app-")
        self._visitors: dict[str, Visitor] = {}

    def __getitem__(self, name: str) -> Visitor:
        """A visitor by name, created if new. Removes the files of visitors who have left."""
        now = time.monotonic()
        for other, visitor in list(self._visitors.items()):
            if other != name and now - visitor.seen > KEPT_SECONDS:
                shutil.rmtree(self._visitors.pop(other).folder, ignore_errors=True)
        visitor = self._visitors.setdefault(name, Visitor(Path(self._folder.name) / secrets.token_hex(8)))
        visitor.seen = now
        return visitor

    def close(self) -> None:
        """Remove all files."""
        self._folder.cleanup()


def _written(folder: Path, files: Iterable[tuple[str, bytes]]) -> list[Path]:
    written = []
    for name, content in files:
        own = Path(name.replace("\\", "/")).name
        path = folder / (own if own.strip(".") else "image")
        path.write_bytes(content)
        written.append(path)
    return written
