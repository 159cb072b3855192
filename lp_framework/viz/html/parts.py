"""What the parts of all pages share: reading a run's files, and a section that survives what is missing or damaged."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from lp_framework.errors import UserError
from lp_framework.viz.html.elements import Cell, Html, facts, folded, section, sentence, tag

# What a damaged file leads to.
BROKEN = (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError)


@dataclass(frozen=True)
class RunPart:
    """A run on a page: what it is in a few words, its most important numbers, and its sections."""

    title: str
    subtitle: str
    numbers: Mapping[str, Cell]
    sections: list[Html] = field(default_factory=list)


def guarded(title: str, build: Callable[[], Html]) -> Html:
    """A section under its title; where its files are missing or damaged, a sentence that says so."""
    try:
        return section(title, build())
    except BROKEN as error:
        return section(title, sentence(f"Not shown: {told(error)}."))


def told(error: Exception) -> str:
    """An error within a sentence."""
    return str(error) if isinstance(error, UserError) else f"its files are damaged ({type(error).__name__}: {error})"


def read_json(file: Path) -> dict[str, Any]:
    """An object of JSON; `UserError` where it is missing or damaged."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"there is no {file.name}") from None
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{file.name} is damaged ({error})") from error
    if not isinstance(content, dict):
        raise UserError(f"{file.name} is damaged (it holds no object)")
    return content


def read_rows(file: Path) -> list[dict[str, str]]:
    """The rows of a CSV file with a heading; `UserError` where it is missing or damaged."""
    try:
        with file.open(newline="", encoding="utf-8") as content:
            return list(csv.DictReader(content))
    except FileNotFoundError:
        raise UserError(f"there is no {file.name}") from None
    except (OSError, ValueError, csv.Error) as error:
        raise UserError(f"{file.name} is damaged ({error})") from error


def configuration(folder: Path, config: Mapping[str, Any] | None, versions: Mapping[str, str] | None) -> Html:
    """The end of a run's part: where it is, its configuration and its versions."""
    text = None if config is None else yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True)
    return section(
        "Configuration and versions",
        folded("Configuration", sentence("Not shown: it was not recorded.") if text is None else tag("pre", {}, text)),
        folded(
            "Versions",
            sentence("Not shown: they were not recorded.")
            if not versions
            else facts({str(name): str(version) for name, version in versions.items()}),
        ),
        folded("Folder", facts({"folder": str(folder)})),
    )
