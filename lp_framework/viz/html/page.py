"""A page as one file: template, style, script, data and the plotting library, all of it inside."""

from __future__ import annotations

import base64
import gzip
import html
import json
from collections.abc import Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

from lp_framework.evaluation.tables import finite, write_text
from lp_framework.viz.html.elements import Html, joined, tag


class Data:
    """What the page's script draws, gathered while the page is put together: a list of plain values."""

    def __init__(self) -> None:
        self.values: list[Any] = []

    def add(self, value: Any) -> int:
        """The number under which the script finds the value."""
        self.values.append(value)
        return len(self.values) - 1

    def size(self, first: int) -> int:
        """About how many letters the values from number `first` on take."""
        return len(json.dumps(self.values[first:]))

    def as_json(self) -> str:
        """JSON that may stand in a script element; what is not finite is null."""
        text = json.dumps(finite(self.values), separators=(",", ":"), allow_nan=False)
        return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def write_page(path: Path, title: str, subtitle: str, body: Sequence[Html], data: Data, footer: str) -> Path:
    """Write the page whole or not at all."""
    header = joined(tag("h1", {}, title), tag("p", {}, subtitle))
    text = Template(_file("page.html")).substitute(
        title=html.escape(title),
        style=_file("page.css"),
        header=header,
        body="\n".join(body),
        footer=html.escape(footer),
        data=data.as_json(),
        plotly=_plotly() if data.values else "",
        script=_file("page.js"),
    )
    write_text(path, text)
    return path


def _file(name: str) -> str:
    return (resources.files("lp_framework.viz.html") / name).read_text(encoding="utf-8")


@cache
def _plotly() -> str:
    """plotly.js, packed: a third of its size, so that every run of a sweep can have a page."""
    from plotly.offline import get_plotlyjs  # takes a moment, and only pages need it

    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), 6, mtime=0)).decode()
