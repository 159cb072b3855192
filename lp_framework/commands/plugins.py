"""`lp plugins`: every choice of every group, where it comes from and its settings."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from lp_framework import catalogue, registry
from lp_framework.errors import UserError

USAGE = """\
Usage: lp plugins [plugins=FOLDER,...]

Lists the members of every group: choose one with GROUP=NAME, change a setting with GROUP.SETTING=VALUE.
Plugins are found in installed packages, in plugins/ of the working directory and in the folders that you name.
A folder that holds Python files or a pyproject.toml is one plugin; any other folder is searched for plugins one level
down."""


def main(arguments: Sequence[str]) -> None:
    """Print the tables; when piped, one untruncated line per name."""
    if {"--help", "-h"} & set(arguments):
        print(USAGE)
        return
    for argument in arguments:
        if not argument.startswith("plugins="):
            raise UserError(f"'{argument}' is not an argument of this command; it takes plugins=FOLDER,...")
    registry.discover(catalogue.plugin_folders(arguments))
    terminal = sys.stdout.isatty()
    console = Console(highlight=False, width=None if terminal else 10_000)
    for group in registry.GROUPS:
        console.print(_table(group))
        console.print()
    for origin, error in registry.failures().items():
        console.print(Text(f"plugin {origin} could not be loaded: {error}", style="red"))


def _table(group: str) -> Table:
    table = Table(
        title=f"{group}=NAME", title_justify="left", title_style="bold", box=None, padding=(0, 2), pad_edge=False
    )
    for heading in ("name", "origin", "settings", "description"):
        table.add_column(heading, overflow="fold", header_style="dim")
    for choice in catalogue.choices(group):
        config = catalogue.read(f"{group}/{choice}")
        settings = [_assignment(lines) for key, lines in config.settings.items() if key != "name"]
        table.add_row(*map(Text, (choice, catalogue.origin(group, choice), ", ".join(settings), config.summary)))
    return table


def _assignment(lines: Sequence[str]) -> str:
    """`key=value` from the lines of a setting, without its comment."""
    key, _, value = next(line for line in lines if not line.startswith("#")).partition(" #")[0].partition(": ")
    return f"{key}={value.strip()}"
