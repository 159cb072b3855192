"""`landscape`: the prior's energy over relative poses, for a pair of views or around each object of a data set."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from matplotlib.figure import Figure
from numpy.typing import NDArray
from omegaconf import DictConfig
from rich import box
from rich.console import Console
from rich.table import Table

from lp_framework.analysis.ambiguity import NEAR_DEGREES, overview
from lp_framework.analysis.examples import EXAMPLES, save_examples
from lp_framework.analysis.fields import Draws, checked_draws
from lp_framework.analysis.landscapes import landscape_grid
from lp_framework.analysis.pairs import PoseMap, ShownPair, explained_pair, named_pairs, photographed_pairs, words
from lp_framework.api import move, view_set
from lp_framework.commands.building import Components, begin, plain, warn_of_photographs
from lp_framework.data.photograph_files import photograph_files
from lp_framework.data.photographs import on_white, prepared_photographs
from lp_framework.errors import UserError
from lp_framework.evaluation.tables import write_arrays, write_json
from lp_framework.models.pose_model import FieldValue
from lp_framework.registry import checked
from lp_framework.report.page import write_run_page
from lp_framework.solvers.base import Pairs
from lp_framework.solvers.progress import shown_progress
from lp_framework.viz.curves import azimuth_figure
from lp_framework.viz.maps import minima_in_words, pair_figure, surface_figure
from lp_framework.viz.style import save_figure

GRID = ("latitude_limit_degrees", "latitude_step_degrees", "longitude_step_degrees")
PAIR_SETTINGS = ("reference", "query", "masks", "solver", "start")  # settings that the overview does not use


@torch.no_grad()
def run(config: DictConfig) -> None:
    """Compute the landscape of a pair of views if one is named, else the overview of all objects."""
    check(config)
    folder, device, components = begin(config)
    grid = landscape_grid(**checked(landscape_grid, {key: config[key] for key in GRID}, ""))
    draws = checked_draws(config.timesteps, config.noises, config.seed, config.batch)
    console = Console(width=None if Console().is_terminal else 110, highlight=False)
    if config.object is None and config.images is None:
        data, prior = components.test_views(config.protocol), components["prior"].to(device)
        found = overview(data, prior, device, draws, grid, config.azimuths, config.protocol)
        table, results = overview_table(f"{config.data.name}, prior={config.prior.name}", found), "azimuth.json"
        figures = {"azimuth": azimuth_figure(found["objects"])}
    else:
        if config.images is not None:
            pairs, pair = photographs(config, device)
        else:
            pairs, pair = data_pair(config, components, device)
        solver, prior = components["solver"], components["prior"].to(device)
        move(solver, device)
        model = None if pair.truth is None else components["model"].to(device)
        move(components["start"], device)
        starts = components["start"].make(pairs, config.seed)
        with shown_progress():
            pair, views, field = explained_pair(pairs, pair, solver, prior, model, starts, draws, grid)
        checkpoint, method = components.checkpoint, words(config.solver.name)
        found = {**summary(pair), "checkpoint": str(checkpoint) if checkpoint else None}
        table, results = pair_table(f"{pair.object}, prior={config.prior.name}", method, found), "landscape.json"
        write_arrays(folder / "landscape.npz", landscape_arrays(pair, field))
        example = replace(pair, ambiguity="unlabelled", reason=f"trajectories of {method}")
        save_examples(folder / "pictures" / EXAMPLES, [example])
        figures = pair_figures(pair, views, draws, f"Energy of prior {config.prior.name}, trajectories of {method}")
    write_json(folder / results, {**found, **components.record()})
    pictures = [save_figure(figure, folder / name)[0].name for name, figure in figures.items()]
    console.print(table)
    console.print(f"results: {folder / results}", soft_wrap=True)
    console.print(f"picture: {folder}/{', '.join(pictures)}", soft_wrap=True)
    console.print(f"page:    {write_run_page(folder, 'landscape')}", soft_wrap=True)


def check(config: DictConfig) -> None:
    """Raise `UserError` for settings that no landscape has."""
    if not isinstance(config.azimuths, int) or config.azimuths < 2:
        raise UserError(f"azimuths must be a whole number, at least 2, got {config.azimuths}")
    if config.object is None and config.images is None:
        given = (override.partition("=")[0] for override in HydraConfig.get().overrides.task)
        for key in given:
            if key.partition(".")[0] in PAIR_SETTINGS:
                raise UserError(f"{key} is for the landscape of a pair; also give object=NAME or images=[A.png,B.png]")
    if config.object is not None and config.images is not None:
        raise UserError("give object=NAME for views of the data set or images=[A.png,B.png], not both")


def pair_figures(pair: ShownPair, views: Sequence[NDArray], draws: Draws, heading: str) -> dict[str, Figure]:
    """The pictures `landscape`, `surface` and `fields`; the last needs the truth, which photographs lack."""
    energy = pair.prior_energy
    radius = f"{'' if pair.truth is None else 'true '}relative radius {energy.radius:+.2f}".replace("-", "\u2212")
    note = f"{minima_in_words(energy)} at the {radius}. {draws.in_words()}"
    figures = {
        "landscape": pair_figure(pair, [PoseMap(heading, relief=energy, solved=pair)], pair.object, note, views),
        "surface": surface_figure(energy, pair.truth, pair.object),
    }
    if pair.maps:
        note = "trajectories of the first stage without noise (langevin, gamma 0)"
        figures["fields"] = pair_figure(pair, pair.maps, pair.object, note)
    return figures


def data_pair(config: DictConfig, components: Components, device: torch.device) -> tuple[Pairs, ShownPair]:
    """Two test views of the data set's `object`."""
    for key in ("reference", "query"):
        if not isinstance(config[key], int):
            raise UserError(f"{key} must be the number of a test view, got {config[key]}")
    data = components.test_views()
    pairs, (pair,) = named_pairs(data, [str(config.object)], [(config.reference, config.query)], device)
    title = f"{pair.title} ({pair.ambiguity}), views {config.reference} and {config.query}"
    return pairs, replace(pair, object=title)


