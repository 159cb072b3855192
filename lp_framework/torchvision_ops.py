"""Lets torchvision be imported where its compiled operators do not load.

The extension of the package index's torchvision, compiled against a CUDA build, does not load with the CPU build of
torch, and `import torchvision` then stops at "operator torchvision::nms does not exist". Networks and weights need no
operator, so the names of the two that the import describes are declared; calling one still raises torchvision's error.
Lightning imports torchvision by way of torchmetrics, so `install` sees to it whoever asks for torchvision first.
"""

from __future__ import annotations

import importlib.util
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

_declared: list[Any] = []  # torch.library.Library: a declaration lasts as long as its object


class _Watch:
    """A finder that finds no module, but notices when torchvision is looked for."""

    @classmethod
    def find_spec(cls, fullname: str, path: object, target: object = None) -> None:
        if fullname == "torchvision":
            ensure()


def install() -> None:
    """Have `ensure` called when torchvision is first imported; costs nothing until then."""
    if "torchvision" not in sys.modules and _Watch not in sys.meta_path:
        sys.meta_path.insert(0, _Watch)


def ensure() -> None:
    """Call it before the first `import torchvision`; where torchvision is healthy it changes nothing."""
    if _Watch in sys.meta_path:
        sys.meta_path.remove(_Watch)  # else looking for torchvision would call this again from within
    package = None if "torchvision" in sys.modules or _declared else importlib.util.find_spec("torchvision")
    if package is None or package.origin is None:
        return
    import torch

    with suppress(OSError):
        for file in Path(package.origin).parent.glob("_C.*"):
            torch.ops.load_library(file)  # stays loaded, as torchvision's own import would leave it
            return
    library = torch.library.Library("torchvision", "DEF")
    for name in ("nms", "qnms"):
        library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    _declared.append(library)
