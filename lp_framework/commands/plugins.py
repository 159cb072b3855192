"""`lp plugins`: every registered name, where it comes from and its settings."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from lp_framework import registry
from lp_framework.errors import UserError

USAGE = """\
Usage: lp plugins [plugins=FOLDER,...]

Lists the members of every group: choose one with GROUP=NAME, change a setting with GROUP.SETTING=VALUE.
Plugins are looked for in installed packages, in plugins/ of the working directory and in the folders named.
A folder that holds Python files or a pyproject.toml is one plugin; any other folder is looked through for plugins,
one level down."""


def main(arguments: Sequence[str]) -> None:
    """Print the tables; in a pipe, one line a name and nothing cut off."""
    if {"--help", "-h"} & set(arguments):
        print(USAGE)
        return
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key != "plugins" or not value:
            raise UserError(f"'{argument}' is nothing that this command knows; it takes plugins=FOLDER,...")
        registry.discover(folder.strip() for folder in value.strip("[]").split(","))
    terminal = sys.stdout.isatty()
    console = Console(highlight=False, width=None if terminal else 10_000)
    for group in registry.GROUPS:
        console.print(_table(group))
        console.print()
    for origin, error in registry.failures().items():
        console.print(Text(f"plugin {origin} could not be loaded: {error}", style="red"))


def _table(group: str) -> Table:
    entries = registry.entries(group)
    table = Table(
        title=f"{group}=NAME", title_justify="left", title_style="bold", box=None, padding=(0, 2), pad_edge=False
    )
    for heading in ("name", "origin", "settings", "description"):
        table.add_column(heading, overflow="fold", header_style="dim")
    for entry in entries:
        settings = ", ".join(map(str, entry.settings))
        needs = ", ".join(argument.name for argument in entry.components)
        cells = (entry.name, entry.origin, settings + (f" (needs: {needs})" if needs else ""), entry.summary)
        table.add_row(*map(Text, cells))
    if not entries:
        table.add_row("(none)")
    return table