def photographs(config: DictConfig, device: torch.device) -> tuple[Pairs, ShownPair]:
    """The two files of `images`, prepared as in `estimate`, with its reference camera."""
    files = photograph_files(config.images)
    if len(files) != 2:
        raise UserError(f"images: a landscape needs two files, got {len(files)}")
    prepared = prepared_photographs(files, config.masks, config.remove_background, config.crop)
    warn_of_photographs(plain(config.prior))
    pairs = view_set(prepared, device).pairs([0], [1])
    poses = np.tile([0.0, 0.0, 1.4], (2, 1))
    (pair,) = photographed_pairs(files, [on_white(image) for image in prepared], poses)
    return pairs, pair


def landscape_arrays(pair: ShownPair, field: FieldValue | None) -> dict[str, Any]:
    """The arrays of `landscape.npz`, in radians and scene units."""
    landscape = pair.prior_energy
    arrays = {
        "latitude": landscape.latitude.numpy(), "longitude": landscape.longitude.numpy(),
        "radius": np.float32(landscape.radius), "energy": landscape.energy.numpy(),
        "trajectories": pair.ends[:, None] if pair.trajectories is None else pair.trajectories,
    }  # fmt: skip
    if pair.truth is not None:
        arrays["truth"] = pair.truth
    fields = {} if field is None else {"model_score": field.score, "model_energy": field.energy}
    return arrays | {name: each[0].cpu().numpy() for name, each in fields.items() if each is not None}


