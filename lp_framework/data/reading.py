"""What the readers of files share: whatever is wrong with one, its reader says so in a sentence that names it."""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lp_framework.errors import UserError
from lp_framework.geometry import is_rotation, spherical_residual

LARGEST_RESIDUAL = 1.0  # degrees; a camera further from a spherical one is refused


def read_json(file: Path) -> Any:
    """The content of a JSON file, of a gzipped one (.jgz) too."""
    zipped = file.suffix == ".jgz"
    with expecting(f"{file}: is not readable {'gzipped ' if zipped else ''}JSON"):
        content = file.read_bytes()
        return json.loads(gzip.decompress(content) if zipped else content)


@contextmanager
def expecting(sentence: str) -> Iterator[None]:
    """Make `UserError`, with what `sentence` says is wanted, of what goes wrong in reading or taking apart."""
    try:
        yield
    except UserError:
        raise
    except FileNotFoundError as error:
        raise UserError(f"{error.filename}: there is no such file") from error
    except Exception as error:  # parsers raise anything from KeyError to struct.error
        reason = " ".join(str(error).split())
        raise UserError(f"{sentence} ({type(error).__name__}: {reason})") from error


def names_below(root: Path, names: Iterable[str], what: str, looked_for: object) -> list[str]:
    """Names found in a folder, sorted, each once; `UserError` where there is no such folder and where it has none."""
    if not root.is_dir():
        raise UserError(f"{root}: there is no such folder of {what}; give data.path=FOLDER")
    found = sorted({*names})
    if not found:
        raise UserError(f"{root}: holds no {what}; looked for {looked_for}")
    return found


def numbers(values: Any, *shape: int) -> Tensor:
    """A tensor (float64) of nested lists or an array; to be called within `expecting`, as it raises what torch does
    and `ValueError` where they are not finite numbers of this shape."""
    tensor = torch.as_tensor(values, dtype=torch.float64)
    if tensor.shape != shape or not tensor.isfinite().all():
        raise ValueError(f"these are not {' x '.join(map(str, shape))} finite numbers")
    return tensor


def check_upright(camera: Tensor, where: str, up: str = "+Y") -> None:
    """`UserError` unless a camera `[4, 4]` is rigid, off the origin, looks at it, and stands upright."""
    if not is_rotation(camera[:3, :3]) or (camera[3] - camera.new_tensor([0, 0, 0, 1])).abs().max() >= 1e-3:
        raise UserError(f"{where} is not a rigid camera-to-world transform")
    if not 1e-6 < camera[:3, 3].norm() < torch.inf:
        raise UserError(f"{where} must stand off the origin; its distance is {camera[:3, 3].norm():g}")
    residual = spherical_residual(camera).item()
    if not residual <= LARGEST_RESIDUAL:
        off = f"it is {residual:.1f} degrees off, {LARGEST_RESIDUAL:g} are allowed"
        raise UserError(f"{where} does not look at the origin with {up} up ({off})")
