"""Files that are written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """A hidden file beside `path` to write to; it replaces `path` at the end, and is removed where that fails."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")  # another process has another
    try:
        yield partial
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
