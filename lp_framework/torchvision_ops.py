"""Lets torchvision be imported where its compiled operators do not load.

The CPU build of torch and the torchvision of the package index, which is compiled against a CUDA build, do not fit each
other: torchvision's extension fails to load, and `import torchvision` then stops at "operator torchvision::nms does not
exist", because it describes that operator to the compiler. Networks and weights need no such operator. Declaring the
names of the two that are described is enough; whoever calls one of them still gets torchvision's error.

Lightning imports torchvision by way of torchmetrics, so `install` sees to it whoever asks for torchvision first.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import importlib.util
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any

_SCHEMAS = (
    "nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
    "qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
)
_declared: list[Any] = []  # torch.library.Library: a declaration lasts as long as its object


def install() -> None:
    """Have `ensure` called when torchvision is first imported; costs nothing until then."""
    if "torchvision" not in sys.modules and not any(isinstance(finder, _Watch) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Watch())


class _Watch(importlib.abc.MetaPathFinder):
    """Finds no module, but notices when torchvision is looked for."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname == "torchvision":
            ensure()
        return None


def ensure() -> None:
    """Call it before the first `import torchvision`; where torchvision is healthy it changes nothing."""
    # Looking for torchvision is what the watch waits for: it must not call this again from within.
    sys.meta_path[:] = [finder for finder in sys.meta_path if not isinstance(finder, _Watch)]
    if "torchvision" in sys.modules or _declared or _extension_loads():
        return
    import torch

    library = torch.library.Library("torchvision", "DEF")
    for schema in _SCHEMAS:
        library.define(schema)
    _declared.append(library)


def _extension_loads() -> bool:
    """Whether torchvision's compiled operators load; they stay loaded, as its own import would leave them."""
    package = importlib.util.find_spec("torchvision")
    if package is None or not package.submodule_search_locations:
        return True  # not installed: nothing to mend
    suffixes = importlib.machinery.EXTENSION_SUFFIXES
    finder = importlib.machinery.FileFinder(
        package.submodule_search_locations[0], (importlib.machinery.ExtensionFileLoader, suffixes)
    )
    extension = finder.find_spec("_C")
    if extension is None or extension.origin is None:
        return False
    import torch

    try:
        torch.ops.load_library(extension.origin)
    except OSError:
        return False
    return True
