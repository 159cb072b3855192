"""The exception for user mistakes: the command line prints its message without a traceback."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterable
from types import ModuleType


class UserError(ValueError):
    """Bad input, explained in one sentence: what is wrong, where it is, and what would be right."""

    status = 1  # the exit status of a command


def nearest(name: str, known: Iterable[str], cutoff: float = 0.5) -> str:
    """`"; did you mean 'x'?"` for the known name closest to `name`, or an empty string if none is close.

    `cutoff` is the minimum ratio of `difflib.SequenceMatcher`; equal names have ratio 1.

    >>> nearest("scor", ["score", "energy"])
    "; did you mean 'score'?"
    """
    matches = difflib.get_close_matches(name, list(known), n=1, cutoff=cutoff)
    return f"; did you mean '{matches[0]}'?" if matches else ""


def among(name: str, known: Iterable[str]) -> str:
    """Suffix for an error about an unknown `name`: the closest known name, and a list of all of them.

    >>> among("scor", ["score", "energy"])
    "; did you mean 'score'? (known: score, energy)"
    """
    names = list(known)
    return f"{nearest(name, names)} (known: {', '.join(names) or 'none'})"


def one_line(error: BaseException) -> str:
    """An error's message in one line, without the extra lines added by OmegaConf and Hydra."""
    lines = [line.strip() for line in str(error).splitlines()]
    return " ".join(line for line in lines if line and not line.startswith(("full_key:", "object_type=", "See https:")))


def printable(text: str) -> str:
    r"""Escape characters that a terminal would act on, such as the `\r` of a command copied from Windows.

    >>> print(printable("cannot read 'seed=1\r'"))
    cannot read 'seed=1\r'
    """
    return "".join(each if each.isprintable() or each == "\n" else repr(each)[1:-1] for each in text)


def check_settings(group: str, *settings: tuple[str, object, bool, str]) -> None:
    """Raise `UserError` for the first invalid one of a group's settings (name, value, is valid, what is required).

    >>> check_settings("solver", ("steps", 0, False, "at least 1"))
    Traceback (most recent call last):
    lp_framework.errors.UserError: solver.steps must be at least 1, got 0
    """
    for name, value, fits, wanted in settings:
        if not fits:
            raise UserError(f"{group}.{name} must be {wanted}, got {value}")


def at_least(least: float, group: str, **settings: float) -> None:
    """Raise `UserError` for the first of a group's settings that is below `least` or NaN.

    >>> at_least(1, "solver", steps=0)
    Traceback (most recent call last):
    lp_framework.errors.UserError: solver.steps must be at least 1, got 0
    """
    check_settings(group, *((name, value, value >= least, f"at least {least}") for name, value in settings.items()))


def positive(group: str, **settings: float) -> None:
    """Raise `UserError` for the first of a group's settings that is not positive."""
    check_settings(group, *((name, value, value > 0, "positive") for name, value in settings.items()))


def optional_import(module: str, user: str, install: str) -> ModuleType:
    """Import an optional package for `user`; raises `UserError` with `install` instructions if it is missing."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise UserError(f"{user} needs the Python package '{error.name}', which is not installed: {install}") from error
