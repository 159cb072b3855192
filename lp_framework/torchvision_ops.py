"""Makes torchvision importable when its compiled operators do not load.

The extension of torchvision on the package index is compiled against a CUDA build. With a CPU build of torch it does
not load, and `import torchvision` fails with "operator torchvision::nms does not exist". Networks and weights need no
operators, so this module declares the two that the import needs; calling one still raises torchvision's error.
Lightning imports torchvision through torchmetrics, so `install` hooks into whichever import comes first.
"""

from __future__ import annotations

import importlib.util
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

_declared: list[Any] = []  # torch.library.Library: a declaration lasts as long as its object


class _Watch:
    """An import finder that finds no module but detects imports of torchvision."""

    @classmethod
    def find_spec(cls, fullname: str, path: object, target: object = None) -> None:
        if fullname == "torchvision":
            ensure()


def install() -> None:
    """Call `ensure` when torchvision is first imported; has no cost until then."""
    if "torchvision" not in sys.modules and _Watch not in sys.meta_path:
        sys.meta_path.insert(0, _Watch)


def ensure() -> None:
    """Declare missing operators, before the first `import torchvision`; does nothing if its extension loads."""
    if _Watch in sys.meta_path:
        sys.meta_path.remove(_Watch)  # otherwise looking for torchvision would recurse
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
