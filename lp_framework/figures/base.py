"""What every figure of the paper is: what it needs by name, what is gathered for it, and how that is drawn."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Generic, TypeVar

import torch
from matplotlib.figure import Figure
from torch import nn

Contents = TypeVar("Contents")


class PaperFigure(ABC, Generic[Contents]):
    """A figure. A subclass's constructor declares what it needs by name (`data`, `prior`) and has its settings."""

    def networks(self) -> list[nn.Module]:
        """The networks that it was given or has loaded, to be moved to a device."""
        return [part for part in vars(self).values() if isinstance(part, nn.Module)]

    @abstractmethod
    def gather(self, seed: int, device: torch.device) -> Contents:
        """The arrays of the figure; the data are prepared, the networks are on the device. Draws follow `seed`."""

    @abstractmethod
    def draw(self, contents: Contents) -> Figure:
        """The figure of what was gathered."""

    @abstractmethod
    def caption(self, contents: Contents) -> str:
        """What to print below the figure: its panels, and the settings that its numbers depend on."""
