"""A headless Chromium for tests of pages, if installed."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
MISSING = [
    *([] if CHROMIUM else ["a Chromium on the PATH (apt-get install chromium)"]),
    *([] if importlib.util.find_spec("playwright") else ["pip install playwright"]),
]
with_browser = pytest.mark.skipif(bool(MISSING), reason=f"needs {' and '.join(MISSING)}")
SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
PATIENCE = 180_000  # milliseconds: without a GPU and on a busy machine relief takes long to draw


@contextmanager
def chromium() -> Iterator[Any]:
    """The browser of playwright."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *SOFTWARE])
        yield found
        found.close()
