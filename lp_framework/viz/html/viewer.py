"""Pairs of an evaluation on a page: a card each, and the landscape, the map and the cameras of the one chosen."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

from lp_framework.analysis.examples import as_json
from lp_framework.analysis.shown import ShownPair
from lp_framework.viz.html.elements import Html, joined, picture, sentence, tag
from lp_framework.viz.html.page import Data
from lp_framework.viz.style import CLASS_COLOURS

LARGEST = 4_000_000  # letters that the pairs of one run may take; the last ones are left out beyond it
LEGEND = {
    "truth": "true pose", "answer": "answer", "others": "other starts", "start": "start",
    "reference": "reference camera",
}  # fmt: skip


def viewer(examples: Sequence[ShownPair], data: Data) -> Html:
    """The cards of `examples`, the first one chosen, and what the page's script plays."""
    if not examples:
        return sentence("No pairs were kept.")
    contents: list[dict[str, Any]] = []
    size = 0
    for example in examples:
        content = _content(example)
        size += len(json.dumps(content))
        if contents and size > LARGEST:
            break
        contents.append(content)
    shown = examples[: len(contents)]
    left_out = len(examples) - len(shown)
    failures = sum(example.failed for example in shown)
    words = (
        f"{failures} of the {len(shown)} pairs are off by more than 30°" if failures else "None of these pairs failed"
    )
    plays = any(example.trajectories is not None for example in shown)
    steps = "the slider plays the solver's steps." if plays else "the solver's steps were not kept."
    advice = f"{words}. Choose one; {steps}" if len(shown) > 1 else steps.capitalize()
    over = "the way from every start over it" if plays else "where the answer lies on it"
    figures = [
        _figure("map", "wide", f"The landscape at the true relative radius, and {over}."),
        _figure("surface", "surface-figure", "The same as relief; drag to turn it."),
        _figure(
            "cameras",
            "cameras-figure",
            "The reference with its image, the query with its own at its true pose, and where the solver puts it. "
            "The globe in the object's place bears the landscape.",
        ),
    ]
    return tag(
        "div",
        {"class": "pairs", "data-of": str(data.add({"examples": contents}))},
        sentence(advice),
        tag("div", {"class": "cards", "role": "group", "aria-label": "pairs"}, *map(_card, shown)),
        *([sentence(f"{left_out} more would make the page too large.")] if left_out else []),
        tag(
            "div",
            {"class": "stage"},
            tag("dl", {"class": "told"}),
            tag(
                "ul",
                {"class": "legend"},
                *(tag("li", {"class": key}, tag("i", {}), label) for key, label in LEGEND.items()),
            ),
            tag(
                "div",
                {"class": "player"},
                tag("button", {"type": "button"}, "Play"),
                tag(
                    "input", {"type": "range", "min": "0", "max": "0", "value": "0", "aria-label": "step of the solver"}
                ),
                tag("output", {}),
                tag("select", {"aria-label": "landscape"}),
            ),
            tag("div", {"class": "plots"}, *figures),
        ),
    )


def class_of(ambiguity: str) -> Html:
    """The class of an object beside its colour."""
    known = ambiguity if ambiguity in CLASS_COLOURS else "unlabelled"
    return tag("span", {"class": f"class {known}"}, ambiguity)


def _content(example: ShownPair) -> dict[str, Any]:
    """What the script draws: the example, and the valleys of its landscapes."""
    content = as_json(example)
    for each, landscape in zip(content["landscapes"], example.landscapes.values(), strict=True):
        each["minima"] = [[round(minimum.latitude, 4), round(minimum.longitude, 4)] for minimum in landscape.minima()]
    return content


def _card(example: ShownPair) -> Html:
    name = example.object.replace("_", " ")
    error = example.rotation_errors[example.chosen]
    images = [
        picture(view.image, 160, f"{label} of {name}: {view.name}")
        for label, view in (("reference", example.reference), ("query", example.query))
    ]
    known = f"{error:.1f}°" if math.isfinite(error) else "no answer" if example.failed else ""
    said = tag("span", {"class": "error bad" if example.failed else "error"}, known)
    return tag(
        "button",
        {"type": "button", "class": "card", "aria-pressed": "false"},
        tag("span", {"class": "images"}, *images),
        tag("span", {"class": "line"}, tag("strong", {}, name), said),
        *([class_of(example.ambiguity)] if example.ambiguity != "unlabelled" else []),
        tag("small", {}, example.reason),
    )


def _figure(kind: str, place: str, caption: str) -> Html:
    attributes = {"class": f"plot {kind}", "role": "img", "aria-label": caption}
    return tag("figure", {"class": place}, joined(tag("div", attributes), tag("figcaption", {}, caption)))
