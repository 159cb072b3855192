"""The directive `choices`: what a group offers and every setting of it, from `conf/`.

    ```{choices} solver
    ```

The groups' YAML files hold each setting with its default and a comment; this makes a
section and a table of each file when the site is built.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from lp_framework import catalogue, registry

CONF = registry.conf_dir()
SETTING = re.compile(r"( *)([\w@./-]+):(?: +(?!#)(.*?))?(?: +# (.*))?$")
HEADINGS = ("setting", "default", "meaning")


def settings(
    lines: Iterable[str], path: tuple[str, ...] = ()
) -> Iterator[tuple[str, str, str]]:
    """Key, default and comment of each setting, nested ones by their dotted key.

    >>> list(settings(["ray: # of Ray", "  init:", "    address: null # where"]))
    [('ray', '', 'of Ray'), ('ray.init.address', 'null', 'where')]
    """
    for line in lines:
        if line.lstrip().startswith("#") or not (found := SETTING.match(line)):
            continue
        indent, key, value, comment = found.groups()
        path = (*path[: len(indent) // 2], key)
        if value or comment:
            yield ".".join(path), value or "", comment or ""


class Choices(SphinxDirective):
    """A section for each choice of a group, or with `commands` for each command."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        group = self.arguments[0]
        folder = CONF if group == "commands" else CONF / group
        return [self.section(group, file) for file in sorted(folder.glob("*.yaml"))]

    def section(self, group: str, file: Path) -> nodes.section:
        """Name, first comment, and settings of a YAML file."""
        self.env.note_dependency(str(file))
        text = file.read_text(encoding="utf-8")
        config = catalogue.parse(text)
        name = file.stem if group == "commands" else f"{group}={file.stem}"
        section = nodes.section(ids=[nodes.make_id(name)], names=[name])
        section += nodes.title("", "", nodes.literal("", name))
        section += nodes.paragraph("", "", *prose(config.summary))
        if group == "experiment":
            section += yaml_block(text)
            return section
        if bases := [based_on(entry) for entry in config.defaults if entry != "_self_"]:
            section += nodes.paragraph(
                "", "Builds on ", *separated(bases), nodes.Text(".")
            )
        own = (lines for key, lines in config.settings.items() if key != "name")
        if rows := [row for lines in own for row in settings(lines)]:
            section += table(rows)
        return section


def based_on(entry: Any) -> str:
    """An entry of a defaults list as one word: `two_stage` or `solver=two_stage`."""
    if not isinstance(entry, dict):
        return str(entry)
    ((key, value),) = entry.items()
    group = key.removeprefix("override ").removeprefix("/").removesuffix("@_here_")
    return f"{group}={'null' if value is None else value}"


def separated(words: Sequence[str]) -> list[nodes.Node]:
    """Words as code, with commas between them."""
    parts = [
        part for word in words for part in (nodes.Text(", "), nodes.literal("", word))
    ]
    return parts[1:]


def yaml_block(text: str) -> nodes.literal_block:
    """A YAML file without the comment at its top."""
    lines = text.splitlines()
    first = next(index for index, line in enumerate(lines) if not line.startswith("#"))
    block = nodes.literal_block("", "\n".join(lines[first:]).strip("\n"))
    block["language"] = "yaml"
    return block


def table(rows: Sequence[tuple[str, str, str]]) -> nodes.table:
    """Settings, with their defaults and meanings."""
    head, body = nodes.thead(), nodes.tbody()
    head += row(*([nodes.Text(heading)] for heading in HEADINGS))
    for key, value, comment in rows:
        default = nodes.literal("", value) if value else nodes.Text("")
        if value == registry.MISSING:
            default = nodes.emphasis("", "required")
        body += row([nodes.literal("", key)], [default], prose(comment))
    group = nodes.tgroup(
        "", *(nodes.colspec(colwidth=width) for width in (3, 2, 5)), head, body, cols=3
    )
    return nodes.table("", group, classes=["settings", "colwidths-given"])


def row(*cells: Sequence[nodes.Node]) -> nodes.row:
    """A row of a table."""
    return nodes.row(
        "", *(nodes.entry("", nodes.paragraph("", "", *cell)) for cell in cells)
    )


def prose(comment: str) -> list[nodes.Node]:
    """The text of a comment, with text between backticks as code."""
    parts = enumerate(comment.split("`"))
    return [
        nodes.literal("", part) if number % 2 else nodes.Text(part)
        for number, part in parts
        if part
    ]


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directive."""
    app.add_directive("choices", Choices)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
