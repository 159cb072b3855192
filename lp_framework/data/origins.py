"""What views on disk were made from, so that they are not taken for those of other files of the same names."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from lp_framework.data.cache import content_key


@dataclass(frozen=True)
class Origin:
    """The files that an object's views are made from, others `beside` them that may belong to several objects, and the
    axis that is `up` in them."""

    files: Sequence[Path]
    beside: Origin | None = None
    up: str = "y"

    @cached_property
    def content(self) -> str:
        """A text that changes with the names and bytes of the files."""
        return content_key(self.files, [file.name for file in self.files], self.beside and self.beside.content, self.up)

    @cached_property
    def stamp(self) -> str:
        """A text that changes with their places, sizes and times, which costs no reading."""
        stats = [(os.path.abspath(file), file.stat()) for file in self.files]
        facts = [(path, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns) for path, stat in stats]
        return content_key([], facts, self.beside and self.beside.stamp, self.up)

    def record(self) -> dict[str, str]:
        """What a record is to keep of the files."""
        return {"content": self.content, "stamp": self.stamp}

    def is_of(self, record: Any) -> bool:
        """Whether a record is of these files; they are read where they are not where and as they were."""
        return isinstance(record, dict) and (record.get("stamp") == self.stamp or record.get("content") == self.content)
