"""The pictures of an evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lp_framework.analysis.examples import EXAMPLES, gather_examples, save_examples
from lp_framework.analysis.shown import ShownPair
from lp_framework.data.pairs import PairData
from lp_framework.evaluation.evaluation import Evaluation
from lp_framework.viz.curves import errors_figure
from lp_framework.viz.maps import pair_figure
from lp_framework.viz.sheets import ObjectCard, objects_figure
from lp_framework.viz.style import save_figure


def save_pictures(folder: Path, evaluation: Evaluation, data: PairData, result: Mapping[str, Any]) -> list[Path]:
    """After `Trainer.test`: maps of some pairs (failures first), cumulative errors, and the objects, into `folder`.

    Each as PNG and PDF; returns the PNG files. Sets of images have no maps. `EXAMPLES` below the folder gets the
    pairs, for the page of the run.
    """
    examples = gather_examples(evaluation, data)
    save_examples(folder / EXAMPLES, examples)
    rows, table = evaluation.metrics.rows(), evaluation.table
    rotation, translation, chosen = (rows[name].numpy() for name in ("rotation", "translation", "chosen"))
    figures = {
        f"field_{number}": pair_figure(pair, pair.maps, f"{pair.title} ({pair.ambiguity})", answer_note(pair))
        for number, pair in enumerate(examples)
        if pair.maps
    }
    classes = [table.ambiguities[index] for index in rows["object"].tolist()]
    figures["errors"] = errors_figure(rotation, translation, chosen, classes)
    figures["objects"] = objects_figure(object_cards(result["per_object"], data))
    return [save_figure(figure, folder / name)[0] for name, figure in figures.items()]


def answer_note(pair: ShownPair) -> str:
    """Why a pair is shown, and how far off its answer is."""
    degrees, distance = pair.rotation_errors[pair.chosen], pair.translation_errors[pair.chosen]
    off = f"rotation error {degrees:.1f}°, translation error {distance:.2f}"
    return f"{pair.reason}: {'no answer' if np.isnan(degrees) else off}"


def object_cards(per_object: Mapping[str, Mapping[str, float] | None], data: PairData) -> list[ObjectCard]:
    """A card for every object that has pairs, with its first view; no success rate where a pair has one answer."""
    table, images = data.table, data.images
    assert images is not None  # evaluation never caches features
    return [
        ObjectCard(
            name, table.ambiguities[index], np.asarray(images[table.views_of(index)[0]]), metrics["R(R)@15"],
            metrics.get("SR(R)@30"),
        )
        for index, name in enumerate(table.names)
        if (metrics := per_object[name]) is not None
    ]  # fmt: skip
