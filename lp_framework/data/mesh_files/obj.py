"""Wavefront OBJ with its materials, as other viewers read it.

trimesh reads the geometry. Features that it ignores are converted first: several material files are merged, textures
are located, negative indices are made positive. The options of a texture are applied to its coordinates.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import trimesh
from trimesh.visual import TextureVisuals

from lp_framework.data.mesh_files.common import (
    CLAMP,
    REPEAT,
    WRAP,
    MissingColourWarning,
    find,
    load,
    texture_bytes,
    warn,
)

MATERIALS = "materials.mtl"  # the merged material file passed to trimesh
OPTION = re.compile(  # of a texture, given before its name
    r"-(?P<name>[ost])(?P<numbers>(?:\s+[-+.\deE]+(?=\s)){1,3})\s+|-clamp\s+(?P<clamp>on|off)\s+"
    r"|-mm\s+\S+\s+\S+\s+|-(?:blendu|blendv|boost|bm|cc|imfchan|texres|type)\s+\S+\s+",
    re.IGNORECASE,
)


@dataclass
class Mapping:
    """How a texture maps to a surface: coordinates times `scale` plus `offset`; clamped or repeated at its sides."""

    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    clamped: bool = False


def read_obj(path: Path, folders: Sequence[Path]) -> trimesh.Scene:
    """Read an .obj file as a scene; material files and textures are searched for in `folders`. Meshes have their
    texture's wrap modes in `metadata[WRAP]`."""
    text = _read(path)
    if re.search(r"^f[ \t].*?[ \t/]-\d", text, re.MULTILINE):
        text = _absolute_indices(text)
    if re.search(r"^v(?:[ \t]+\S+){6}", text, re.MULTILINE):  # trimesh needs a colour at every vertex
        text = re.sub(r"^(v(?:[ \t]+[^\s#]+){3})[ \t]*$", r"\1 1 1 1", text, flags=re.MULTILINE)
    libraries = _libraries(path, text, folders)
    read = {file: _read(file) for file in libraries if file is not None}
    used = dict.fromkeys(re.findall(r"^usemtl[ \t]+(.*?)[ \t]*$", text, re.MULTILINE))
    newmtl = re.compile(r"^[ \t]*newmtl[ \t]+(.*?)[ \t]*$", re.MULTILINE | re.IGNORECASE)
    known = [name for library in read.values() for name in newmtl.findall(library)]
    if not used and known:  # other viewers use the first
        used, text = {known[0]: None}, f"usemtl {known[0]}\n{text}"
    if None not in libraries and (unknown := [name for name in used if name not in known]):
        warn(path, f"its material {' and '.join(unknown)} is not in any of its material files", MissingColourWarning)
    materials, mappings, files = _with_textures(path, read, used, folders)
    scene = load("obj", io.StringIO(f"mtllib {MATERIALS}\n{text}"), {MATERIALS: materials, **files})
    for mesh in scene.geometry.values():
        if isinstance(mesh.visual, TextureVisuals) and (mapping := mappings.get(mesh.visual.material.name)):
            mesh.metadata[WRAP] = (CLAMP, CLAMP) if mapping.clamped else (REPEAT, REPEAT)
            if mesh.visual.uv is not None and mapping != Mapping(clamped=mapping.clamped):
                mesh.visual.uv = mesh.visual.uv * mapping.scale + mapping.offset
    return scene


def _read(path: Path) -> str:
    # Preserve file names in other encodings.
    return path.read_text(encoding="utf-8-sig", errors="surrogateescape")


def _libraries(path: Path, text: str, folders: Sequence[Path]) -> list[Path | None]:
    """The material files that a text refers to; None, after a warning, for a missing one."""
    found = []
    for names in re.findall(r"^mtllib[ \t]+(.*?)[ \t]*$", text, re.MULTILINE):
        for name in [names] if find(names, folders) else names.split():  # one name with spaces, or several names
            found.append(find(name, folders))
            if found[-1] is None:
                warn(path, f"its material file {name} is missing", MissingColourWarning)
    return found


def _with_textures(
    path: Path, libraries: dict[Path, str], used: dict[str, None], folders: Sequence[Path]
) -> tuple[str, dict[str, Mapping], dict[str, bytes]]:
    """The materials of all files, with textures named 0, 1, ...; mappings by material; and texture bytes."""
    lines: list[str] = []
    mappings: dict[str, Mapping] = {}
    files: dict[str, bytes] = {}
    material = ""
    for folder, line in ((file.parent, line) for file, text in libraries.items() for line in text.splitlines()):
        key, _, value = line.strip().replace("\t", " ").partition(" ")
        if key.lower() == "newmtl":
            material = value.strip()
        elif key.lower() == "map_kd":
            mapping, name = _options(value)
            data = texture_bytes(path, name, (folder, *folders)) if material in used else None
            if data is None:
                continue
            mappings[material], line = mapping, f"map_Kd {len(files)}"
            files[str(len(files))] = data
        lines.append(line)
    return "\n".join(lines), mappings, files


def _options(value: str) -> tuple[Mapping, str]:
    """Parse the options before a texture's name: its mapping, and the name."""
    value, mapping = value.strip(), Mapping()
    while option := OPTION.match(value):
        u, v, *_ = (*map(float, (option["numbers"] or "").split()), None, None)
        match (option["name"] or "").lower():
            case "s":
                mapping.scale = (u, 1.0 if v is None else v)
            case "o":
                mapping.offset = (u, 0.0 if v is None else v)
        if option["clamp"]:
            mapping.clamped = option["clamp"].lower() == "on"
        value = value[option.end() :]
    return mapping, value


def _absolute_indices(text: str) -> str:
    """Convert face indices that count back from the current line (-1 is the last) to indices from the start (1 is the
    first)."""
    counts = {"v": 0, "vt": 0, "vn": 0}
    lines = []
    for line in text.splitlines():
        kind, *corners = line.split() or [""]
        if kind in counts:
            counts[kind] += 1
        elif kind == "f":
            for place, corner in enumerate(corners):
                pairs = zip(corner.split("/"), counts.values(), strict=False)
                corners[place] = "/".join(str(int(i) + 1 + count) if i.startswith("-") else i for i, count in pairs)
            line = " ".join(("f", *corners))
        lines.append(line)
    return "\n".join(lines)
