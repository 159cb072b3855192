"""Computes the app's requests by the same functions as the commands, with one network of each kind in memory."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lp_framework import catalogue, registry
from lp_framework.analysis.estimates import Estimate, estimate
from lp_framework.analysis.fields import Draws, generated_views, model_field, pose_energies
from lp_framework.analysis.pairs import (
    SAMPLING,
    ShownPair,
    named_pairs,
    object_index,
    solved_pairs,
    with_model_landscape,
    with_prior_energy,
)
from lp_framework.api import TINY_WARNING, load_model, load_prior, load_solver, make_starts, move
from lp_framework.app.jobs import Cancelled
from lp_framework.data.module import PairDataModule
from lp_framework.data.photographs import read_photographs
from lp_framework.errors import UserError
from lp_framework.models.pose_model import PoseModel
from lp_framework.priors.base import Prior
from lp_framework.solvers.base import Pairs, Solver
from lp_framework.solvers.starts import Starts

log = logging.getLogger(__name__)

T = TypeVar("T")


class Choice(NamedTuple):
    """A choice by name, with settings that override its YAML file."""

    name: str
    settings: Mapping[str, Any] = {}


@dataclass(frozen=True)
class Request:
    """The components that a visitor chose."""

    solver: Choice
    start: Choice
    prior: Choice
    checkpoint: str


@dataclass(frozen=True)
class Scene:
    """An explored pair, on the device and as arrays with its landscapes; the request it answers; and the smoothing of
    the model's landscape (None: the model's own)."""

    pairs: Pairs
    pair: ShownPair
    request: Request
    sigma: float | None


class Place(NamedTuple):
    """A relative `pose` `[3]` of a scene: the view `[H, W, 3]` that the prior generates there, the energy in each
    landscape, and for each solver the pair solved from that start, or why the solver refuses it."""

    pose: Sequence[float]
    view: NDArray
    energies: Mapping[str, float]
    solved: Mapping[str, ShownPair]
    refusals: Mapping[str, str]


class Workbench:
    """Holds the networks of the last request and the data to choose objects from. Not thread-safe."""

    def __init__(
        self, device: torch.device, data: PairDataModule, prior: Choice, draws: Draws, first: Tensor, seed: int
    ) -> None:
        self.device, self.data, self.draws, self.first, self.seed = device, data, draws, first, seed
        self.own_prior = prior  # from the command line, with the location of its weights
        self._held: dict[str, tuple[object, Any]] = {}

    def estimate(
        self, files: Sequence[Path], masks: Path | None, crop: bool, request: Request
    ) -> tuple[Estimate, list[ShownPair]]:
        """Estimate the cameras of photographs; the pairs are of the first with each other one, with landscapes."""
        photographs = read_photographs(files, masks, remove_background=crop, crop=crop)
        solver, starts, needs = self._solver(request), self._starts(request), component_names("solver", request.solver)
        prior = self._prior(request.prior) if "prior" in needs else None
        found = estimate(photographs, crop, solver, starts, prior, self.first, self.device, self.seed)
        trusted = bool(found.answers) and all(answer.verdict == "trust" for answer in found.answers)
        bundled = request.prior.name == "tiny" and self._prior_settings(request.prior).get("path") is None
        if prior is not None and bundled and not trusted:
            log.warning("%s. For photographs, use the solver 'sharp' or start the app with Zero123.", TINY_WARNING)
        shown = [
            pair if len(pair.ends) else _answered(pair, pose.numpy())
            for pair, pose in zip(found.shown, found.relative[1:], strict=True)
        ]
        if "model" in needs:
            shown = with_model_landscape(found.pairs, shown, self.model(request.checkpoint), sigma_of(solver))
        if prior is not None:
            shown = with_prior_energy(found.pairs, shown, prior, self.draws)
        return found, shown

    def example(self, name: str, count: int) -> list[Path]:
        """The files of the first test views of an object."""
        self.data.prepare_data()
        table = self.data.table("test")
        return [table.files[view] for view in table.views_of(object_index(self.data, name))[:count]]

    def scene(self, name: str, reference: int, query: int, request: Request) -> Scene:
        """A pair of an object's test views with both landscapes, solved from the chosen starts."""
        self.data.prepare_data()
        pairs, shown = named_pairs(self.data, [name], [(reference, query)], self.device)
        prior, model = self._prior(request.prior), self.model(request.checkpoint)
        solver, starts = self._solver(request), self._starts(request)
        sigma = sigma_of(solver)
        shown = with_prior_energy(pairs, shown, prior, self.draws)
        shown = with_model_landscape(pairs, shown, model, sigma)
        (pair,) = solved_pairs(pairs, shown, solver, starts.make(pairs, self.seed), self.seed)
        return Scene(pairs, pair.finite(), request, sigma)

    @torch.no_grad()
    def place(self, scene: Scene, pose: Sequence[float], solvers: Sequence[str]) -> Place:
        """Evaluate a relative pose (radians, object sizes) of a scene, see `Place`."""
        here = torch.tensor([[pose]], dtype=torch.float32, device=self.device)  # [B = 1, N = 1, 3]
        pairs, grid = scene.pairs, (here[0, :, 0].cpu(), here[0, :, 1].cpu())
        prior, model = self._prior(scene.request.prior), self.model(scene.request.checkpoint)
        code = prior.encode(pairs.images[pairs.reference])
        (view,) = generated_views(prior, code, here[0].cpu(), *SAMPLING, self.seed)
        score, energy = model_field(model, pairs, here[0, :, 2], grid, scene.sigma)
        values = pose_energies(prior, pairs, here, self.draws), score.norm(dim=-1) if energy is None else energy
        energies = {name: value.item() for name, value in zip(scene.pair.landscapes, values, strict=True)}
        solved, refusals = {}, {}
        for solver in solvers:
            try:
                own = scene.request.solver
                choice = own if solver == own.name else Choice(solver)
                chosen = self._solver(replace(scene.request, solver=choice))
                (solved[solver],) = solved_pairs(pairs, [scene.pair], chosen, here, self.seed)
            except Cancelled:
                raise
            except UserError as error:
                refusals[solver] = str(error)
        return Place(pose, view, energies, solved, refusals)

    def _solver(self, request: Request) -> Solver:
        solver = load_solver(request.solver.name, **self._components("solver", request.solver, request))
        move(solver, self.device)
        return solver

    def _starts(self, request: Request) -> Starts:
        starts = make_starts(request.start.name, **self._components("start", request.start, request))
        move(starts, self.device)
        return starts

    def _components(self, group: str, choice: Choice, request: Request) -> dict[str, Any]:
        """The arguments of a choice: its settings, and the model and prior if it needs them."""
        needs = component_names(group, choice)
        model = self.model(request.checkpoint) if "model" in needs else None
        prior = self._prior(request.prior) if "prior" in needs else None
        return {"model": model, "prior": prior, **choice.settings}

    def model(self, checkpoint: str) -> PoseModel:
        """The model of a checkpoint; replaces the one in memory."""
        return self._kept("model", checkpoint, lambda: load_model(checkpoint).to(self.device))

    def _prior(self, choice: Choice) -> Prior:
        settings = self._prior_settings(choice)
        key = choice.name, sorted(settings.items())
        return self._kept("prior", key, lambda: load_prior(choice.name, **settings).to(self.device))

    def _prior_settings(self, choice: Choice) -> dict[str, Any]:
        own = self.own_prior.settings if choice.name == self.own_prior.name else {}
        return {**own, **choice.settings}

    def _kept(self, kind: str, key: object, load: Callable[[], T]) -> T:
        """Return the network in memory if it is the requested one; otherwise drop it before loading the other."""
        if self._held.get(kind, (None,))[0] != key:
            self._held.pop(kind, None)
            self._held[kind] = key, load()
        found: T = self._held[kind][1]
        return found


def _answered(pair: ShownPair, pose: NDArray) -> ShownPair:
    """A pair of photographs with only its answer `[3]`, for solvers that take all photographs at once."""
    unknown = np.full(1, np.nan)
    return replace(
        pair, ends=pose[None], chosen=0, energies=unknown, rotation_errors=unknown, translation_errors=unknown
    )


def component_names(group: str, choice: Choice) -> list[str]:
    """The components that a choice needs, such as `model` and `prior`."""
    return registry.component_names(registry.get(group, catalogue.values(group, choice.name)["name"]))


def sigma_of(solver: Solver) -> float | None:
    """The smoothing at which a solver ends, None if it has none."""
    sigmas = getattr(solver, "sigmas", None)
    return sigmas[-1] if sigmas else None
