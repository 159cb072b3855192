"""Pairs of an evaluation on a page: a card each, and the landscape, the map and the cameras of the one chosen."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lp_framework.analysis.landscapes import LandscapeMinimum
from lp_framework.analysis.shown import ShownPair
from lp_framework.report.parts import packed
from lp_framework.report.plots import frame_steps, map_plot, pair_cameras_plot, surface_plot

LARGEST = 4_000_000  # letters that the plots of one run's pairs may take; the last ones are left out beyond it
VALLEYS = 4  # of a landscape, told by their places
TURN, MINUS = 2 * math.pi, "\N{MINUS SIGN}"


@dataclass(frozen=True)
class Pair:
    """A pair with its plots (packed, by kind), the steps that their frames show, and what is told of it."""

    example: ShownPair
    plots: Mapping[str, str]
    steps: Sequence[int]
    told: Mapping[str, str]


def pairs(examples: Sequence[ShownPair]) -> dict[str, Any]:
    """What the template `pairs` shows of examples."""
    shown: list[Pair] = []
    size = 0
    for example in examples:
        kinds = {"map": map_plot, "cameras": pair_cameras_plot}
        if example.landscapes:
            kinds["surface"] = surface_plot
        plots = {kind: packed(draw(example).to_json()) for kind, draw in kinds.items()}
        size += sum(map(len, plots.values()))
        if shown and size > LARGEST:
            break
        shown.append(Pair(example, plots, frame_steps(example), told(example)))
    return {
        "pairs": shown,
        "left_out": len(examples) - len(shown),
        "failures": sum(pair.example.failed for pair in shown),
        "plays": any(len(pair.steps) > 1 for pair in shown),
    }


def told(example: ShownPair) -> dict[str, str]:
    """What is to be said of a pair in words, by its name."""
    chosen = example.chosen or 0  # a pair that was saved has one
    rotation, translation = example.rotation_errors[chosen], example.translation_errors[chosen]
    answer = _pose(example.ends[chosen])
    if math.isfinite(rotation):
        answer += f": off by {rotation:.1f}°" + (f" and {translation:.2f}" if math.isfinite(translation) else "")
    truth = {} if example.truth is None else {"true relative pose": _pose(example.truth)}
    valleys = {name: _valleys(landscape.minima()) for name, landscape in example.landscapes.items()}
    return {"pair": example.reason, **truth, "answer": answer, **valleys}


def _valleys(minima: Sequence[LandscapeMinimum]) -> str:
    places = "; ".join(f"{_angle(each.latitude)}, {_angle(each.longitude % TURN)}" for each in minima[:VALLEYS])
    count = "one valley, at" if len(minima) == 1 else f"{len(minima)} valleys, the deepest first:"
    return f"{count} {places}{'; …' if len(minima) > VALLEYS else ''}" if minima else "no valley"


def _pose(pose: NDArray) -> str:
    latitude, longitude, radius = pose
    if not np.isfinite(pose).all():
        return "none"
    return f"latitude {_angle(latitude)}, longitude {_angle(longitude % TURN)}, radius {radius:.2f}".replace("-", MINUS)


def _angle(radians: float) -> str:
    return f"{math.degrees(radians):.1f}°".replace("-", MINUS)
