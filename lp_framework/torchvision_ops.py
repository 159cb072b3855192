"""Lets torchvision be imported where its compiled operators do not load.

The CPU build of torch and the torchvision of the package index, which is compiled against a CUDA build, do not fit each
other: torchvision's extension fails to load, and `import torchvision` then stops at "operator torchvision::nms does not
exist", because it describes that operator to the compiler. Networks and weights need no such operator. Declaring the
names of the two that are described is enough; whoever calls one of them still gets torchvision's error.

Lightning imports torchvision by way of torchmetrics, so `install` sees to it whoever asks for torchvision first.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

_OPERATORS = ("nms", "qnms")
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
    if "torchvision" in sys.modules or _declared or _extension_loads():
        return
    import torch

    library = torch.library.Library("torchvision", "DEF")
    for name in _OPERATORS:
        library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    _declared.append(library)


def _extension_loads() -> bool:
    """Whether torchvision's compiled operators load; they stay loaded, as its own import would leave them."""
    package = importlib.util.find_spec("torchvision")
    if package is None or package.origin is None:
        return True  # not installed: nothing to mend
    import torch

    try:
        for file in Path(package.origin).parent.glob("_C.*"):
            torch.ops.load_library(file)
            return True
    except OSError:
        pass
    return False
