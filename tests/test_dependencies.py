"""docs/dependencies.md names what pyproject.toml names, with the licences that the packages have."""

from __future__ import annotations

import ast
import importlib.metadata
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODULES = {
    "PIL": "pillow",
    "OpenGL": "pyopengl",
    "yaml": "pyyaml",
    "hydra": "hydra-core",
    "cv2": "opencv-python-headless",
}
# Words of which one has to be in a package's metadata or licence file where the page has the licence.
WORDS = {
    "Apache-2.0": ("Apache",),
    "BSD-2-Clause": ("Redistribution and use in source and binary forms",),
    "BSD-3-Clause": ("BSD", "Redistribution and use in source and binary forms"),
    "BSD": ("BSD",),
    "MIT": ("MIT", "Permission is hereby granted, free of charge"),
    "MIT-CMU": ("MIT-CMU", "HPND"),
    "MPL-2.0": ("MPL-2.0", "Mozilla Public License"),
    "PSF-based": ("Python Software Foundation License",),
}


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def wanted() -> dict[str, str]:
    """What pyproject.toml names: package to extra, "" for what is always installed."""
    text = (ROOT / "pyproject.toml").read_text()
    sections = {"": re.search(r"^dependencies = \[\n(.*?)^\]", text, re.DOTALL | re.MULTILINE)[1]}
    extras = re.search(r"^\[project.optional-dependencies\]\n(.*?)^\[", text, re.DOTALL | re.MULTILINE)[1]
    for extra, content in re.findall(r"^([\w-]+) = \[(.*?)\](?:  #[^\n]*)?$", extras, re.DOTALL | re.MULTILINE):
        sections[extra] = re.sub(r'"lp_framework\[[\w,]+\]"', "", content)
    return {
        normal(name): extra
        for extra, content in sections.items()
        for name in re.findall(r'"([\w.-]+)(?:\[[\w,]+\])?[><=]', content)
    }


def listed() -> dict[str, tuple[str, str]]:
    """The rows of the page: package to extra and licence."""
    found = {}
    for line in (ROOT / "docs" / "dependencies.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| ") and not line.startswith(("| ---", "| Package")):
            extra = cells[1] if len(cells) == 4 else ""
            assert normal(cells[0]) not in found and len(cells[-1]) > 3
            found[normal(cells[0])] = (extra, cells[-2])
    return found


def test_the_list_is_that_of_the_project():
    assert {name: extra for name, (extra, _) in listed().items()} == wanted()
    assert len(wanted()) > 30


@pytest.mark.parametrize("name", sorted(listed()))
def test_a_package_has_the_licence_that_is_listed(name):
    try:
        package = importlib.metadata.distribution(name)
    except importlib.metadata.PackageNotFoundError:
        pytest.skip(f"{name} is not installed")
    known = [value for key, value in package.metadata.items() if key in ("License", "License-Expression", "Classifier")]
    files = [file for file in package.files or () if re.search(r"licen[sc]e", file.name, re.IGNORECASE)]
    known += [file.locate().read_text(errors="replace") for file in files]
    assert any(word in text for text in known for word in WORDS[listed()[name][1]])


def test_all_imported_packages_are_dependencies():
    """Only packages in pyproject.toml are imported, none that are merely dependencies of others."""
    imported = set()
    for file in (ROOT / "lp_framework").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                imported.add(node.module.partition(".")[0])
    others = imported - set(sys.stdlib_module_names) - {"lp_framework", "mpl_toolkits"}
    assert {normal(MODULES.get(name, name)) for name in others} <= set(wanted())
