"""Pieces of a page. What is not `Html` is text, and is escaped."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from numpy.typing import NDArray
from PIL import Image

SINGLE = ("img", "input", "br")  # elements without content


class Html(str):
    """Markup, which is not escaped again."""

    __slots__ = ()


@dataclass(frozen=True)
class Cell:
    """A cell of a table: what it shows, what it sorts by (None: the text), and its class."""

    content: str
    value: float | str | None = None
    kind: str = ""


def tag(name: str, attributes: Mapping[str, str], *children: str) -> Html:
    """An element with its children, of which those that are plain text are escaped.

    >>> tag("a", {"href": "x?a&b"}, "1 < 2", tag("b", {}, "!"))
    '<a href="x?a&amp;b">1 &lt; 2<b>!</b></a>'
    """
    parts = [name, *(f'{key}="{html.escape(value)}"' for key, value in attributes.items())]
    opening = f"<{' '.join(parts)}>"
    return Html(opening if name in SINGLE else f"{opening}{joined(*children)}</{name}>")


def joined(*children: str) -> Html:
    """Children one after the other, plain text escaped."""
    return Html("".join(child if isinstance(child, Html) else html.escape(child, quote=False) for child in children))


def section(title: str, *children: str) -> Html:
    """A part of the page under a heading."""
    return tag("section", {}, tag("h2", {}, title), *children)


def sentence(text: str) -> Html:
    """A remark, of something that is missing or to be known."""
    return tag("p", {"class": "note"}, text)


def tiles(values: Mapping[str, str]) -> Html:
    """The few numbers that matter most, large: label to value."""
    return tag(
        "dl",
        {"class": "tiles"},
        *(tag("div", {}, tag("dt", {}, key), tag("dd", {}, each)) for key, each in values.items()),
    )


def table(
    headings: Sequence[str], rows: Sequence[Sequence[Cell]], labels: int = 1, sorts: bool = False, caption: str = ""
) -> Html:
    """A table whose first `labels` columns are words; with `sorts`, a click on a heading sorts by it."""
    head = []
    for place, name in enumerate(headings):
        attributes = {"scope": "col", "class": "word" if place < labels else "number"}
        content = tag("button", {"type": "button"}, name) if sorts else Html(html.escape(name))
        head.append(tag("th", attributes | ({"aria-sort": "none"} if sorts else {}), content))
    body = []
    for row in rows:
        cells = []
        for place, cell in enumerate(row):
            attributes = {"class": " ".join(filter(None, ["word" if place < labels else "number", cell.kind]))}
            if cell.value is not None:
                attributes["data-value"] = _sortable(cell.value)
            scope = {"scope": "row"} if place == 0 else {}
            cells.append(tag("th" if place == 0 else "td", attributes | scope, cell.content))
        body.append(tag("tr", {}, *cells))
    content = tag(
        "table", {"data-sorts": ""} if sorts else {}, tag("thead", {}, tag("tr", {}, *head)), tag("tbody", {}, *body)
    )
    label = {"role": "region", "tabindex": "0", "aria-label": caption or "table"}
    return tag("div", {"class": "scrolls", **label}, content)


def _sortable(value: float | str) -> str:
    """A value as the page's script reads it: nothing for what is not finite, which sorts last."""
    if isinstance(value, str):
        return value
    return f"{value:.9g}" if math.isfinite(value) else ""


def facts(values: Mapping[str, str]) -> Html:
    """Names and values in two columns."""
    return tag(
        "dl", {"class": "facts"}, *(joined(tag("dt", {}, key), tag("dd", {}, each)) for key, each in values.items())
    )


def folded(title: str, *children: str) -> Html:
    """What is shown on a click."""
    return tag("details", {}, tag("summary", {}, title), *children)


def plot(number: int, kind: str, label: str) -> Html:
    """The place of a plot of the page's data `number`; its `label` says in words what it shows."""
    return tag(
        "div", {"class": f"plot {kind}", "data-plot": kind, "data-of": str(number), "role": "img", "aria-label": label}
    )


def picture(image: NDArray, side: int, label: str) -> Html:
    """An image `[H, W, 3 or 4]` (uint8), at most `side` pixels wide and high, within the page."""
    return tag("img", {"src": data_uri(image, side), "alt": label, "loading": "lazy"})


def sheet(file: Path, label: str) -> Html:
    """A figure of matplotlib (a PNG file) over the width of the page."""
    source = f"data:image/png;base64,{base64.b64encode(file.read_bytes()).decode()}"
    return tag("img", {"class": "sheet", "src": source, "alt": label, "loading": "lazy"})


def data_uri(image: NDArray, side: int) -> str:
    """An image `[H, W, 3 or 4]` (uint8) as WebP, shrunk to at most `side` pixels."""
    shrunk = Image.fromarray(image)
    shrunk.thumbnail((side, side), Image.Resampling.LANCZOS)
    content = io.BytesIO()
    shrunk.save(content, "webp", quality=82)
    return f"data:image/webp;base64,{base64.b64encode(content.getvalue()).decode()}"


def sparkline(values: Sequence[float], span: float, mark: float, label: str) -> Html:
    """A curve without axes above its least, `span` high, with a line at `mark` (0 to 1 of the width)."""
    low = min(values)
    heights = [26 - 24 * (value - low) / (span or 1.0) for value in values]
    points = " ".join(f"{100 * place / (len(values) - 1):.1f},{y:.1f}" for place, y in enumerate(heights))
    x = f"{100 * mark:.1f}"
    return tag(
        "svg",
        {
            "class": "sparkline",
            "viewBox": "0 0 100 28",
            "preserveAspectRatio": "none",
            "role": "img",
            "aria-label": label,
        },
        tag("line", {"x1": x, "x2": x, "y1": "0", "y2": "28"}),
        tag("polyline", {"points": points}),
    )
