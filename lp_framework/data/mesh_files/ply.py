"""PLY with its texture."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import trimesh

from lp_framework.data.mesh_files.common import load, texture_bytes
from lp_framework.errors import UserError


def read_ply(path: Path, folders: Sequence[Path]) -> trimesh.Scene:
    """The scene of a .ply file, whose texture is looked for in `folders`."""
    with path.open("rb") as file:
        header = b"".join(iter(lambda: _until_end(file.readline()), b"")).decode("utf-8")
        names = list(dict.fromkeys(re.findall(r"^comment\s+TextureFile\s+(.*?)\s*$", header, re.MULTILINE | re.I)))
        if len(names) > 1:
            raise UserError(f"{path}: has {len(names)} textures, one is read; save it as glTF or OBJ")
        textures = {name: texture_bytes(path, name, folders) for name in names}
        files: dict[str, bytes | str] = {name: data for name, data in textures.items() if data is not None}
        file.seek(0)
        return load("ply", file, files, skip_materials=not files)


def _until_end(line: bytes) -> bytes:
    return b"" if line.startswith(b"end_header") else line
