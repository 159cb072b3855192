"""Quoting of paths on the command line, so that Hydra reads them as plain text.

Hydra's grammar parses a folder called 20240101 as a number, and fails on brackets, quotes and non-ASCII letters in file
names. Values of settings that hold paths are therefore quoted where necessary.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence

from lp_framework.errors import UserError

# Settings that hold a path, or a list of paths or names.
PATHS = re.compile(
    r"(images?|masks|checkpoint|resume|path|output|runs|plugins|data\.views|hydra\.(run|sweep)\.dir"
    r"|data\.objects(?==\[)|[^=]+\.(path|labels|renderings|cache))="
)
PLAIN_TEXT = re.compile(r"[\w./:@%+*?|-]+", re.ASCII)  # plain text for Hydra, unless it matches the following
NUMBER_OR_BOOL = re.compile(r"[-+]?[\d_]*\.?[\d_]+(e[-+]?\d+)?|[-+]?(inf|nan)|true|false", re.IGNORECASE)
# Values to leave to Hydra: empty, quoted text, a function, an interpolation.
HYDRA_ONLY = re.compile(r"null|\?\?\?|['\"].*|(choice|range|glob|interval|sort|shuffle|str)\(.*\)|.*\$\{.*", re.DOTALL)
PLAIN_ARGUMENTS = {"estimate": "images"}  # the setting for arguments without a key


def quote_paths(command: str, overrides: Sequence[str]) -> list[str]:
    """Quote the paths in overrides where Hydra needs it, and turn arguments without a key into a setting.

    `lp estimate "IMG (1).png" b.png` becomes `images=['IMG (1).png',b.png]`.
    """
    key = PLAIN_ARGUMENTS.get(command)
    plain = [each for each in overrides if key and "=" not in each and each[:1] not in ("~", "+", "")]
    keyed = [_as_text(each) for each in overrides if each not in plain]
    if plain and any(each.startswith(f"{key}=") for each in keyed):
        raise UserError(f"give the {key} either as {key}=... or as arguments without a key, got both")
    value = _quoted(plain[0]) if len(plain) == 1 else f"[{','.join(map(_quoted, plain))}]"
    return [f"{key}={value}", *keyed] if plain else keyed


def values_of(overrides: Iterable[str]) -> dict[str, str]:
    """The value, as text, that a command line sets each key to; the last one counts.

    >>> values_of(["seed=1", "+solver.gamma=0.3", "~start", "seed=2"])
    {'seed': '2', 'solver.gamma': '0.3'}
    """
    return dict(override.lstrip("+").split("=", 1) for override in overrides if "=" in override)


def _as_text(override: str) -> str:
    key, equals, value = override.partition("=")
    if not equals or not PATHS.match(override.lstrip("+")) or HYDRA_ONLY.fullmatch(value):
        return override
    inside = value[1:-1] if value[:1] == "[" and value[-1:] == "]" else value
    if any(quote in inside for quote in "'\"") and "," in inside:
        return override  # a user who quotes one of several knows Hydra's rules
    parts = ",".join(_quoted(part.strip()) for part in inside.split(","))
    as_list = inside is not value or (key == "plugins" and value)
    return f"{key}=[{parts}]" if as_list else f"{key}={parts}"


def _quoted(path: str) -> str:
    """Quote a path so that Hydra reads it as text; expands a leading `~` to the home folder."""
    path = os.path.expanduser(path)
    if not path or HYDRA_ONLY.fullmatch(path):
        return path
    if PLAIN_TEXT.fullmatch(path) and not NUMBER_OR_BOOL.fullmatch(path):
        return path
    escaped = re.sub(r"(\\*)('|$)", lambda found: 2 * found[1] + ("\\'" if found[2] else ""), path)
    return f"'{escaped}'"