def summary(pair: ShownPair) -> dict[str, Any]:
    """The content of `landscape.json`; angles in degrees."""
    truth, landscape = pair.truth, pair.prior_energy
    errors = [None] * len(pair.ends) if truth is None else pair.rotation_errors.tolist()
    return {
        "reference": str(pair.reference.file),
        "query": str(pair.query.file),
        "truth": None if truth is None else in_degrees(truth),
        "radius": landscape.radius,
        "minima": [
            {**minimum._asdict(), "latitude": math.degrees(minimum.latitude),
             "longitude": math.degrees(minimum.longitude)} for minimum in landscape.minima()
        ],
        "flatness": landscape.flatness(),
        "descents": [
            {"start_longitude": start, "end": in_degrees(end), "rotation_error": error, "energy": energy,
             "chosen": number == pair.chosen}
            for number, (start, end, error, energy) in enumerate(
                zip(pair.start_longitudes(), pair.ends, errors, pair.energies.tolist(), strict=True)
            )
        ],
    }  # fmt: skip


def in_degrees(pose: NDArray) -> tuple[float, float, float]:
    """A relative pose `[3]` as degrees, degrees in [0, 360), scene units."""
    latitude, longitude, radius = pose.tolist()
    return math.degrees(latitude), math.degrees(longitude) % 360, radius


def pair_table(title: str, method: str, record: dict[str, Any]) -> Table:
    """Table of the truth, the minima and the ends in `summary`."""
    columns = ("", "latitude", "longitude", "height", "prominence", "from the truth")
    table, truth = table_of(title, columns, numbers=columns[1:]), record["truth"]
    if truth is not None:
        table.add_row("truth", *(f"{angle:.0f}°" for angle in truth[:2]))
    for number, minimum in enumerate(record["minima"], start=1):
        latitude, longitude, _, height, prominence = minimum.values()
        away = "" if truth is None else f"{abs((longitude - truth[1] + 180) % 360 - 180):.0f}° in longitude"
        place = f"{latitude:.0f}°", f"{longitude:.0f}°"
        table.add_row(f"minimum {number}", *place, f"{height:.2f}", f"{prominence:.2f}", away)
    table.add_section()
    for each in record["descents"]:
        start, error = each["start_longitude"], each["rotation_error"]
        off = "" if error is None else f"{error:.0f}°{' (answer)' if each['chosen'] else ''}"
        place = f"{each['end'][0]:.0f}°", f"{each['end'][1]:.0f}°"
        table.add_row(method if start is None else f"{method} from {start:.0f}°", *place, "", "", off)
    return table


def overview_table(title: str, record: dict[str, Any]) -> Table:
    """One row per object and the shares over all, followed by the objects without a unique answer."""
    near = f"within {NEAR_DEGREES:g}°"
    columns = ("object", "class", near, "relief", "minima (degrees from truth: height)", "flatness", "verdict")
    table = table_of(title, columns, numbers=(near, "relief", "flatness"))
    for row in sorted(record["objects"], key=lambda row: -row["within"]):
        minima = ", ".join(f"{minimum['degrees']:+.0f}: {minimum['height']:.2f}" for minimum in row["minima"][:4])
        score = row["ambiguity_score"]
        table.add_row(
            row["object"], row["ambiguity"], f"{row['within']:.2f}", f"{row['relief']:.1%}", minima,
            f"{score['flatness']:.2f}", score["verdict"],
        )  # fmt: skip
    table.add_section()
    for name, key in (("all objects", "within"), ("unique answer", "within_unique_answer")):
        if record[key] is not None:
            table.add_row(name, "", f"{record[key]:.3f}", "", "")
    unanswered = [row["object"] for row in record["objects"] if not row["ambiguity_score"]["unique_answer"]]
    if unanswered:
        table.caption = f"without a unique answer for this prior: {', '.join(unanswered)}"
    return table


def table_of(title: str, columns: Sequence[str], numbers: Sequence[str]) -> Table:
    """An empty table for the terminal, with right-aligned columns of numbers last."""
    table = Table(title=title, title_justify="left", caption_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        table.add_column(column, justify="right" if column in numbers else "left", no_wrap=True)
    return table
