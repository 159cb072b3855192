"""The documentation builds strictly without network, and covers everything that is public or can be chosen."""

from __future__ import annotations

import importlib
import inspect
import io
import re
import shlex
import socket
import sys
from pathlib import Path
from types import ModuleType

import pytest

import lp_framework
from lp_framework import registry

pytest.importorskip("myst_nb", reason="the documentation is built with the packages of the extra docs")
import nbformat
from nbclient import NotebookClient
from sphinx.application import Sphinx
from sphinx.util.docutils import docutils_namespace, patch_docutils

ROOT = Path(__file__).parents[1]
DOCS, CONF = ROOT / "docs", ROOT / "conf"
PAGES = [*DOCS.rglob("*.md"), *ROOT.glob("*.md"), *ROOT.glob("plugins/*/README.md")]


def no_network(*arguments: object) -> None:
    raise OSError("the documentation has to build without network")


def test_the_site_builds_without_warning_or_network_and_is_complete(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(socket.socket, "connect", no_network)
    site, warnings = tmp_path / "site", io.StringIO()
    # The notebook has a test of its own, which runs beside this one.
    quiet = {"nb_execution_mode": "off"}
    with patch_docutils(DOCS), docutils_namespace():
        app = Sphinx(DOCS, DOCS, site, tmp_path / "trees", "html", quiet, status=None, warning=warnings)
        app.build()
    assert warnings.getvalue() == ""

    for page in site.rglob("*.html"):  # it can be read without network, too
        fetched = re.findall(r'<(?:script|img|iframe)[^>]* src="([^"]+)|<link[^>]* href="([^"]+)', page.read_text())
        assert [address for pair in fetched for address in pair if re.match(r"(https?:)?//", address)] == []

    assert '<math xmlns="http://www.w3.org/1998/Math/MathML"' in (site / "method.html").read_text()

    for file in [file for file in CONF.rglob("*.yaml") if file.parent != CONF]:
        folder = file.parent.relative_to(CONF)
        page = site / "catalogue" / f"{folder.name}.html"
        assert page.exists(), f"the choices of conf/{folder} need a page docs/catalogue/{folder.name}.md"
        assert f">{folder.as_posix()}={file.stem}<" in page.read_text(), file
    commands = (site / "catalogue" / "commands.html").read_text()
    assert [file.stem for file in CONF.glob("*.yaml") if f">{file.stem}<" not in commands] == []

    entries = set(app.env.get_domain("py").objects)
    assert {f"lp_framework.{name}" for name in lp_framework.__all__} <= entries
    assert [name for name in entries if not inspect.getdoc(found(name))] == []
    for name in entries:  # what a plugin has to write is described
        for method in getattr(found(name), "__abstractmethods__", ()):
            assert f"{name}.{method}" in entries


def found(name: str) -> object:
    """The object of a dotted name."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            here: object = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            here = getattr(here, part)
        return here
    raise AssertionError(f"nothing is called {name}")


@pytest.mark.heavy
def test_the_notebook_runs_and_finds_the_poses_it_states():
    notebook = nbformat.read(DOCS / "notebook.ipynb", as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell for cell in code if cell.outputs or cell.execution_count] == []  # outputs are not committed
    NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(DOCS)}}).execute()
    outputs = [output for cell in code for output in cell.outputs]
    text = "".join(output.text for output in outputs if output.output_type == "stream" and output.name == "stdout")
    around, up, probability = re.search(r"(\d+)° around, (\d+)° up; .* ([\d.]+)", text).groups()
    assert abs(int(around) - 60) <= 6 and abs(int(up) - 10) <= 6 and float(probability) > 0.8
    truth = int(re.search(r"truth: (\d+)°", text)[1])
    ends = {
        solver: [int(end) for end in re.findall(r"\d+", line)] for solver, line in re.findall(r"(\w+) ends(.*)", text)
    }
    off = {solver: [abs((end - truth + 180) % 360 - 180) for end in each] for solver, each in ends.items()}
    assert max(off["two_stage"]) <= 3
    assert sorted(error > 150 for error in off["ifusion"]) == [False, False, True, True]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_relative_links_lead_to_files(page):
    text = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    targets = re.findall(r"\]\(<?([^)>#\s]+)", text)
    missing = [each for each in targets if "://" not in each and not (page.parent / each).exists()]
    assert missing == []


COMMAND = re.compile(r"^ *(?:\$ )?(?:OMP_NUM_THREADS=1 )?(?:python -m lp_framework|lp) ([a-z].*)", re.MULTILINE)
VARIABLE = re.compile(r'^ *([A-Z])="(.*)"$', re.MULTILINE)


def commands(page: Path) -> list[str]:
    """The command lines on a page, with the values of its shell variables."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    values = dict(VARIABLE.findall(text))
    lines = [re.sub(r"\$([A-Z])\b", lambda found: values[found[1]], line) for line in COMMAND.findall(text)]
    return [shlex.join(shlex.split(line, comments=True)) for line in lines]


registry.discover([DOCS / "examples"])
PAGE_BY_LINE = {line: page.name for page in (ROOT / "README.md", *DOCS.glob("*.md")) for line in commands(page)}


@pytest.mark.parametrize("line", sorted(PAGE_BY_LINE), ids=str)
def test_a_command_on_a_page_has_choices_and_settings_that_exist(line, lp, tmp_path):
    """It composes; what it does is tested elsewhere. Of a sweep the first job does."""
    command, *arguments = shlex.split(line)
    if command == "plugins" or any(argument.startswith("resume=") for argument in arguments):
        return
    (tmp_path / "docs").symlink_to(DOCS)
    if "--multirun" in arguments:
        arguments.remove("--multirun")
        arguments = [argument if "[" in argument else argument.partition(",")[0] for argument in arguments]
    finished = lp(command, *arguments, "--cfg", "job")
    assert finished.status == 0, (PAGE_BY_LINE[line], finished.err)


def test_the_pages_have_commands():
    assert len(PAGE_BY_LINE) > 80


def choices() -> ModuleType:
    sys.path.append(str(DOCS / "_extensions"))
    try:
        return importlib.import_module("choices")
    finally:
        sys.path.pop()


def test_settings_of_a_yaml_file_become_rows():
    text = """\
    second: # of the second stage
      starts: [1, 2] # numbers of starts
      # The following apply to both.
      deep:
        rate: 0.1 # step size
    steps: 3
    """
    lines = [line[4:] for line in text.splitlines()]
    assert list(choices().settings(lines)) == [
        ("second", "", "of the second stage"),
        ("second.starts", "[1, 2]", "numbers of starts"),
        ("second.deep.rate", "0.1", "step size"),
        ("steps", "3", ""),
    ]
