"""The Python API exported by `lp_framework`, and functions it shares with the commands on photographs."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from PIL import Image
from torch import Tensor

from lp_framework import catalogue, registry
from lp_framework.data.pairs import as_images
from lp_framework.data.photographs import array_image, on_white, prepare, read_image, upright
from lp_framework.errors import UserError
from lp_framework.models.checkpoints import load_model as read_model
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Solution, Solver, ViewSets
from lp_framework.solvers.progress import shown_progress
from lp_framework.solvers.starts import Starts

TINY_WARNING = (
    "prior=tiny, which ships, supports only the twelve embedded objects, uncropped; other poses are meaningless"
)


def estimate_pose(
    reference: str | Path | Image.Image | ArrayLike,
    query: str | Path | Image.Image | ArrayLike,
    solver: str | Solver = "sharp",
    prior: str | Prior = "tiny",
    model: str | Path | PoseModel = "general",
    starts: str | Starts = "modes",
    seed: int = 0,
    crop: bool = True,
    remove_background: bool = False,
) -> Solution:
    """Estimate the pose of `query` relative to `reference`, two pictures of one object.

    `.answer()` of the result is `[1, 3]`, query minus reference: latitude and longitude in radians (the latter in
    [0, 2 pi)) and radius in object sizes.

    A picture is a file, a Pillow image or an array `[H, W, 3 | 4]` (uint8, or floats in [0, 1]). The object is cut out
    by the alpha channel, or by a mask made with `remove_background=True`, then centred and scaled. With `crop=False` a
    picture must be a whole square view, on white if it has no alpha channel.

    `solver`, `prior` and `starts` are registered names or objects built by the functions below. A solver given by name
    gets the prior and the model that it needs, on the GPU if there is one; a built solver keeps its own. `model` is the
    name of bundled weights, a checkpoint, the folder of a training run, or a model.

    If the model has a density, as `general` does, `probability` of the result is the probability of an error of at most
    30 degrees, and the relative radius is 0, because cropping discards the distance.

    Raises `UserError` for a picture that cannot be read or has no object, and for an unknown name.
    """
    prepared = []
    for name, picture in (("reference", reference), ("query", query)):
        label = str(picture) if isinstance(picture, str | Path) else name
        prepared.append(prepare(open_picture(picture, label), label, None, remove_background, crop))
    parts = _components([("solver", solver), ("start", starts)], prior, model)
    if isinstance(solver, str):
        solver = load_solver(solver, **parts)
        move(solver, best_device())
    starts = make_starts(starts, **parts) if isinstance(starts, str) else starts
    device = next((each.device for part in solver.networks() for each in part.parameters()), torch.device("cpu"))
    move(starts, device)
    pairs = view_set(prepared, device).pairs([0], [1])
    with shown_progress():
        solution = solver.solve(pairs, starts.make(pairs, seed), seed)
    if crop and solution.probability is not None:
        solution = replace(solution, poses=solution.poses * solution.poses.new_tensor([1.0, 1.0, 0.0]))
    return solution


def load_model(checkpoint: str | Path = "score") -> PoseModel:
    """Load a trained model from bundled weights (by name), a checkpoint file, a training run's folder or a hub id."""
    return read_model(checkpoint)


def load_prior(name: str, **arguments: Any) -> Prior:
    """Load a frozen pose-conditioned diffusion prior; `name` and `arguments` are those of `prior=` in the catalogue."""
    return registry.build("prior", _settings("prior", name, arguments))


def load_solver(name: str, model: PoseModel | None = None, prior: Prior | None = None, **arguments: Any) -> Solver:
    """Build a solver; `name` and `arguments` are those of `solver=` in the catalogue.

    Raises `UserError` if the solver needs a `model` or a `prior` that is not given, and for an unknown setting.
    """
    return registry.build("solver", _settings("solver", name, arguments), model=model, prior=prior)


def make_starts(name: str, model: PoseModel | None = None, prior: Prior | None = None, **arguments: Any) -> Starts:
    """Build starts (initial poses); `name` and `arguments` are those of `start=` in the catalogue.

    `.make(pairs, seed)` of the result gives relative poses `[B, N, 3]`. `start=modes` needs a `model`.
    """
    return registry.build("start", _settings("start", name, arguments), model=model, prior=prior)


def _settings(group: str, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """The settings of a registered name or of a preset in `conf/`, overridden by `arguments`."""
    preset = {"name": name} if name in registry.names(group) else catalogue.values(group, name)
    return {**preset, **arguments}


def _components(
    choices: Sequence[tuple[str, object]], prior: str | Prior, model: str | Path | PoseModel
) -> dict[str, Any]:
    """Load the prior and the model, each once, if a component chosen by name needs them."""
    named = [
        registry.get(group, _settings(group, name, {})["name"]) for group, name in choices if isinstance(name, str)
    ]
    wanted = {component for each in named for component in registry.component_names(each)}
    parts: dict[str, Any] = {}
    if "model" in wanted:
        parts["model"] = model if isinstance(model, PoseModel) else load_model(model)
    if "prior" in wanted:
        parts["prior"] = prior if isinstance(prior, Prior) else load_prior(prior)
        if prior == "tiny":
            warnings.warn(f"{TINY_WARNING}. For photographs use load_prior('zero123xl', path=...)", stacklevel=3)
    return parts


def open_picture(picture: str | Path | Image.Image | ArrayLike, name: str) -> Image.Image:
    """Open a file, a Pillow image or an array `[H, W, 3 | 4]` as RGB or RGBA; errors refer to it as `name`."""
    if isinstance(picture, str | Path):
        return read_image(picture)
    if isinstance(picture, Image.Image):
        try:
            return upright(picture)
        except (OSError, ValueError) as error:  # Pillow reads files lazily
            raise UserError(f"{name}: {error}") from error
    return array_image(picture, name)


def image_batch(prepared: Sequence[Image.Image]) -> Tensor:
    """Convert prepared images (RGBA, all of one size) to `[I, 3, H, W]` in [-1, 1] on white."""
    return as_images(torch.from_numpy(np.stack([on_white(image) for image in prepared])))


def view_set(prepared: Sequence[Image.Image], device: torch.device) -> ViewSets:
    """Prepared photographs of one object as a single set of views."""
    views = torch.arange(len(prepared), device=device)[None]
    return ViewSets(image_batch(prepared).to(device), views, ids=torch.zeros_like(views[:, 0]))


def best_device() -> torch.device:
    """The GPU (CUDA or Apple) if there is one, otherwise the CPU."""
    found = torch.accelerator.current_accelerator() if torch.accelerator.is_available() else None
    return torch.device("cpu") if found is None else torch.device(found.type)


def move(user: Solver | Starts, device: torch.device) -> None:
    """Move the networks of a solver or starts to a device."""
    for part in user.networks():
        part.to(device)
