"""What the parts of all pages share: a run's files, and sections that survive what is missing or damaged."""

from __future__ import annotations

import base64
import csv
import gzip
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import plotly.graph_objects as go
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined, UndefinedError
from numpy.typing import NDArray
from PIL import Image

from lp_framework.analysis.pairs import words
from lp_framework.errors import UserError
from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS
from lp_framework.evaluation.tables import COLUMNS, ERRORS
from lp_framework.report.runs import COSTS, saved_config
from lp_framework.viz.style import CLASS_COLOURS

# What a damaged file leads to; `UserError` is a `ValueError`.
BROKEN = (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError, UndefinedError)
HEADINGS = dict(zip([*ERRORS, *COSTS], ["Rot. (deg)", "Trans.", "s/pair", "passes"], strict=True))
T = TypeVar("T")
Record = Mapping[str, Any]
About = tuple[str, str, Mapping[str, str]]  # title, subtitle, and the most important numbers by name
Sections = Sequence[tuple[str, str, Callable[[Record], Mapping[str, Any]]]]  # title, template, and what fills it


class Section(NamedTuple):
    """A part of a page under its heading; the content is HTML."""

    title: str
    content: str


class RunPart(NamedTuple):
    """A run on a page: what it is in a few words, its most important numbers by name, and its sections."""

    title: str
    subtitle: str
    numbers: Mapping[str, str]
    sections: Sequence[Section]


def run_part(folder: Path, file: str, about: Callable[[Record], About], sections: Sections) -> RunPart:
    """A run by the record in its JSON `file`, with these sections and, last, its configuration.

    What is missing or damaged is told in its place; where the file is, the record is empty.
    """
    record, missing = dict[str, Any](), ""
    try:
        record = _read(folder / file, lambda text: dict(json.loads(text)))
    except UserError as error:
        missing = str(error)

    def reason(error: Exception) -> str:
        damaged = f"its files are damaged ({type(error).__name__}: {str(error).partition(chr(10))[0]})"
        return str(error) if isinstance(error, UserError) else missing or damaged

    def section(title: str, template: str, values: Callable[[Record], Mapping[str, Any]]) -> Section:
        try:
            return Section(title, render(f"{template}.html.j2", **values(record)))
        except BROKEN as error:
            return Section(title, render("note.html.j2", text=f"Not shown: {reason(error)}."))

    try:
        title, subtitle, numbers = about(record)
    except BROKEN as error:
        title, subtitle, numbers = folder.name, f"run without results: {reason(error)}", {}
    config = record.get("config") or tried(lambda: saved_config(folder / "config.yaml"), None)
    text = yaml.safe_dump(config, sort_keys=False, allow_unicode=True) if isinstance(config, Mapping) else None
    last = {"config": text, "versions": record.get("versions"), "folder": folder}
    shown = [*sections, ("Configuration and versions", "configuration", lambda _: last)]
    return RunPart(title, subtitle, numbers, [section(*each) for each in shown])


def render(template: str, **values: Any) -> str:
    """A template of this package with these values, in which text is escaped."""
    return _ENVIRONMENT.get_template(template).render(values)


def tried(value: Callable[[], T], otherwise: T) -> T:
    """A value that is made of a run's files, or another where they are damaged."""
    try:
        return value()
    except BROKEN:
        return otherwise


def read_rows(file: Path) -> list[dict[str, str]]:
    """The rows of a CSV file with a heading; `UserError` where it is missing or damaged."""
    return _read(file, lambda text: list(csv.DictReader(io.StringIO(text, newline=""))))


def _read(file: Path, parse: Callable[[str], T]) -> T:
    try:
        return parse(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"there is no {file.name}") from None
    except (OSError, ValueError, TypeError, RecursionError, csv.Error) as error:
        raise UserError(f"{file.name} is damaged ({error})") from error


def packed(content: go.Figure | str) -> str:
    """A figure or a text for the page's script, compressed, in letters."""
    text = content if isinstance(content, str) else content.to_json()
    return base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode()


def picture(image: NDArray, side: int) -> str:
    """An image `[H, W, 3 or 4]` (uint8) as an address that holds it (WebP), shrunk to at most `side` pixels."""
    shrunk = Image.fromarray(image)
    shrunk.thumbnail((side, side), Image.Resampling.LANCZOS)
    content = io.BytesIO()
    shrunk.save(content, "webp", quality=82)
    return f"data:image/webp;base64,{base64.b64encode(content.getvalue()).decode()}"


def sheet(file: Path) -> str:
    """A printed figure (PNG file) as an address that holds it."""
    return f"data:image/png;base64,{base64.b64encode(file.read_bytes()).decode()}"


def number(name: str, value: float) -> str:
    """A metric's value, rounded as is usual for it."""
    if not math.isfinite(value):
        return "inf"
    if name == "rotation_error":
        return f"{value:.2f}" if value < 100 else f"{value:.0f}"
    digits = {"network_passes_per_pair": ".0f", "seconds_per_pair": ".3g"}
    return format(value, digits.get(name, ".3f"))


def metric(metrics: Mapping[str, float | None], key: str) -> str:
    """A metric in print; a solver with one answer has no success rates, and null is infinity."""
    value = metrics.get(key, math.nan)
    return number(key, math.inf if value is None else value) if key in metrics else "-"


_ENVIRONMENT = Environment(
    loader=PackageLoader("lp_framework.report"),
    autoescape=lambda name: not str(name).endswith(".md.j2"),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_ENVIRONMENT.filters |= {"metric": metric, "picture": picture, "sheet": sheet, "words": words, "packed": packed}
_ENVIRONMENT.tests |= {"finite": math.isfinite}
_ENVIRONMENT.globals |= {
    "classes": list(CLASS_COLOURS),
    "failure": ROTATION_THRESHOLDS[-1],
    "metrics": {key: HEADINGS.get(key, key) for key in (*COLUMNS, *ERRORS)},
    "pi": math.pi,
}
