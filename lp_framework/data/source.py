"""Where views come from. A `data=` choice is a source; `PairDataModule` loads the views of any."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path

from lp_framework.data.views import ObjectViews, object_names, read_views
from lp_framework.registry import register


class ViewSource(ABC):
    """A set of objects whose views lie in the folder `path`, once they are prepared."""

    path: Path

    @abstractmethod
    def names(self) -> list[str]:
        """The objects, sorted; of these alone, whatever else lies in `path`."""

    @abstractmethod
    def prepare(self) -> None:
        """Make the views that are missing in `path`, in one process; a run that was stopped is gone on with."""

    def views(self, name: str, split: str) -> ObjectViews:
        """The views of an object in a split ("train" or "test")."""
        return read_views(self.path, name, split)


@register("data", "renderings")
class RenderingsData(ViewSource):
    """A folder of views in iFusion's layout, such as its published renderings of GSO and OO3D."""

    def __init__(self, path: str) -> None:
        self.path = Path(path)

    def names(self) -> list[str]:
        """All objects whose views are in `path`."""
        return object_names(self.path)

    def prepare(self) -> None:
        """Nothing is made: the views are there."""
