"""What the parts of all pages share: a run's files, and sections that survive what is missing or damaged."""

from __future__ import annotations

import base64
import csv
import gzip
import io
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined, UndefinedError
from numpy.typing import NDArray
from PIL import Image

from lp_framework.analysis.shown import words
from lp_framework.errors import UserError
from lp_framework.evaluation.metrics import ROTATION_THRESHOLDS
from lp_framework.evaluation.tables import COLUMNS, ERRORS
from lp_framework.report.printed_tables import HEADINGS, number
from lp_framework.viz.style import CLASS_COLOURS

# What a damaged file leads to.
BROKEN = (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError, UndefinedError)
T = TypeVar("T")


class Section(NamedTuple):
    """A part of a page under its heading; the content is HTML."""

    title: str
    content: str


@dataclass(frozen=True)
class RunPart:
    """A run on a page: what it is in a few words, its most important numbers by name, and its sections."""

    title: str
    subtitle: str
    numbers: Mapping[str, str]
    sections: list[Section]


def render(template: str, **values: Any) -> str:
    """A template of this package with these values, in which text is escaped."""
    return _ENVIRONMENT.get_template(template).render(values)


def section(title: str, template: str, values: Callable[[], Mapping[str, Any]]) -> Section:
    """A section from its template; where its files are missing or damaged, a sentence that says so."""
    try:
        return Section(title, render(f"{template}.html.j2", **values()))
    except UserError as error:
        reason = str(error)
    except BROKEN as error:
        reason = f"its files are damaged ({type(error).__name__}: {str(error).partition(chr(10))[0]})"
    return Section(title, render("note.html.j2", text=f"Not shown: {reason}."))


def configuration(folder: Path, record: Mapping[str, Any]) -> Section:
    """The last section of a run: where it is, and the `config` and `versions` that its record has."""

    def values() -> dict[str, Any]:
        config = record.get("config")
        text = yaml.safe_dump(config, sort_keys=False, allow_unicode=True) if isinstance(config, Mapping) else None
        return {"config": text, "versions": record.get("versions"), "folder": folder}

    return section("Configuration and versions", "configuration", values)


def tried(value: Callable[[], T], otherwise: T) -> T:
    """A value that is made of a run's files, or another where they are damaged."""
    try:
        return value()
    except BROKEN:
        return otherwise


def read_json(file: Path) -> dict[str, Any]:
    """An object of JSON; `UserError` where it is missing or damaged."""
    content = _read(file, json.loads)
    if not isinstance(content, dict):
        raise UserError(f"{file.name} is damaged (it holds no object)")
    return content


def read_rows(file: Path) -> list[dict[str, str]]:
    """The rows of a CSV file with a heading; `UserError` where it is missing or damaged."""
    return _read(file, lambda text: list(csv.DictReader(io.StringIO(text, newline=""))))


def _read(file: Path, parse: Callable[[str], T]) -> T:
    try:
        return parse(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"there is no {file.name}") from None
    except (OSError, ValueError, RecursionError, csv.Error) as error:
        raise UserError(f"{file.name} is damaged ({error})") from error


def packed(text: str) -> str:
    """Text for the page's script, compressed, in letters."""
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


def metric(metrics: Mapping[str, float | None], key: str) -> str:
    """A metric in print; a solver with one answer has no success rates, and null is infinity."""
    if key not in metrics:
        return "-"
    value = metrics[key]
    return number(key, math.inf if value is None else value)


_ENVIRONMENT = Environment(
    loader=PackageLoader("lp_framework.report"),
    autoescape=lambda name: not str(name).endswith(".md.j2"),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_ENVIRONMENT.filters |= {"metric": metric, "picture": picture, "sheet": sheet, "words": words}
_ENVIRONMENT.globals |= {
    "classes": list(CLASS_COLOURS),
    "failure": ROTATION_THRESHOLDS[-1],
    "metrics": {key: HEADINGS.get(key, key) for key in (*COLUMNS, *ERRORS)},
}
