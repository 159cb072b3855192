"""Fit the temperature of a matching model on the embedded objects, which it was not trained on.

    python -m lp_framework render data=toy
    python -m lp_framework convert path=runs/general output=general dtype=float16
    python scripts/calibrate.py general datasets/toy

It maximizes the likelihood of the true longitudes over all ordered pairs of test views of objects with a unique answer,
both full and cropped like photographs, and writes it to `general/model.json`.
"""

from __future__ import annotations

import json
import sys
from itertools import permutations
from pathlib import Path

import torch

from lp_framework.api import image_batch
from lp_framework.data.photographs import prepared_photographs
from lp_framework.data.views import RenderingsData
from lp_framework.models.checkpoints import CONFIG, load_model
from lp_framework.models.pose_density import PoseDensity

TEMPERATURES = torch.arange(1.0, 4.01, 0.05)


def densities(model_folder: Path, views_folder: Path) -> tuple[PoseDensity, torch.Tensor]:
    """Densities of all pairs at temperature 1, and the true longitude differences."""
    model, source = load_model(model_folder), RenderingsData(str(views_folder))
    model.temperature = 1.0  # type: ignore[assignment]
    logits, true = [], []
    for name in source.names():
        views = source.views(name, "test")
        if views.unique_answer is False:
            continue
        reference, query = torch.tensor([*permutations(range(len(views)), 2)]).T
        for crop in (False, True):
            codes = model.encode(image_batch(prepared_photographs(views.files, None, False, crop)))
            logits.append(model.condition(codes[reference], codes[query]).logits)
            true.append((views.poses[query] - views.poses[reference])[:, 1].float())
    nothing = torch.zeros(sum(map(len, true)), 2)
    return PoseDensity(torch.cat(logits), nothing, nothing), torch.cat(true)


@torch.no_grad()
def main() -> None:
    """Print the likelihoods and write the best temperature."""
    folder, views = map(Path, sys.argv[1:])
    density, true = densities(folder, views)
    losses = torch.stack(
        [
            -PoseDensity(density.logits / each, density.mean, density.deviation).log_prob(true).mean()
            for each in TEMPERATURES
        ]
    )
    best = round(TEMPERATURES[losses.argmin()].item(), 2)
    print(f"{len(true)} pairs: {losses[0]:.3f} nats at temperature 1, {losses.min():.3f} at {best}")
    config = json.loads((folder / CONFIG).read_text())
    config["model"]["temperature"] = best
    (folder / CONFIG).write_text(json.dumps(config, indent=2) + "\n")


if __name__ == "__main__":
    main()
