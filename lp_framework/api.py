"""Estimating poses of pictures: what `lp_framework.estimate_pose` and the command `estimate` share."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from PIL import Image
from torch import Tensor

import lp_framework
from lp_framework import registry
from lp_framework.data.pairs import as_images
from lp_framework.data.photographs import BackgroundRemover, array_image, on_white, prepare, read_image, upright
from lp_framework.errors import UserError
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs, Solution, Solver
from lp_framework.solvers.progress import shown_progress
from lp_framework.solvers.starts import Starts

TINY_KNOWS = "prior=tiny as it ships knows the twelve embedded objects, uncropped; poses of anything else mean nothing"


def estimate_pose(
    reference: str | Path | Image.Image | ArrayLike,
    query: str | Path | Image.Image | ArrayLike,
    solver: str | Solver = "two_stage",
    prior: str | Prior = "tiny",
    model: str | Path | PoseModel | None = None,
    starts: str | Starts = "grid",
    seed: int = 0,
    crop: bool = True,
    remove_background: bool = False,
) -> Solution:
    """See `lp_framework.estimate_pose`."""
    remover = BackgroundRemover() if remove_background else None
    prepared = [
        prepare(open_picture(picture, name), name, remover=remover, crop=crop)
        for picture, name in ((reference, _name(reference, "reference")), (query, _name(query, "query")))
    ]
    if isinstance(solver, str):
        solver = _build_solver(solver, prior, model)
        move(solver, torch.device("cuda" if torch.cuda.is_available() else "cpu"))
    device = next((each.device for part in solver.networks() for each in part.parameters()), torch.device("cpu"))
    index = torch.arange(2, device=device)
    pairs = Pairs(image_batch(prepared).to(device), index[:1], index[1:], ids=index[:1])
    starting = registry.build("start", starts) if isinstance(starts, str) else starts
    with shown_progress():
        return solver.solve(pairs, starting.make(pairs.ids, seed), seed)


def _build_solver(name: str, prior: str | Prior, model: str | Path | PoseModel | None) -> Solver:
    wanted = registry.component_names(registry.get("solver", name))
    components: dict[str, Any] = {}
    if "model" in wanted:
        components["model"] = model if isinstance(model, PoseModel) else lp_framework.load_model(model)
    if "prior" in wanted:
        components["prior"] = prior if isinstance(prior, Prior) else registry.build("prior", prior)
        if prior == "tiny":
            warnings.warn(f"{TINY_KNOWS}. For photographs take load_prior('zero123xl', path=...)", stacklevel=4)
    solver: Solver = registry.build("solver", name, **components)
    return solver


def _name(picture: object, otherwise: str) -> str:
    return str(picture) if isinstance(picture, str | Path) else otherwise


def open_picture(picture: str | Path | Image.Image | ArrayLike, name: str) -> Image.Image:
    """A file, an image of Pillow or an array `[H, W, 3 | 4]` as RGB or RGBA; `name` is what errors call it."""
    if isinstance(picture, str | Path):
        return read_image(picture)
    if isinstance(picture, Image.Image):
        try:
            return upright(picture)
        except (OSError, ValueError) as error:  # files are read late
            raise UserError(f"{name}: {error}") from error
    return array_image(picture, name)


def image_batch(prepared: Sequence[Image.Image]) -> Tensor:
    """Images `[I, 3, H, W]` in [-1, 1], on white, of prepared ones (RGBA, all of one size)."""
    return as_images(torch.from_numpy(np.stack([on_white(image) for image in prepared])))


def move(solver: Solver, device: torch.device) -> None:
    """Move a solver's networks to a device."""
    for part in solver.networks():
        part.to(device)
